"""Rigid fits of many epochs at once: the equally or per-point weighted optimum of [Luo] Eq. 9, vectorised.

The rotation is the eigenvector of Horn's symmetric 4 x 4 matrix to its largest eigenvalue (Horn 1987): the eigenvalue
by Newton's method on the characteristic quartic from an upper bound (Theobald 2005), the vector from the adjugate,
then one Newton step on SO(3) that restores full precision. Mirror solutions cannot arise: a quaternion is a rotation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.errors import DegenerateTargets
from docking.pose.layout import check_layout
from docking.pose.settings import FitSettings
from docking.types import Array

_BLOCK = 4096
"""Epochs worked on together: their intermediate arrays stay in the cache."""
_NEWTON = 40
_NEAR = 1e-6
"""Newton's last step: the next would be its square, and the polish squares the error of the vector once more."""
_SMALL_TURN = 1e-7
_TINY = 1e-300
_POLISH_STEPS = 3
_LOOSE = 1e-12
"""Product of the sums of two singular values of H (|H| = 1) below which an axis of rotation is arbitrary."""


class PoseBatch(NamedTuple):
    """Poses X_MN of B epochs: `R` (B, 3, 3), `t_mm` (B, 3), so that `P = R J + t`."""

    R: Array
    t_mm: Array


def fit_poses(nominal_mm: Array, measured_mm: Array, weights: Array | None = None) -> PoseBatch:
    """Fit every epoch of `measured_mm` (B, n, 3) in M to the same `nominal_mm` (n, 3) in N; weights (n,) of the points.

    Raises TooFewPoints, DegenerateTargets: for the nominal layout, or for the first epoch whose measured points leave
    the rotation open. An epoch with NaN gives NaN poses.
    """
    check_layout(nominal_mm, FitSettings())
    w = np.full(len(nominal_mm), 1.0 / len(nominal_mm)) if weights is None else weights / weights.sum()
    j0 = w @ nominal_mm
    gather = _gathering(w, nominal_mm - j0)
    flat = np.ascontiguousarray(measured_mm, dtype=np.float64).reshape(len(measured_mm), -1)
    R, t = np.empty((len(flat), 3, 3)), np.empty((len(flat), 3))
    for begin in range(0, len(flat), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        sums = (flat[rows] @ gather).T
        R[rows] = _rotations(np.ascontiguousarray(sums[:9]), begin)
        t[rows] = sums[9:].T - R[rows] @ j0
    return PoseBatch(R, t)


def three_point_poses(nominal_mm: Array, measured_mm: Array, triangle: tuple[int, int, int]) -> PoseBatch:
    """[Luo] Eq. 5-8 for every epoch of `measured_mm` (B, n, 3): poses from the corners A, B, C of `nominal_mm` (n, 3).

    The corners must span a triangle, as `fit_three_point` needs it for one epoch.
    """
    R_12, c_12 = _triangle_frames(nominal_mm[None, list(triangle)])
    R_32, c_32 = _triangle_frames(measured_mm[:, list(triangle)])
    R = R_32 @ R_12[0].T
    return PoseBatch(R, c_32 - R @ c_12[0])


def _triangle_frames(corners_mm: Array) -> tuple[Array, Array]:
    """Axes (B, 3, 3) and origins (B, 3) of frame 2 of the corners (B, 3, 3) A, B, C: see `triangle_frame`."""
    a, b, c = (corners_mm[:, k] for k in range(3))
    y = (a - c) / np.linalg.norm(a - c, axis=1, keepdims=True)
    across = (b - c) - np.sum((b - c) * y, axis=1, keepdims=True) * y
    x = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=2), c


def _gathering(w: Array, centred_mm: Array) -> Array:
    """(3n, 12): one product with the epochs' coordinates gives H = sum w (J - J') P^T row by row, and the centroid.

    The nominal points are centred, so the measured ones need not be.
    """
    n = len(w)
    columns = np.zeros((n, 3, 12))
    for c in range(3):
        columns[:, c, [c, 3 + c, 6 + c]] = w[:, None] * centred_mm
        columns[:, c, 9 + c] = w
    return columns.reshape(3 * n, 12)


def _rotations(h: Array, first: int) -> Array:
    """Rotations (b, 3, 3) that maximise tr(R H) for correlations `h` (9, b) = H[a, c] row by row."""
    h = h / np.sqrt(np.einsum("kb,kb->b", h, h))
    k = _horn(h)
    lam = _largest_eigenvalue(h, k)
    R = _matrix(_eigenvector(k, lam))
    for _ in range(_POLISH_STEPS):
        R, turn, firmness = _polished(R, h)
        if not (np.nanmax(turn, initial=0.0) > _SMALL_TURN):
            break
    loose = np.flatnonzero(firmness <= _LOOSE)
    if loose.size:
        where = f"epoch {first + int(loose[0])}"
        cause = "the measured points leave the rotation open"
        raise DegenerateTargets(where, cause, value=float(firmness[loose[0]]), limit=_LOOSE)
    return np.ascontiguousarray(R.reshape(9, -1).T).reshape(-1, 3, 3)


