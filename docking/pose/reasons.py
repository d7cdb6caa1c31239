"""What was wrong with a rejected point: swapped, in a wrong nest, in another unit, moved with others, or mis-aimed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.pose.clique import bits, largest_clique
from docking.pose.pairs import UNIT_FACTORS
from docking.pose.snooping import Pairs
from docking.pose.uncertainty import total_cov_mm2
from docking.types import Array, Pose, Rejection

_SIGMAS = 4.0
"""A point is at a place when it is this near, in sigmas of the largest point, all coordinates together."""
_NEARER = 0.2
"""A better place must be nearer by this factor than the point's own."""


class Reasons(NamedTuple):
    """A rejection for each row that is out, in its order; the rows that are simply elsewhere, those that moved alike
    together."""

    rejected: tuple[Rejection, ...] = ()
    events: tuple[tuple[int, ...], ...] = ()


def explain(pairs: Pairs, X_MN: Pose, out: list[int], tolerance_mm: Array) -> Reasons:
    """Why each row of `out` was put out; `tolerance_mm` (n, n) are the permitted pair differences."""
    if not out:
        return Reasons()
    places = X_MN.apply(pairs.nominal_mm)
    cov = total_cov_mm2(pairs.nominal_cov_mm2, pairs.measured_cov_mm2, X_MN.R)
    reach = _SIGMAS * float(np.sqrt(np.max(np.trace(cov, axis1=1, axis2=2))))
    nests = {i: j for i in out if (j := _nest(places, pairs.measured_mm[i], i, reach)) is not None}
    named = {i: _in_nest(pairs, nests, i) for i in nests}
    for i in out:
        factor = None if i in named else _unit(pairs.measured_mm[i], places[i], reach)
        if factor is not None:
            named[i] = Rejection(pairs.names[i], "unit-mix-up", f"its coordinates times {factor:.6g} are at its place")
    alone = [i for i in out if i not in named]
    off = pairs.measured_mm - places
    groups = _groups(off, alone, tolerance_mm)
    for group in groups:
        for i in group:
            others = ", ".join(pairs.names[k] for k in group if k != i)
            size = float(np.linalg.norm(off[i]))
            named[i] = Rejection(pairs.names[i], "moved", f"moved by {size:.3f} mm together with {others}")
    for i in alone:
        detail = f"{float(np.linalg.norm(off[i])):.3f} mm from where the other points put it"
        named.setdefault(i, Rejection(pairs.names[i], "mis-aimed", detail))
    grouped = {i for group in groups for i in group}
    events = (*map(tuple, groups), *((i,) for i in alone if i not in grouped))
    return Reasons(tuple(named[i] for i in out), events)


def _nest(places: Array, measured_mm: Array, i: int, reach_mm: float) -> int | None:
    """The row whose place the point was measured at, None where it is no other's."""
    gap = np.linalg.norm(places - measured_mm, axis=1)
    own, gap[i] = float(gap[i]), np.inf
    j = int(np.argmin(gap))
    return j if gap[j] <= min(reach_mm, _NEARER * own) else None


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
