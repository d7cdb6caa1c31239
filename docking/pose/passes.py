"""Several passes become one point: lost beams out, passes compared, the rest averaged ([Luo], before the fit).

The comparison has two parts. Inter-point distances, which no motion changes, give the scatter of the instrument.
Coordinates must then agree as well, because averaging passes is right only when nothing moved between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from docking.errors import StationMoved
from docking.pose.pairs import distances, estimated_sigma_mm
from docking.pose.quantiles import chi2_upper
from docking.pose.settings import FitSettings
from docking.types import Array, Points, Rejection

_PASS_FLOOR_MM = 0.02
"""Scatter between passes that is always granted: instruments of this accuracy class drift by as much."""


@dataclass
class Averaged:
    """One row a point that has a usable reading: position (3,), covariance (3, 3) or NaN."""

    names: list[str] = field(default_factory=list)
    xyz_mm: list[Array] = field(default_factory=list)
    cov_mm2: list[Array] = field(default_factory=list)
    rejected: list[Rejection] = field(default_factory=list)
    dropped: list[Rejection] = field(default_factory=list)


def _by_name(points: Points) -> dict[str, list[int]]:
    rows: dict[str, list[int]] = {}
    for i, name in enumerate(points.names):
        rows.setdefault(name, []).append(i)
    return rows


def _pass_numbers(points: Points) -> list[int]:
    """The pass of each row; without pass numbers, how often the name has been met before, plus one."""
    if points.passes:
        return list(points.passes)
    seen: dict[str, int] = {}
    numbers = []
    for name in points.names:
        seen[name] = seen.get(name, 0) + 1
        numbers.append(seen[name])
    return numbers


def lost_beam(xyz_mm: Array) -> bool:
    """Exactly (0, 0, 0), how trackers write a point they did not see; or not finite."""
    return not bool(np.all(np.isfinite(xyz_mm))) or not bool(np.any(xyz_mm != 0.0))


def _pass_tables(points: Points, usable: dict[str, list[int]], numbers: list[int]) -> list[tuple[Array, Array]]:
    """For each pass with three or more points: its coordinates and the medians over passes of the same points."""
    median = {name: np.median(points.xyz_mm[rows], axis=0) for name, rows in usable.items() if len(rows) > 1}
    tables: dict[int, list[tuple[Array, Array]]] = {}
    for name, centre in median.items():
        for row in usable[name]:
            tables.setdefault(numbers[row], []).append((points.xyz_mm[row], centre))
    return [(np.array([t[0] for t in v]), np.array([t[1] for t in v])) for v in tables.values() if len(v) > 2]


def _scatter_mm(tables: list[tuple[Array, Array]], passes: int) -> float:
    """Sigma a coordinate of one reading, from how inter-point distances differ between passes."""
    sigmas = [
        estimated_sigma_mm(np.abs(distances(own) - distances(centre)), float(np.ptp(centre))) for own, centre in tables
    ]
    found = float(np.median(sigmas)) if sigmas else 0.0
    return max(found * sqrt(passes / max(passes - 1, 1)), _PASS_FLOOR_MM)


def _agreement(xyz: Array, cov: Array, scatter_mm: float, quantile: float) -> Array:
    """(m, m) truth of: two readings of one point agree within their noise."""
    delta = xyz[:, None, :] - xyz[None, :, :]
    both = cov[:, None] + cov[None, :]
    unknown = ~np.all(np.isfinite(both), axis=(2, 3))
    both[unknown] = 2.0 * scatter_mm**2 * np.eye(3)
    distance2 = np.einsum("ijk,ijk->ij", delta, np.linalg.solve(both, delta[..., None])[..., 0])
    result: Array = (distance2 <= quantile).astype(np.float64)
    return result


def _moved_between(tables: list[tuple[Array, Array]], scatter_mm: float) -> float | None:
    """Common motion of the passes, mm, when their inner distances agree but their coordinates do not."""
    rigid = [float(np.median(np.abs(distances(o) - distances(c)))) <= 4.0 * scatter_mm for o, c in tables]
    shift = [float(np.median(np.linalg.norm(o - c, axis=1))) for o, c in tables]
    return 2.0 * max(shift) if rigid and all(rigid) and max(shift) > 4.0 * scatter_mm else None


def mean_reading(xyz: Array, cov: Array) -> tuple[Array, Array]:
    """Mean of readings (m, 3), weighted by their covariances where these are known; with its covariance (or NaN)."""
    if not bool(np.all(np.isfinite(cov))):
        return xyz.mean(axis=0), np.full((3, 3), np.nan)
    weight = np.linalg.inv(cov)
    total = np.linalg.inv(weight.sum(axis=0))
    return total @ np.einsum("nij,nj->i", weight, xyz), total


def average_passes(points: Points, settings: FitSettings) -> Averaged:
    """One position a name from all its usable readings, in the order of first appearance.

    Out with a reason: `lost-beam` (no usable reading), `passes-disagree` (no majority among the readings).
    Raises StationMoved when the passes differ from each other by one common motion.
    """
    if len(set(points.names)) == len(points.names):
        return _single_readings(points)
    result, usable, numbers = Averaged(), {}, _pass_numbers(points)
    for name, rows in _by_name(points).items():
        good = [i for i in rows if not lost_beam(points.xyz_mm[i])]
        if good:
            usable[name] = good
            for i in sorted(set(rows) - set(good)):
                result.dropped.append(Rejection(name, "lost-beam", f"pass {numbers[i]} reads (0, 0, 0)"))
        else:
            result.rejected.append(
                Rejection(name, "lost-beam", f"no reading other than (0, 0, 0) in {len(rows)} pass(es)")
            )
    tables = _pass_tables(points, usable, numbers)
    scatter = _scatter_mm(tables, max((len(r) for r in usable.values()), default=1))
    pairs = sum(len(r) * (len(r) - 1) // 2 for r in usable.values())
    quantile = chi2_upper(settings.false_alarm / max(pairs, 1), 3)
    for name, rows in usable.items():
        _settle(result, name, _Readings(points, rows, [numbers[i] for i in rows]), (scatter, quantile))
    disagreeing = sum(r.reason == "passes-disagree" for r in result.rejected)
    moved = _moved_between(tables, scatter) if 2 * disagreeing > len(usable) else None
    if moved is not None:
        raise StationMoved(settings.where, "the passes differ by one common motion", value=moved, limit=4.0 * scatter)
    return result


def _single_readings(points: Points) -> Averaged:
    """`average_passes` where every point has one reading: nothing to compare, only lost beams to leave out."""
    result = Averaged()
    seen = np.all(np.isfinite(points.xyz_mm), axis=1) & np.any(points.xyz_mm != 0.0, axis=1)
    for name, xyz, cov, good in zip(points.names, points.xyz_mm, points.cov_mm2, seen, strict=True):
        if good:
            result.names.append(name)
            result.xyz_mm.append(xyz)
            result.cov_mm2.append(cov)
        else:
            result.rejected.append(Rejection(name, "lost-beam", "no reading other than (0, 0, 0) in 1 pass(es)"))
    return result


@dataclass(frozen=True)
class _Readings:
    """The usable readings of one point."""

    points: Points
    rows: list[int]
    numbers: list[int]


def _settle(result: Averaged, name: str, readings: _Readings, test: tuple[float, float]) -> None:
    """Add the mean of the agreeing majority of one point's readings, or reject the point."""
    xyz, cov = readings.points.xyz_mm[readings.rows], readings.points.cov_mm2[readings.rows]
    agree = _agreement(xyz, cov, *test)
    centre = int(np.argmax(agree.sum(axis=1)))
    keep = agree[centre] > 0.0
    if 2 * int(keep.sum()) <= len(keep) and len(keep) > 1:
        spread = float(distances(xyz).max())
        result.rejected.append(
            Rejection(name, "passes-disagree", f"readings {spread:.3f} mm apart, no majority among {len(keep)}")
        )
        return
    mean, mean_cov = mean_reading(xyz[keep], cov[keep])
    for k in np.flatnonzero(~keep):
        off = float(np.linalg.norm(xyz[k] - mean))
        result.dropped.append(
            Rejection(name, "passes-disagree", f"pass {readings.numbers[k]} is {off:.3f} mm off the others")
        )
    result.names.append(name)
    result.xyz_mm.append(mean)
    result.cov_mm2.append(mean_cov)
