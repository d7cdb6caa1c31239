"""Pose from three points, [Luo] method 2 (Eq. 5-8)."""

from __future__ import annotations

from itertools import combinations, permutations

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
    """Indices (A, B, C) of the triangle with the largest area; CA is its longest side, CB its second."""
    n = len(points_mm)
    pool = list(range(n)) if n <= _EXHAUSTIVE else _far_apart(points_mm, _EXHAUSTIVE)
    triples = np.array(list(combinations(pool, 3)))
    a, b, c = (points_mm[triples[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(a - c, b - c), axis=1)
    corners = [int(v) for v in triples[int(np.argmax(area))]]
    a_c_b = max((_sides(points_mm, order), order) for order in permutations(corners))[1]
    return a_c_b[0], a_c_b[2], a_c_b[1]


def _sides(points_mm: Array, order: tuple[int, ...]) -> tuple[float, float]:
    """Lengths (AC, CB) of corners in the order A, C, B: their maximum gives the roles, whatever the points' order."""
    a, c, b = (points_mm[k] for k in order)
    return float(np.linalg.norm(a - c)), float(np.linalg.norm(b - c))


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
