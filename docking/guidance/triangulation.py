"""Points from rays of known cameras. [Huo] step 2: the direct linear transform (DLT) over all views of a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.types import Array, Pose


def dlt(poses: list[Pose], rays: Array) -> Array:
    """The point (3,) seen from cameras X_WC along normalised coordinates `rays` (k, 2): last row of V^T of the SVD."""
    rows = []
    for X_WC, (x, y) in zip(poses, rays, strict=True):
        P = X_WC.inverse().matrix()[:3]
        rows += [x * P[2] - P[0], y * P[2] - P[1]]
    A = np.array(rows)
    # Columns of like size: the translation column is in mm, the others are direction cosines.
    scale = np.abs(A).max(axis=0)
    solution = np.linalg.svd(A / scale)[2][-1] / scale
    result: Array = solution[:3] / solution[3]
    return result


def triangulate(R: Array, t: Array, rays: Array, rows: NDArray[np.integer], count: int) -> Array:
    """Points (count, 3) from observations (o, 2) of normalised coordinates, each in a camera `p_C = R p_W + t`.

    `rows` (o,) names the point of each observation. The DLT in its normal form, the rows of the second pass divided by
    the depths of the first, so that every view counts by its angle. A point with parallel rays comes out NaN or far.
    """
    depth = np.ones(len(rays))
    points = np.full((count, 3), np.nan)
    for _ in range(2):
        a = (rays[:, :1] * R[:, 2] - R[:, 0]) / depth[:, None]
        b = (rays[:, 1:] * R[:, 2] - R[:, 1]) / depth[:, None]
        c = -(rays[:, 0] * t[:, 2] - t[:, 0]) / depth
        d = -(rays[:, 1] * t[:, 2] - t[:, 1]) / depth
        N = np.zeros((count, 3, 3))
        h = np.zeros((count, 3))
        for i in range(3):
            h[:, i] = np.bincount(rows, a[:, i] * c + b[:, i] * d, count)
            for j in range(i, 3):
                sums = np.bincount(rows, a[:, i] * a[:, j] + b[:, i] * b[:, j], count)
                N[:, i, j] = N[:, j, i] = sums
        solvable = np.linalg.cond(N) < 1e12
        points[solvable] = np.linalg.solve(N[solvable], h[solvable][..., None])[..., 0]
        points[~solvable] = np.nan
        local = points[rows]
        depth = np.einsum("oj,oj->o", R[:, 2], np.nan_to_num(local)) + t[:, 2]
        depth = np.where(np.abs(depth) > 1e-9, depth, 1.0)
    return points


def parallax_deg(a: Array, b: Array, points: Array) -> Array:
    """Angles (k,) between the rays from two camera positions (3,) to points (k, 3)."""
    u, v = points - a, points - b
    cos = np.einsum("ki,ki->k", u, v) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    result: Array = np.degrees(np.arccos(np.clip(cos, -1.0, 1.0)))
    return result
