"""Covariance of fitted poses, and what it means at a point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from docking.geometry import log_so3
from docking.pose.least_squares import design
from docking.types import Array, Fit, Pose

Estimator = Callable[[Array, Array], Pose]


def total_cov_mm2(nominal_cov: Array, measured_cov: Array, R: Array) -> Array:
    """Covariance (n, 3, 3) of `P - (R J + T)` in M: measured plus turned nominal."""
    result: Array = measured_cov + R @ nominal_cov @ R.T
    return result


def unweighted_cov(points_M_mm: Array, cov_mm2: Array, pivot_mm: Array, weights: Array | None = None) -> Array:
    """Covariance (6, 6) about the pivot of the fit that weighs its points by `weights` (n,), by default EQUALLY,
    whatever their covariances (n, 3, 3).

    With B = sqrt(w) A and r weighted alike the estimate is `(B^T B)^-1 B^T r`, hence `(B^T B)^-1 B^T wS B (B^T B)^-1`.
    """
    w = np.ones(len(points_M_mm)) if weights is None else weights / weights.mean()
    cov_mm2 = w[:, None, None] * cov_mm2
    a = np.sqrt(w)[:, None, None] * design(points_M_mm, pivot_mm)[:, :, :6]
    radius = max(float(np.sqrt(np.mean(np.sum((points_M_mm - pivot_mm) ** 2, axis=1)))), 1e-9)
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    a = a * scale
    inverse = np.linalg.inv(np.einsum("nik,nil->kl", a, a))
    middle = np.einsum("nik,nij,njl->kl", a, cov_mm2, a)
    cov: Array = (inverse @ middle @ inverse) * np.outer(scale, scale)
    return cov


def propagated_cov(
    estimator: Estimator, nominal_mm: Array, measured_mm: Array, cov_mm2: Array, pivot_mm: Array
) -> Array:
    """Covariance (6, 6) about the pivot of any estimator, by central differences over the coordinates (n, 3)."""
    X = estimator(nominal_mm, measured_mm)
    h = 1e-4 * max(float(np.ptp(measured_mm)), 1e-3)
    cov = np.zeros((6, 6))
    for i in range(len(measured_mm)):
        gain = np.zeros((6, 3))
        for k in range(3):
            delta = np.zeros_like(measured_mm)
            delta[i, k] = h
            plus, minus = estimator(nominal_mm, measured_mm + delta), estimator(nominal_mm, measured_mm - delta)
            gain[:, k] = (pose_difference(plus, X, pivot_mm) - pose_difference(minus, X, pivot_mm)) / (2.0 * h)
        cov += gain @ cov_mm2[i] @ gain.T
    return cov


def pose_difference(X_est: Pose, X_true: Pose, pivot_mm: Array) -> Array:
    """[rotation_rad, translation_mm] (6,) about the pivot (3,) in M that carries X_true to X_est."""
    w = log_so3(X_est.R @ X_true.R.T)
    at = X_true.inverse().apply(pivot_mm)
    return np.concatenate([w, X_est.apply(at) - pivot_mm])


def joint_cov_mm2(fit: Fit, points_M_mm: Array, expansion_sigma: float = 0.0) -> Array:
    """Joint covariance (3n, 3n) that the uncertainty of a fit's pose and expansion gives the points (n, 3) in M.

    `expansion_sigma` (1 sigma, relative) stands in where the fit did not estimate the expansion.
    """
    cov = fit.whole_cov()
    if fit.expansion_cov is None:
        cov[6, 6] = expansion_sigma**2
    jac = design(points_M_mm, fit.pivot_mm).reshape(-1, 7)
    result: Array = jac @ cov @ jac.T
    return result


def own_cov_mm2(joint_mm2: Array) -> Array:
    """The covariance (n, 3, 3) of each point out of the joint one (3n, 3n)."""
    places = np.arange(len(joint_mm2) // 3)
    result: Array = joint_mm2.reshape(len(places), 3, -1, 3)[places, :, places, :]
    return result


def largest_sigma_mm(cov_mm2: Array) -> Array:
    """sqrt of the largest eigenvalue of each covariance (..., 3, 3)."""
    result: Array = np.sqrt(np.linalg.eigvalsh(cov_mm2)[..., -1])
    return result
