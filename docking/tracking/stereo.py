"""A calibrated camera pair: pixel tracks to points in W with covariance.

A point is where both rays come nearest to it in pixels: Gauss-Newton on the four residuals from the midpoint of the
rays. With J (4, 3) the derivative of both projections by the point and S the variance of the pixels,

    cov = (J^T S^-1 J)^-1

A point lost in either camera is occluded; one whose rays miss each other by more than the noise explains is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument
from docking.types import Array, Pose, _Frozen

UNDISTORT_STEPS = 20
NEWTON_STEPS = 8
SMALL_MM = 1e-6
LEAST_PARALLAX_RAD = 1e-3
"""Rays more nearly parallel than this say nothing about the distance."""


@dataclass(frozen=True, eq=False)
class StereoCamera(_Frozen):
    """One camera of a pair: focal lengths and principal point (px), Brown's distortion (5,) k1, k2, p1, p2, k3, pose
    `X_WK` of the camera's frame K (x right, y down, z ahead), noise of a pixel coordinate `pixel_sigma`."""

    name: str
    focal_px: Array
    centre_px: Array
    distortion: Array
    X_WK: Pose
    pixel_sigma: float = 0.2

    def project(self, p_W_mm: Array) -> tuple[Array, Array]:
        """Pixels (k, 2) of points (k, 3) and their derivatives (k, 2, 3); NaN behind the camera."""
        R = self.X_WK.R
        p = (p_W_mm - self.X_WK.t_mm) @ R
        z = np.where(p[:, 2] > 0.0, p[:, 2], np.nan)
        xy = p[:, :2] / z[:, None]
        bent, by_xy = self._bent(xy)
        by_p = np.zeros((len(p), 2, 3))
        by_p[:, 0, 0] = by_p[:, 1, 1] = 1.0 / z
        by_p[:, :, 2] = -xy / z[:, None]
        return bent * self.focal_px + self.centre_px, self.focal_px[:, None] * (by_xy @ by_p @ R.T)

    def rays(self, pixels: Array) -> Array:
        """Unit directions (k, 3) in W of pixels (k, 2)."""
        bent = (pixels - self.centre_px) / self.focal_px
        xy = bent.copy()
        for _ in range(UNDISTORT_STEPS):
            image, by_xy = self._bent(xy)
            xy = xy + np.linalg.solve(by_xy, (bent - image)[:, :, None])[:, :, 0]
        d = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        result: Array = d / np.linalg.norm(d, axis=1, keepdims=True) @ self.X_WK.R.T
        return result

    def _bent(self, xy: Array) -> tuple[Array, Array]:
        """Distorted image coordinates (k, 2) and their derivatives (k, 2, 2)."""
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
        cross = slope * x * y + 2.0 * (p1 * x + p2 * y)
        bent = np.stack([
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ], axis=1)  # fmt: skip
        jac = np.empty((len(xy), 2, 2))
        jac[:, 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        jac[:, 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        jac[:, 0, 1] = jac[:, 1, 0] = cross
        return bent, jac


@dataclass(frozen=True, eq=False)
class Triangulated(_Frozen):
    """Points (k, 3) in W with covariances (k, 3, 3), and how far their rays miss each other, `chi2` (k,) with one
    degree of freedom; NaN where no point is."""

    xyz_W_mm: Array
    cov_mm2: Array
    chi2: Array

    def agreeing(self, gate: float = 16.0) -> NDArray[np.bool_]:
        """(k,): points whose rays meet within the noise, by default within four sigma."""
        return np.asarray(self.chi2 <= gate)


def triangulate(first: StereoCamera, second: StereoCamera, pixels: tuple[Array, Array]) -> Triangulated:
    """Points from their pixels (k, 2) in both cameras; NaN where a pixel is. Raises BadArgument where the cameras stand
    at one place."""
    if not (np.linalg.norm(first.X_WK.t_mm - second.X_WK.t_mm) > 0.0):
        raise BadArgument(f"{first.name}, {second.name}", "both cameras stand at one place")
    k = len(pixels[0])
    xyz, cov, chi2 = np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan), np.full(k, np.nan)
    both = np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
    seen = pixels[0][both], pixels[1][both]
    if not both.any():
        return Triangulated(xyz, cov, chi2)
    p, usable = _midpoints(first, second, seen)
    weights = np.repeat([first.pixel_sigma**-2, second.pixel_sigma**-2], 2)
    for _ in range(NEWTON_STEPS):
        residual, jac = _residuals(first, second, seen, p)
        normal = np.einsum("kri,r,krj->kij", jac, weights, jac)
        # Where a point is not to be had the step is none, and the answer NaN.
        fine = usable & np.isfinite(normal).all(axis=(1, 2)) & (np.linalg.det(np.nan_to_num(normal)) > 0.0)
        normal[~fine] = np.eye(3)
        step = np.linalg.solve(normal, np.einsum("kri,r,kr->ki", jac, weights, residual)[:, :, None])[:, :, 0]
        step[~fine] = 0.0
        p = p + step
        if np.abs(step).max() <= SMALL_MM:
            break
    residual, _ = _residuals(first, second, seen, p)
    rows = np.flatnonzero(both)[fine]
    xyz[rows], cov[rows] = p[fine], np.linalg.inv(normal[fine])
    chi2[rows] = (weights * residual[fine] ** 2).sum(axis=1)
    return Triangulated(xyz, cov, chi2)


def _midpoints(
    first: StereoCamera, second: StereoCamera, pixels: tuple[Array, Array]
) -> tuple[Array, NDArray[np.bool_]]:
    """Where both rays are nearest to each other (k, 3), and whether that lies ahead of both at a usable angle."""
    a, b = first.rays(pixels[0]), second.rays(pixels[1])
    apart = second.X_WK.t_mm - first.X_WK.t_mm
    c = np.einsum("ki,ki->k", a, b)
    sine2 = 1.0 - c * c
    usable = sine2 >= LEAST_PARALLAX_RAD**2
    safe = np.where(usable, sine2, 1.0)
    da, db = a @ apart, b @ apart
    along_a, along_b = (da - c * db) / safe, (c * da - db) / safe
    p = 0.5 * (first.X_WK.t_mm + along_a[:, None] * a + second.X_WK.t_mm + along_b[:, None] * b)
    return p, usable & (along_a > 0.0) & (along_b > 0.0)


def _residuals(first: StereoCamera, second: StereoCamera, pixels: tuple[Array, Array], p: Array) -> tuple[Array, Array]:
    """Seen minus projected (k, 4) and the derivatives of the projections (k, 4, 3)."""
    (u, ju), (v, jv) = first.project(p), second.project(p)
    residual = np.concatenate([pixels[0] - u, pixels[1] - v], axis=1)
    jac = np.concatenate([ju, jv], axis=1)
    lost = ~np.isfinite(residual).all(axis=1)
    residual[lost], jac[lost] = 0.0, 0.0
    return residual, jac
