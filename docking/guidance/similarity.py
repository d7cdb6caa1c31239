"""The similarity `x = s R x' + t` between two sets of points: closed form, then Levenberg-Marquardt ([Huo] step 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from docking.geometry import exp_so3, log_so3
from docking.types import Array, Pose

_TRIALS = 600
_ROUNDS = 5
_COLLINEAR = 1e-2
"""Second against first extent of a set of points on one line."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """`x = scale R x' + t`: `scale` mm for one unit of the map."""

    scale: float
    R: Array
    t_mm: Array

    def apply(self, points: Array) -> Array:
        result: Array = self.scale * points @ self.R.T + self.t_mm
        return result

    def apply_pose(self, X: Pose) -> Pose:
        """A camera of the free map, in the cell."""
        return Pose(self.R @ X.R, self.apply(X.t_mm))


def collinear(points: Array) -> bool:
    """Whether points (k, 3) leave a rotation about a line open."""
    if len(points) < 3:
        return True
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return not bool(extent[1] > _COLLINEAR * extent[0])


def closed_form(points: Array, known: Array) -> Similarity:
    """Least squares of `|s R points + t - known|` over (..., k, 3), by Umeyama's singular values."""
    scales, R, t = _umeyama(points[None], known[None])
    return Similarity(float(scales[0]), R[0], t[0])


def _umeyama(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """(scales (n,), R (n, 3, 3), t (n, 3)) of n pairs of sets (n, k, 3)."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    da, db = a - mean_a, b - mean_b
    U, S, Vt = np.linalg.svd(np.einsum("nki,nkj->nij", db, da))
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    S[:, 2] *= sign
    U[:, :, 2] *= sign[:, None]
    R = U @ Vt
    scales = S.sum(axis=1) / np.maximum(np.einsum("nki,nki->n", da, da), 1e-300)
    t = mean_b[:, 0] - scales[:, None] * np.einsum("nij,nj->ni", R, mean_a[:, 0])
    return scales, R, t


def refined(start: Similarity, points: Array, known: Array) -> Similarity:
    """Levenberg-Marquardt on (w, t, log s) from the closed form."""

    def similarity(x: Array) -> Similarity:
        return Similarity(float(np.exp(x[6])), exp_so3(x[:3]), x[3:6])

    def residuals(x: Array) -> Array:
        result: Array = (similarity(x).apply(points) - known).ravel()
        return result

    x0 = np.array([*log_so3(start.R), *start.t_mm, np.log(start.scale)])
    return similarity(least_squares(residuals, x0, method="lm", x_scale=[1e-3] * 3 + [1.0] * 3 + [1e-3]).x)


def consistent(points: Array, known: Array, tolerance_mm: float) -> tuple[Similarity, NDArray[np.bool_]]:
    """The similarity that most points agree with, and which do (k,); three points or more that are not on one line.

    Triples are drawn with a fixed seed: the same scan gives the same answer.
    """
    rng = np.random.default_rng(0)
    k = len(points)
    triples = np.argsort(rng.random((_TRIALS, k)), axis=1)[:, :3]
    scales, R, t = _umeyama(points[triples], known[triples])
    moved = scales[:, None, None] * np.einsum("nij,kj->nki", R, points) + t[:, None]
    error = np.linalg.norm(moved - known, axis=2)
    # Truncated squares: as many as possible, and of equal numbers the nearest.
    best = int(np.argmin(np.sum(np.minimum(error, tolerance_mm) ** 2, axis=1)))
    inside: NDArray[np.bool_] = error[best] <= tolerance_mm
    answer = Similarity(float(scales[best]), R[best], t[best])
    for _ in range(_ROUNDS):
        if inside.sum() < 3 or collinear(known[inside]):
            break
        answer = closed_form(points[inside], known[inside])
        again = np.linalg.norm(answer.apply(points) - known, axis=1) <= tolerance_mm
        if np.array_equal(again, inside):
            break
        inside = again
    return answer, inside
