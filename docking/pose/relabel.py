"""Do the points fit under other labels? A file in another order, or names given from the wrong end.

Asked only where the points as labelled make no sense: nothing is relabelled by itself. A triangle of measured points
is sought among all nominal triangles by the lengths of its sides; each one found is a pose, and the pose that brings
most points to places that are each other's alone is the answer.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from docking.pose.layout import MIN_POINTS
from docking.pose.pairs import distances
from docking.pose.snooping import Pairs
from docking.pose.svd import fit_svd
from docking.pose.three_point import best_triangle
from docking.types import Array, Pose

_LEAST, _MOST = 5, 60
"""Fewer points agree under other labels by chance; more are too many triangles."""
_TRIANGLES = 6
"""Triangles of measured points that are tried: one with a wrong point in it leads nowhere."""
_MOST_POSES = 2000


def relabelled(pairs: Pairs, tolerance_mm: float) -> Pose | None:
    """The pose X_MN that most points fit under other labels, or None.

    None also where two relabellings are as good (a symmetric layout), where fewer than two thirds of the points fit, or
    where three or more keep their labels: then the points as labelled have been heard.
    """
    n = len(pairs.names)
    if not _LEAST <= n <= _MOST:
        return None
    found: dict[tuple[int, ...], Pose] = {}
    for triangle in _triangles(pairs.measured_mm):
        for corners in _congruent(pairs, triangle, tolerance_mm):
            X = fit_svd(pairs.nominal_mm[list(corners)], pairs.measured_mm[list(triangle)])
            found.setdefault(_places(pairs, X, tolerance_mm), X)
    if not found:
        return None
    ranked = sorted(found, key=lambda places: -sum(i >= 0 for i in places))
    fitting = [sum(i >= 0 for i in places) for places in ranked[:2]]
    kept = sum(i == k for k, i in enumerate(ranked[0]))
    unique = len(fitting) < 2 or fitting[1] < fitting[0] or _compatible(ranked[0], ranked[1])
    enough = fitting[0] >= max(_LEAST, -(-2 * n // 3))
    if not (enough and unique and kept < MIN_POINTS):
        return None
    rows = [k for k, i in enumerate(ranked[0]) if i >= 0]
    return fit_svd(pairs.nominal_mm[[ranked[0][k] for k in rows]], pairs.measured_mm[rows])


def _compatible(one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether two assignments only differ in points that one of them does not place."""
    return all(a == b or a < 0 or b < 0 for a, b in zip(one, other, strict=True))


def _triangles(points_mm: Array) -> Iterator[tuple[int, int, int]]:
    """Large triangles of the points (n, 3); each leaves out a corner of the one before."""
    left = list(range(len(points_mm)))
    for _ in range(_TRIANGLES):
        if len(left) < MIN_POINTS:
            return
        a, b, c = best_triangle(points_mm[left])
        corners = left[a], left[b], left[c]
        yield corners
        left.remove(corners[0])


def _congruent(pairs: Pairs, triangle: tuple[int, int, int], tolerance_mm: float) -> Iterator[tuple[int, int, int]]:
    """Corners of nominal triangles with the sides of a measured one."""
    nominal, measured = distances(pairs.nominal_mm), distances(pairs.measured_mm)
    a, b, c = triangle
    ab, ac, bc = (np.abs(nominal - measured[i, j]) <= tolerance_mm for i, j in ((a, b), (a, c), (b, c)))
    sides = np.argwhere(ab)
    for i, j in sides[:_MOST_POSES].tolist():
        for k in np.flatnonzero(ac[i] & bc[j]).tolist():
            yield i, j, k


def _places(pairs: Pairs, X: Pose, tolerance_mm: float) -> tuple[int, ...]:
    """For every point the row of the nominal place where it lies, -1 where there is none or it is another's too."""
    gap = np.linalg.norm(pairs.measured_mm[:, None] - X.apply(pairs.nominal_mm)[None], axis=2)
    nearest, owner = np.argmin(gap, axis=1), np.argmin(gap, axis=0)
    rows = np.arange(len(gap))
    # A triangle's own error is carried to points far outside of it.
    good = (gap[rows, nearest] <= 3.0 * tolerance_mm) & (owner[nearest] == rows)
    return tuple(np.where(good, nearest, -1).tolist())
