"""What was wrong with a rejected point: swapped, in a wrong nest, in another unit, moved with others, or mis-aimed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.pose.clique import bits, largest_clique
from docking.pose.least_squares import Solution, design
from docking.pose.pairs import UNIT_FACTORS
from docking.pose.snooping import Pairs
from docking.pose.uncertainty import total_cov_mm2
from docking.types import Array, Pose, Rejection

_SIGMAS = 4.0
"""A point is at a place when it is this near, in sigmas of the largest point and of the pose there, all coordinates
together: few good points put a far place far off."""
_ALIKE = 2.7
"""Two points are off alike when the difference is no longer than this, in sigmas of both, all coordinates together."""
_SIMILAR = 0.35
"""What the pose leaves open between two points is granted up to this share of how far they are off: with few good
points it is much, and points that were aimed badly would come to look alike."""
_NEARER = 0.2
"""A better place must be nearer by this factor than the point's own."""


class Reasons(NamedTuple):
    """A rejection for each row that is out, in its order; the rows among them that are simply elsewhere."""

    rejected: tuple[Rejection, ...] = ()
    elsewhere: tuple[int, ...] = ()


def explain(pairs: Pairs, X_MN: Pose, out: list[int], solution: Solution | None = None) -> Reasons:
    """Why each row of `out` was put out; `solution` is how well X_MN is known, without it the pose counts as exact."""
    if not out:
        return Reasons()
    places = X_MN.apply(pairs.nominal_mm)
    cov = total_cov_mm2(pairs.nominal_cov_mm2, pairs.measured_cov_mm2, X_MN.R)
    common, size = _common_mm2(places, solution), np.trace(cov, axis1=1, axis2=2)
    own = np.diag(common)
    reach = _SIGMAS * np.sqrt(np.max(size) + own)
    nests = {i: j for i in out if (j := _nest(places, pairs.measured_mm[i], i, reach)) is not None}
    named = {i: _in_nest(pairs, nests, i) for i in nests}
    for i in out:
        factor = None if i in named else _unit(pairs.measured_mm[i], places[i], float(reach[i]))
        if factor is not None:
            named[i] = Rejection(pairs.names[i], "unit-mix-up", f"its coordinates times {factor:.6g} are at its place")
    alone = [i for i in out if i not in named]
    off = pairs.measured_mm - places
    apart = np.maximum(own[:, None] + own[None, :] - 2.0 * common, 0.0)
    far, both = np.linalg.norm(off, axis=1), size[:, None] + size[None, :]
    granted = np.minimum(_ALIKE * np.sqrt(both + apart), _SIMILAR * np.minimum(far[:, None], far[None, :]))
    groups = _groups(off, alone, np.maximum(_ALIKE * np.sqrt(both), granted))
    for group in groups:
        for i in group:
            others = ", ".join(pairs.names[k] for k in group if k != i)
            detail = f"moved by {far[i]:.3f} mm together with {others}"
            named[i] = Rejection(pairs.names[i], "moved", detail)
    for i in alone:
        detail = f"{far[i]:.3f} mm from where the other points put it"
        named.setdefault(i, Rejection(pairs.names[i], "mis-aimed", detail))
    return Reasons(tuple(named[i] for i in out), tuple(alone))


def events(pairs: Pairs, X_MN: Pose, rows: tuple[int, ...], tolerance_mm: Array) -> tuple[tuple[int, ...], ...]:
    """`rows` that are elsewhere as separate events: those that moved alike, within `tolerance_mm` (n, n), are one.

    What the pose leaves open is not granted here: a smooth field would pass for a few groups that moved.
    """
    groups = _groups(pairs.measured_mm - X_MN.apply(pairs.nominal_mm), list(rows), tolerance_mm)
    grouped = {i for group in groups for i in group}
    return (*map(tuple, groups), *((i,) for i in rows if i not in grouped))


def _common_mm2(places: Array, solution: Solution | None) -> Array:
    """Covariance (n, n) of the pose's errors at each two places (n, 3), the three coordinates added up."""
    if solution is None:
        return np.zeros((len(places), len(places)))
    a = design(places, solution.pivot_mm)
    result: Array = (a @ solution.cov).reshape(len(a), -1) @ a.reshape(len(a), -1).T
    return result


def _nest(places: Array, measured_mm: Array, i: int, reach_mm: Array) -> int | None:
    """The row whose place the point was measured at, None where it is no other's."""
    gap = np.linalg.norm(places - measured_mm, axis=1)
    own, gap[i] = float(gap[i]), np.inf
    j = int(np.argmin(gap))
    return j if gap[j] <= min(float(reach_mm[j]), _NEARER * own) else None


def _in_nest(pairs: Pairs, nests: dict[int, int], i: int) -> Rejection:
    """`swapped` when following the nests leads back to the point, else `wrong-nest`."""
    way, at = [i], nests[i]
    while at in nests and at not in way:
        way.append(at)
        at = nests[at]
    name, partner = pairs.names[i], pairs.names[nests[i]]
    if at != i:
        return Rejection(name, "wrong-nest", f"measured where {partner} should be", partner)
    ring = "" if len(way) == 2 else ", all of " + ", ".join(pairs.names[k] for k in sorted(way)) + " in a ring"
    return Rejection(name, "swapped", f"swapped with {partner}{ring}", partner)


def _unit(measured_mm: Array, place_mm: Array, reach_mm: float) -> float | None:
    """The unit's factor that brings the reading to its place, None where there is none."""
    for factor in UNIT_FACTORS:
        for f in (factor, 1.0 / factor):
            if float(np.linalg.norm(measured_mm * f - place_mm)) <= reach_mm * max(f, 1.0):
                return f
    return None


def _groups(off_mm: Array, rows: list[int], tolerance_mm: Array) -> list[list[int]]:
    """Groups of two or more of `rows` that are off by the same vector, the largest first."""
    left, groups = list(rows), []
    while len(left) > 1:
        gap = np.linalg.norm(off_mm[left][:, None] - off_mm[left][None, :], axis=2)
        near = gap <= tolerance_mm[np.ix_(left, left)]
        adj = [sum(1 << int(k) for k in np.flatnonzero(row) if k != i) for i, row in enumerate(near)]
        found = bits(largest_clique(adj))
        if len(found) < 2:
            break
        groups.append([left[k] for k in found])
        left = [i for k, i in enumerate(left) if k not in found]
    return groups
