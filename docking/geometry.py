"""Rotations and rigid poses: rotation vectors, Euler angles at the border.

Rotation vectors are rad, Euler angles (alpha, beta, gamma) follow [Luo]: `R = Rz(gamma) Ry(beta) Rx(alpha)`,
rotations about the fixed axes X, Y, Z in this order.
"""

from __future__ import annotations

from math import atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from docking.types import Array, Pose

_GIMBAL_COS = 1e-9
"""cos(beta) below which alpha and gamma are no longer told apart in double precision."""


class EulerAngles(NamedTuple):
    """[Luo]'s angles in rad. `gimbal_lock`: beta is +-90 deg, only alpha -+ gamma is known and alpha is set to 0."""

    alpha_rad: float
    beta_rad: float
    gamma_rad: float
    gimbal_lock: bool


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(a) @ b = a x b`."""
    a = np.asarray(v, dtype=np.float64)
    m = np.zeros((*a.shape, 3))
    m[..., 0, 1], m[..., 0, 2] = -a[..., 2], a[..., 1]
    m[..., 1, 0], m[..., 1, 2] = a[..., 2], -a[..., 0]
    m[..., 2, 0], m[..., 2, 1] = -a[..., 1], a[..., 0]
    return m


def exp_so3(rotvec_rad: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), Rodrigues' formula; exact to rounding at 0."""
    w = np.asarray(rotvec_rad, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    k = skew(w)
    if angle < 1e-4:  # series: the closed coefficients lose digits here
        a, b = 1.0 - angle**2 / 6.0 + angle**4 / 120.0, 0.5 - angle**2 / 24.0 + angle**4 / 720.0
    else:
        half = sin(angle / 2.0) / angle
        a, b = sin(angle) / angle, 2.0 * half * half
    result: Array = np.eye(3) + a * k + b * (k @ k)
    return result


def _quaternion(R: Array) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix; Shepperd's choice of the largest element."""
    trace = float(np.trace(R))
    choice = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    i = int(np.argmax(choice))
    q = np.empty(4)
    if i == 0:
        q[:] = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        a, b, c = i - 1, i % 3, (i + 1) % 3
        q[0] = R[c, b] - R[b, c]
        q[1 + a] = 1.0 + R[a, a] - R[b, b] - R[c, c]
        q[1 + b] = R[b, a] + R[a, b]
        q[1 + c] = R[c, a] + R[a, c]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0.0 else -q


def log_so3(R: ArrayLike) -> Array:
    """Rotation vector (3,) in rad, length 0..pi, of a rotation matrix (3, 3); accurate near 0 and near pi."""
    q = _quaternion(np.asarray(R, dtype=np.float64))
    s = float(np.linalg.norm(q[1:]))
    length = 2.0 if s < 1e-9 else 2.0 * atan2(s, float(q[0])) / s
    result: Array = length * q[1:]
    return result


def rotation_angle(R: ArrayLike) -> float:
    """Angle of a rotation matrix, rad, 0..pi."""
    return float(np.linalg.norm(log_so3(R)))


def euler_to_matrix(alpha_rad: float, beta_rad: float, gamma_rad: float) -> Array:
    """R (3, 3) = Rz(gamma) Ry(beta) Rx(alpha), [Luo] Eq. 2."""
    sa, ca = sin(alpha_rad), cos(alpha_rad)
    sb, cb = sin(beta_rad), cos(beta_rad)
    sg, cg = sin(gamma_rad), cos(gamma_rad)
    return np.array(
        [
            [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa],
            [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa],
            [-sb, cb * sa, cb * ca],
        ]
    )


def matrix_to_euler(R: ArrayLike) -> EulerAngles:
    """[Luo] Eq. 4, corrected: alpha = atan2(R32, R33), beta = atan2(-R31, hypot(R11, R21)), gamma = atan2(R21, R11).

    At beta = +-90 deg only alpha -+ gamma is defined: alpha is set to 0 and `gimbal_lock` says so.
    """
    m = np.asarray(R, dtype=np.float64)
    cos_beta = hypot(m[0, 0], m[1, 0])
    beta = atan2(-m[2, 0], cos_beta)
    if cos_beta < _GIMBAL_COS:
        return EulerAngles(0.0, beta, atan2(-m[0, 1], m[1, 1]), True)
    return EulerAngles(atan2(m[2, 1], m[2, 2]), beta, atan2(m[1, 0], m[0, 0]), False)


def pose_from_vector(vector: ArrayLike) -> Pose:
    """Pose of the border form [x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg]."""
    v = np.asarray(vector, dtype=np.float64)
    return Pose(euler_to_matrix(*(radians(float(a)) for a in v[3:])), v[:3])


def pose_to_vector(X: Pose) -> Array:
    """Border form (6,) [x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg] of a pose; alpha = 0 in gimbal lock."""
    e = matrix_to_euler(X.R)
    return np.array([*X.t_mm, degrees(e.alpha_rad), degrees(e.beta_rad), degrees(e.gamma_rad)])


def rms(vectors: ArrayLike) -> float:
    """sqrt(mean |v|^2) of vectors (n, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    return sqrt(float(np.mean(np.sum(v * v, axis=-1))))
