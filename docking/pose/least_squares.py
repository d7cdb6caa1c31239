"""Least-squares rigid fits, [Luo] method 3: equal weights over Euler angles, and maximum likelihood on SE(3).

With equal weights the minimum is the one `fit_svd` gives in closed form. With covariances the fit is the
maximum-likelihood estimate and reaches the Cramer-Rao bound, which no unweighted method does (docs/fit.md (1) to (8)).
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from docking.errors import NotCongruent
from docking.geometry import euler_to_matrix, exp_so3, skew
from docking.pose.three_point import fit_three_point
from docking.types import Array, Pose

MAX_ITERATIONS = 60


class Solution(NamedTuple):
    """Pose X_MN, iterations used, covariance (7, 7) of [rotation, translation, expansion] about the pivot, and
    the fitted expansion."""

    X_MN: Pose
    iterations: int
    cov: Array
    pivot_mm: Array
    expansion: float


def step_limit_mm(points_mm: Array) -> float:
    """A step below this is rounding: the points move by less than a few units in the last place."""
    return 1e-11 + 8.0 * float(np.finfo(np.float64).eps) * float(np.max(np.abs(points_mm)))


def euler_jacobian(alpha_rad: float, beta_rad: float, gamma_rad: float, nominal_mm: Array) -> Array:
    """d(R J_i + T)/d(alpha, beta, gamma, x, y, z), shape (n, 3, 6); the Jacobian J(X) of [Luo] Eq. 11."""
    ca, sa, cb, sb, cg, sg = (f(v) for v in (alpha_rad, beta_rad, gamma_rad) for f in (cos, sin))
    rz = np.array([[cg, -sg, 0.0], [sg, cg, 0.0], [0.0, 0.0, 1.0]])
    ry = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    d_alpha = rz @ ry @ rx @ skew([1.0, 0.0, 0.0])
    d_beta = rz @ skew([0.0, 1.0, 0.0]) @ ry @ rx
    d_gamma = skew([0.0, 0.0, 1.0]) @ rz @ ry @ rx
    jac = np.zeros((len(nominal_mm), 3, 6))
    for k, d in enumerate((d_alpha, d_beta, d_gamma)):
        jac[:, :, k] = nominal_mm @ d.T
    jac[:, :, 3:] = np.eye(3)
    return jac


def fit_gauss_newton(
    nominal_mm: Array, measured_mm: Array, start: Pose | None = None, weights: Array | None = None
) -> tuple[Pose, int]:
    """Minimum of [Luo] Eq. 9 by Gauss-Newton, Eq. 12, from the three-point pose; with its iterations.

    `weights` (n,) of the points' squares, equal by default.

    The points are centred and the angles scaled by the rms radius, so the system is well conditioned at any distance.
    The angles count from a base rotation, at first the start's, that follows when beta grows: no gimbal lock is met.
    """
    w = np.full(len(nominal_mm), 1.0 / len(nominal_mm)) if weights is None else weights / weights.sum()
    root = np.sqrt(w * len(w))[:, None]
    j0, p0 = w @ nominal_mm, w @ measured_mm
    j, p = nominal_mm - j0, measured_mm - p0
    X = fit_three_point(nominal_mm, measured_mm) if start is None else start
    base, angles, t = X.R, np.zeros(3), X.apply(j0) - p0
    radius = float(np.sqrt(np.mean(np.sum(j * j, axis=1))))
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    for iteration in range(1, MAX_ITERATIONS + 1):
        turned = j @ base.T
        f = root * (turned @ euler_to_matrix(*angles).T + t - p)
        a = (root[:, :, None] * euler_jacobian(angles[0], angles[1], angles[2], turned)).reshape(-1, 6) * scale
        step = np.linalg.lstsq(a, -f.reshape(-1), rcond=1e-12)[0]
        angles, t = angles + step[:3] * scale[:3], t + step[3:]
        if float(np.linalg.norm(step)) < step_limit_mm(j):
            R = euler_to_matrix(*angles) @ base
            return Pose(R, p0 + t - R @ j0), iteration
        if abs(float(angles[1])) > 1.0:
            base, angles = euler_to_matrix(*angles) @ base, np.zeros(3)
    raise NotCongruent("fit", "Gauss-Newton does not converge", value=len(nominal_mm), limit=len(nominal_mm))


def design(points_mm: Array, pivot_mm: Array) -> Array:
    """How points (n, 3) move with [w, d, e] about a pivot: `w x (q - c) + d + e (q - c)`, shape (n, 3, 7)."""
    arm = points_mm - pivot_mm
    jac = np.zeros((len(points_mm), 3, 7))
    jac[:, :, :3] = -skew(arm)
    jac[:, :, 3:6] = np.eye(3)
    jac[:, :, 6] = arm
    return jac


def weighted_centroid(points_mm: Array, cov_mm2: Array) -> Array:
    """Centroid (3,) of points (n, 3) with the weights 1 / trace of their covariances (n, 3, 3)."""
    w = 1.0 / np.trace(cov_mm2, axis1=1, axis2=2)
    result: Array = w @ points_mm / w.sum()
    return result


def radius_mm(points_mm: Array, pivot_mm: Array) -> float:
    """Root mean square distance of points (n, 3) from the pivot; it scales angles."""
    off = points_mm - pivot_mm
    return max(float(np.sqrt(np.vdot(off, off) / len(off))), 1e-9)


def normal_equations(
    X: Pose, expansion: float, points: tuple[Array, Array, Array, Array], pivot_mm: Array
) -> tuple[Array, Array]:
    """N = sum A^T S^-1 A (7, 7) and sum A^T S^-1 r (7,) at a pose, about the pivot.

    `points` = nominal and measured (n, 3), nominal and measured covariance (n, 3, 3).
    """
    nominal_mm, measured_mm, nominal_cov, measured_cov = points
    q = X.apply(nominal_mm)
    a = design(q, pivot_mm)
    r = measured_mm - q - expansion * (q - pivot_mm)
    aw = (np.linalg.inv(measured_cov + X.R @ nominal_cov @ X.R.T) @ a).reshape(-1, 7).T
    return aw @ a.reshape(-1, 7), aw @ r.reshape(-1)


def fit_maximum_likelihood(
    nominal_mm: Array, measured_mm: Array, covs_mm2: tuple[Array, Array], start: Pose, expansion_sigma: float = 0.0
) -> Solution:
    """Maximum-likelihood pose (docs/fit.md (2)): minimises `sum r^T S^-1 r (+ (e / sigma_e)^2)`, r = P - (R J + T).

    `covs_mm2` = (nominal in N, measured in M), each (n, 3, 3); S_i = S_Pi + R S_Ji R^T follows the rotation. Steps are
    Gauss-Newton on the manifold about the weighted centroid c of the measured points; with `expansion_sigma` > 0 a
    uniform expansion e about c is estimated too. The covariance is N^-1, N = sum A^T S^-1 A.
    """
    X, e, before = start, 0.0, np.inf
    free = 7 if expansion_sigma > 0.0 else 6
    c = weighted_centroid(measured_mm, covs_mm2[1] + X.R @ covs_mm2[0] @ X.R.T)
    radius, limit = radius_mm(measured_mm, c), step_limit_mm(measured_mm)
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3 + [1.0 / radius])[:free]
    for iteration in range(1, MAX_ITERATIONS + 1):
        normal, rhs = normal_equations(X, e, (nominal_mm, measured_mm, *covs_mm2), c)
        if free == 7:
            normal[6, 6] += expansion_sigma**-2
            rhs[6] -= e * expansion_sigma**-2
        inverse = scale[:, None] * np.linalg.inv(normal[:free, :free] * (scale[:, None] * scale)) * scale
        step = inverse @ rhs[:free]
        turn = exp_so3(step[:3])
        X = Pose(turn @ X.R, turn @ (X.t_mm - c) + c + step[3:6])
        turned, grown = float(np.linalg.norm(step[:3])), float(np.sum(step[6:]))
        e += grown
        moved = radius * (turned + abs(grown)) + float(np.linalg.norm(step[3:6]))
        # Near the minimum every step is the same small share of the one before: the next would be lost in rounding.
        if moved < limit or (moved < 1e-3 * before and moved * moved < limit * before):
            cov = np.zeros((7, 7))
            cov[:free, :free] = (inverse + inverse.T) / 2.0
            return Solution(X, iteration, cov, c, e)
        before = moved
    raise NotCongruent("fit", "the weighted fit does not converge", value=len(nominal_mm), limit=len(nominal_mm))
