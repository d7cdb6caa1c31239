"""Closed-form rigid fit by singular values (Arun 1987), [Luo] method 1.

It is the global optimum of the equally weighted sum of squares [Luo] Eq. 9, mirror solutions excluded.
"""

from __future__ import annotations

import numpy as np

from docking.types import Array, Pose


def fit_svd(nominal_mm: Array, measured_mm: Array, weights: Array | None = None) -> Pose:
    """Pose X_MN that minimises `sum w_i |R J_i + T - P_i|^2`.

    `nominal_mm` J and `measured_mm` P are (n, 3), `weights` (n,) or None for equal ones.
    """
    w = np.full(len(nominal_mm), 1.0 / len(nominal_mm)) if weights is None else weights / weights.sum()
    j0, p0 = w @ nominal_mm, w @ measured_mm
    # [Luo] Eq. 3 corrected: H = sum (J - J')(P - P')^T, component first, then R = V U^T.
    h = ((nominal_mm - j0) * w[:, None]).T @ (measured_mm - p0)
    u, _, vt = np.linalg.svd(h)
    # The flip of the last column is the ordinary path for coplanar targets: the determinant is tested by its sign.
    flip = np.array([1.0, 1.0, 1.0 if np.linalg.det(u @ vt) > 0.0 else -1.0])
    R = (vt.T * flip) @ u.T
    return Pose(R, p0 - R @ j0)


def mirrored_rms_mm(nominal_mm: Array, measured_mm: Array) -> float:
    """Residual rms of the best fit with a REFLECTION (det = -1): small when the points are the part's mirror image."""
    j, p = nominal_mm - nominal_mm.mean(axis=0), measured_mm - measured_mm.mean(axis=0)
    u, _, vt = np.linalg.svd(j.T @ p)
    flip = np.array([1.0, 1.0, -1.0 if np.linalg.det(u @ vt) > 0.0 else 1.0])
    r = p - j @ ((vt.T * flip) @ u.T).T
    return float(np.sqrt(np.mean(np.sum(r * r, axis=1))))
