"""The pose of one camera from points of the map and where they are seen: robust least squares and its covariance.

Steps are Gauss-Newton with Tukey's weights on whitened residuals (iteratively reweighted least squares).
A pose is perturbed in the camera: `p_C -> p_C - w x p_C - v`, that is X_WC exp([w, v]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.errors import NotLocalised
from docking.geometry import exp_so3, skew
from docking.guidance.types import Camera
from docking.types import Array, Pose

TUKEY = 4.685
"""Tukey's limit for 95 % efficiency, in sigmas."""
_ROUNDS = 12
_STILL = 1e-5
"""A step of so many mm and mrad is the last."""
_BLOCKS = 4
"""The image is cut into _BLOCKS x _BLOCKS parts whose residuals count as one observation each in the covariance."""

_ENOUGH = 200
"""So many points tell two poses apart."""
_ALIKE, _APART = 1.25, 0.02
"""A second pose fits too when its rms is at most so many times the first one's; so many depths away it is another."""


@dataclass(frozen=True, eq=False)
class Sights:
    """Map points seen: `points_mm` (n, 3) in W, `pixels` (n, 2) as seen, `sigma_px` (n,)."""

    points_mm: Array
    pixels: Array
    sigma_px: Array

    def __len__(self) -> int:
        return len(self.points_mm)

    def where(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Sights:
        """The rows `keep`."""
        return Sights(self.points_mm[keep], self.pixels[keep], self.sigma_px[keep])


@dataclass(frozen=True, eq=False)
class CameraFit:
    """X_WC with `cov` (6, 6) of [rotation rad, shift mm] in the camera's frame.

    `inside` (n,) marks the sights within Tukey's limit; `rms_px` of those.
    """

    X_WC: Pose
    cov: Array
    inside: NDArray[np.bool_]
    rms_px: float


def residuals(camera: Camera, X_WC: Pose, sights: Sights) -> tuple[Array, Array]:
    """Pixels (n, 2) seen minus projected, and the points (n, 3) in the camera; NaN for a point that is not in front."""
    p = X_WC.inverse().apply(sights.points_mm)
    return sights.pixels - camera.project(p), p


def jacobian(camera: Camera, p_C: Array) -> Array:
    """d(projected pixel) / d[w, v] (n, 2, 6) at points (n, 3) in the camera.

    The distortion is left out of the slope: that changes the steps, not where they end.
    """
    x, y, z = p_C.T
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v = x / z, y / z
        d = np.zeros((len(p_C), 2, 3))
        d[:, 0, 0], d[:, 0, 2] = camera.fx_px / z, -camera.fx_px * u / z
        d[:, 1, 1], d[:, 1, 2] = camera.fy_px / z, -camera.fy_px * v / z
    # p' = p - w x p - v, so dp/dw = [p]x and dp/dv = -1.
    result: Array = d @ np.concatenate([skew(p_C), np.broadcast_to(-np.eye(3), (len(p_C), 3, 3))], axis=2)
    return result


def perturbed(X_WC: Pose, step: Array) -> Pose:
    """X_WC exp(step), first order in the shift: the pose moved by [w rad, v mm] in the camera's frame."""
    return X_WC @ Pose(exp_so3(step[:3]), step[3:])


def refine(camera: Camera, X_WC: Pose, sights: Sights) -> CameraFit:
    """The pose that minimises Tukey's loss of the whitened residuals, from a start inside a few tens of pixels.

    Raises NotLocalised when the points leave the pose undecided.
    """
    for _ in range(_ROUNDS):
        error, p_C = residuals(camera, X_WC, sights)
        weight = _weights(error, sights.sigma_px)
        J = jacobian(camera, p_C)
        J[weight == 0.0] = 0.0
        WJ = J * weight[:, None, None]
        step = _solved(np.einsum("nij,nik->jk", WJ, J), np.einsum("nij,ni->j", WJ, np.nan_to_num(error)))
        X_WC = perturbed(X_WC, step)
        if float(np.max(np.abs(step) * [1e3, 1e3, 1e3, 1.0, 1.0, 1.0])) < _STILL:
            break
    return _fitted(camera, X_WC, sights)


def _weights(error: Array, sigma_px: Array) -> Array:
    """Tukey's weights / sigma^2 (n,); the scale is the median of the residuals, never less than half their sigma."""
    size = np.linalg.norm(error, axis=1) / sigma_px
    size = np.where(np.isfinite(size), size, np.inf)
    # 1.177 is the median of the length of a normal vector of the plane.
    scale = max(0.5, float(np.median(size[size < np.inf])) / 1.177) if np.any(size < np.inf) else 1.0
    ratio = np.minimum(size / (TUKEY * scale), 1.0)
    result: Array = (1.0 - ratio**2) ** 2 / sigma_px**2
    return result


def _solved(H: Array, g: Array) -> Array:
    try:
        result = np.asarray(np.linalg.solve(H, g), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise NotLocalised("image", "the points do not decide the pose", value=0, limit=4) from error
    return result


def _fitted(camera: Camera, X_WC: Pose, sights: Sights) -> CameraFit:
    """Covariance by clusters: residuals of one part of the image share errors of camera and map, so a part counts once.

    cov = H^-1 (sum_b g_b g_b^T) H^-1 * b / (b - 1) with g_b the sum of the weighted gradients in part b; the covariance
    of independent pixels is added, so that it is never less.
    """
    error, p_C = residuals(camera, X_WC, sights)
    weight = _weights(error, sights.sigma_px)
    inside = weight > 0.0
    if np.count_nonzero(inside) < 4:
        raise NotLocalised("image", "the points do not decide the pose", value=int(np.count_nonzero(inside)), limit=4)
    J = jacobian(camera, p_C)[inside]
    gradient = np.einsum("nij,ni,n->nj", J, error[inside], weight[inside])
    inverse = np.linalg.pinv(np.einsum("nij,nik,n->jk", J, J, weight[inside]))
    block = _block(camera, sights.pixels[inside])
    sums = np.zeros((_BLOCKS * _BLOCKS, 6))
    np.add.at(sums, block, gradient)
    filled = len(np.unique(block))
    clustered = inverse @ (sums.T @ sums) @ inverse * (filled / max(1, filled - 1))
    rms_px = float(np.sqrt(np.mean(np.sum(error[inside] ** 2, axis=1))))
    return CameraFit(X_WC, clustered + inverse, inside, rms_px)


def focal_misfit(camera: Camera, fit: CameraFit, sights: Sights) -> tuple[float, float]:
    """(change of log f that the sights ask for, its sigma): one step of pose and focal length together from `fit`.

    Its sigma by the same clusters as the pose's; large where what is seen is flat and faces the camera.
    """
    chosen = sights.where(fit.inside)
    error, p_C = residuals(camera, fit.X_WC, chosen)
    weight = _weights(error, chosen.sigma_px)
    larger = camera.project(p_C) - (camera.cx_px, camera.cy_px)
    J = np.concatenate([jacobian(camera, p_C), larger[:, :, None]], axis=2)
    try:
        inverse = np.linalg.inv(np.einsum("nij,nik,n->jk", J, J, weight))
    except np.linalg.LinAlgError:
        return 0.0, float("inf")
    step = inverse @ np.einsum("nij,ni,n->j", J, error, weight)
    left = np.einsum("nij,ni,n->nj", J, error - J @ step, weight)
    sums = np.zeros((_BLOCKS * _BLOCKS, 7))
    np.add.at(sums, _block(camera, chosen.pixels), left)
    variance = (inverse @ (sums.T @ sums) @ inverse + inverse)[6, 6]
    return float(step[6]), float(np.sqrt(variance))


def _block(camera: Camera, pixels: Array) -> NDArray[np.intp]:
    share = np.clip(pixels / (camera.width_px, camera.height_px), 0.0, 0.999)
    column, row = (share * _BLOCKS).astype(np.intp).T
    return row * _BLOCKS + column  # type: ignore[no-any-return]


def seen_sigma_mm(cov: Array, p_C: Array) -> float:
    """Standard deviation, mm, of where a point p_C (3,) of the camera's frame is seen, across the line of sight.

    An error along the line of sight is not seen in the picture. The largest eigenvalue of the two across counts.
    """
    toward = p_C / np.linalg.norm(p_C)
    across = np.linalg.svd(toward[None, :])[2][1:]
    D = across @ np.concatenate([skew(p_C), -np.eye(3)], axis=1)
    return float(np.sqrt(np.linalg.eigvalsh(D @ cov @ D.T)[-1]))


def second_pose(camera: Camera, fit: CameraFit, sights: Sights) -> bool:
    """Whether the points fit nearly as well from the pose mirrored at the line of sight.

    A flat patch that fills little of the image looks nearly the same with its normal n and with n mirrored at the line
    of sight s: the camera turned about the patch's middle by the rotation that takes n to 2 (n.s) s - n.
    """
    rows = np.flatnonzero(fit.inside)
    patch = sights.where(rows[:: max(1, len(rows) // _ENOUGH)])
    p_C = fit.X_WC.inverse().apply(patch.points_mm)
    middle = p_C.mean(axis=0)
    normal = np.linalg.svd(p_C - middle, full_matrices=False)[2][2]
    toward = middle / np.linalg.norm(middle)
    mirrored = 2.0 * float(normal @ toward) * toward - normal
    turn = np.cross(normal, mirrored)
    angle = float(np.arctan2(np.linalg.norm(turn), normal @ mirrored))
    R = exp_so3(turn / max(float(np.linalg.norm(turn)), 1e-12) * angle)
    start = fit.X_WC @ Pose(R, middle - R @ middle).inverse()
    try:
        other = refine(camera, start, patch)
    except NotLocalised:
        return False
    apart = float(np.linalg.norm(other.X_WC.t_mm - fit.X_WC.t_mm))
    alike = other.rms_px <= _ALIKE * fit.rms_px and np.count_nonzero(other.inside) >= len(patch) / _ALIKE
    return bool(alike and apart > _APART * float(np.linalg.norm(middle)))