def _horn(h: Array) -> Array:
    """The ten entries (10, b) of Horn's symmetric matrix: diagonal 0..3, then 01 02 03 12 13 23."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = h
    return np.stack(
        (
            xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy,
            yz - zy, zx - xz, xy - yx, xy + yx, zx + xz, yz + zy,
        )
    )  # fmt: skip


def _largest_eigenvalue(h: Array, k: Array) -> Array:
    """Newton from above on l^4 - 2 |H|^2 l^2 - 8 det(H) l + det(K) (b,), with |H| = 1.

    The quartic is convex beyond its largest root, the sum of the singular values of H (the last with the sign of
    det H), which is at most sqrt(3): the iteration comes from there and never overshoots.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = h
    c1 = -8.0 * (xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx))
    c0 = _determinant(k)
    lam = np.full(h.shape[1], np.sqrt(3.0))
    for _ in range(_NEWTON):
        square = lam * lam
        slope = 4.0 * lam * (square - 1.0) + c1
        step = ((square - 2.0) * square + c1 * lam + c0) / np.where(slope > 0.0, slope, np.inf)
        lam = lam - step
        if not (np.nanmax(np.abs(step), initial=0.0) > _NEAR):
            break
    result: Array = lam
    return result


def _determinant(k: Array) -> Array:
    """Determinants (b,) by 2 x 2 minors of the first two and the last two rows (Laplace)."""
    a, b, c, d, e, f, g, p, q, r = k
    result: Array = (
        (a * b - e * e) * (c * d - r * r) - (a * p - f * e) * (p * d - q * r) + (a * q - g * e) * (p * r - q * c)
        + (e * p - f * b) * (f * d - g * r) - (e * q - g * b) * (f * r - g * c) + (f * q - g * p) ** 2
    )  # fmt: skip
    return result


def _eigenvector(k: Array, lam: Array) -> Array:
    """Unit eigenvectors (4, b) from the longest column of the adjugate of K - lambda."""
    a, b, c, d = (k[i] - lam for i in range(4))
    e, f, g, p, q, r = k[4:]
    cd, pd, pr = c * d - r * r, p * d - q * r, p * r - q * c
    fd, fr, gp = f * d - g * r, f * r - g * c, f * q - g * p
    n11, n12 = b * cd - p * pd + q * pr, -(e * cd - p * fd + q * fr)
    n13, n14 = e * pd - b * fd + q * gp, -(e * pr - b * fr + p * gp)
    n22 = a * cd - f * fd + g * fr
    n23 = -(a * pd - e * fd + g * gp)
    n24 = a * pr - e * fr + f * gp
    n33 = a * (b * d - q * q) - e * (e * d - q * g) + g * (e * q - b * g)
    n34 = -(a * (b * r - p * q) - e * (e * r - p * g) + f * (e * q - b * g))
    n44 = a * (b * c - p * p) - e * (e * c - p * f) + f * (e * p - b * f)
    table = np.stack(
        (n11, n12, n13, n14, n12, n22, n23, n24, n13, n23, n33, n34, n14, n24, n34, n44)
    ).reshape(4, 4, -1)  # fmt: skip
    best = np.argmax(np.abs(np.stack((n11, n22, n33, n44))), axis=0)
    column = np.take_along_axis(table, best[None, None, :], axis=0)[0]
    square = np.einsum("ib,ib->b", column, column)
    result: Array = column / np.sqrt(np.maximum(square, _TINY))
    return result


def _matrix(quaternion: Array) -> Array:
    """Rotations (3, 3, b) of unit quaternions (4, b), scalar first."""
    w, x, y, z = quaternion
    return np.stack(
        (
            1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
        )
    ).reshape(3, 3, -1)  # fmt: skip


def _polished(rotation: Array, h: Array) -> tuple[Array, Array, Array]:
    """One Newton step on SO(3) for rotations (3, 3, b): the better ones, the turns (3, b), and how firm they are (b,).

    With M = R H, the turn is w = (tr(M) I - sym M)^-1 vee(M), applied as a Cayley rotation.
    """
    m = np.einsum("ijb,jkb->ikb", rotation, h.reshape(3, 3, -1))
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    xx, yy, zz = trace - m[0, 0], trace - m[1, 1], trace - m[2, 2]
    xy, xz, yz = -0.5 * (m[0, 1] + m[1, 0]), -0.5 * (m[0, 2] + m[2, 0]), -0.5 * (m[1, 2] + m[2, 1])
    vx, vy, vz = m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * a + xy * b + xz * c
    half = 0.5 / np.where(det > _TINY, det, np.inf)
    wx = half * (a * vx + b * vy + c * vz)
    wy = half * (b * vx + (xx * zz - xz * xz) * vy + (xy * xz - xx * yz) * vz)
    wz = half * (c * vx + (xy * xz - xx * yz) * vy + (xx * yy - xy * xy) * vz)
    norm = 1.0 / np.sqrt(1.0 + wx * wx + wy * wy + wz * wz)
    turn = _matrix(np.stack((norm, wx * norm, wy * norm, wz * norm)))
    return np.einsum("ijb,jkb->ikb", turn, rotation), np.abs(np.stack((wx, wy, wz))), det
