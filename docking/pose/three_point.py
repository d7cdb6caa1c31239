"""Pose from three points, [Luo] method 2 (Eq. 5-8)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from docking.types import Array, Pose

_EXHAUSTIVE = 30
"""Up to this many points every triangle is looked at; above it, the triangles of this many far-apart points."""


def _far_apart(points_mm: Array, count: int) -> list[int]:
    """Indices of `count` points chosen one after another, each farthest from those before it."""
    first = int(np.argmax(np.linalg.norm(points_mm - points_mm.mean(axis=0), axis=1)))
    chosen, gap = [first], np.linalg.norm(points_mm - points_mm[first], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(points_mm - points_mm[chosen[-1]], axis=1))
    return sorted(chosen)


def best_triangle(points_mm: Array) -> tuple[int, int, int]:
    """Indices (A, B, C) of the triangle with the largest area; C and A end its longest side."""
    n = len(points_mm)
    pool = list(range(n)) if n <= _EXHAUSTIVE else _far_apart(points_mm, _EXHAUSTIVE)
    triples = np.array(list(combinations(pool, 3)))
    a, b, c = (points_mm[triples[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(a - c, b - c), axis=1)
    i, j, k = (int(v) for v in triples[int(np.argmax(area))])
    sides = [
        (float(np.linalg.norm(points_mm[x] - points_mm[z])), x, y, z) for x, y, z in ((i, j, k), (i, k, j), (j, i, k))
    ]
    _, x, y, z = max(sides)
    return x, y, z


def triangle_frame(a: Array, b: Array, c: Array) -> Pose:
    """Pose of frame 2 in the frame of the points: origin C, Y along CA, X in the plane ABC towards B, Z = X x Y."""
    y = (a - c) / np.linalg.norm(a - c)
    across = (b - c) - ((b - c) @ y) * y
    x = across / np.linalg.norm(across)
    return Pose(np.column_stack([x, y, np.cross(x, y)]), c)


def fit_three_point(nominal_mm: Array, measured_mm: Array, triangle: tuple[int, int, int] | None = None) -> Pose:
    """Pose X_MN from three of the points (n, 3); by default those that span the largest nominal triangle.

    With X_12 frame 2 in the component frame and X_32 in the assembly frame (Eq. 5, 6 with the missing L2 restored),
    R31 = R32 R12^-1 and T31 = T32 - R31 T12 (Eq. 7, 8), that is X_31 = X_32 X_12^-1.
    """
    a, b, c = best_triangle(nominal_mm) if triangle is None else triangle
    X_12 = triangle_frame(nominal_mm[a], nominal_mm[b], nominal_mm[c])
    X_32 = triangle_frame(measured_mm[a], measured_mm[b], measured_mm[c])
    return X_32 @ X_12.inverse()
