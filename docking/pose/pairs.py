"""Inter-point distances: the tolerance of each pair, its scale when no sigma is given, and mixed-up units ([Luo])."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from docking.errors import UnitMixUp
from docking.pose.quantiles import normal_upper
from docking.pose.settings import FitSettings
from docking.types import Array

UNIT_FACTORS = (1000.0, 100.0, 10.0, 25.4, 2.54, 304.8, 0.3048, 12.0)
"""Ratios that one file in another unit produces: m, cm, inch and foot against mm, and against each other."""
_SMALL_SAMPLE = {3: 0.27, 4: 0.60, 5: 0.47, 6: 0.62, 7: 0.54}
"""Repeated median of |difference| over sqrt(2) sigma for few points (Monte Carlo); 0.63 from 8 points on."""
_TAIL = {6: 9.0, 7: 9.5, 8: 8.0, 9: 8.0}
"""Permitted |difference| over the repeated median: 99 % point of the largest of all pairs; 7.5 from 10 points on."""
_FLOOR_MM = 0.001
_FEW = 6
_PRIOR_MM, _PRIOR_DOF = 0.3, 3
"""Fewer than six points tell little of their own noise: it is blended with this survey-grade prior."""
_LARGEST_MM, _LARGEST_RATIO = 1.0, 5e-4
"""No sigma above this (or this part of the figure's size) is believed without being stated in the file."""


def distances(points_mm: Array) -> Array:
    """All inter-point distances (n, n) of points (n, 3)."""
    result: Array = np.linalg.norm(points_mm[:, None, :] - points_mm[None, :, :], axis=2)
    return result


def _distance_variance(points_mm: Array, cov_mm2: Array) -> Array:
    """Variance (n, n) of each distance: `u^T (S_i + S_j) u` with u the direction of the pair."""
    delta = points_mm[:, None, :] - points_mm[None, :, :]
    d = np.linalg.norm(delta, axis=2)
    u = delta / np.maximum(d, 1e-12)[:, :, None]
    mine = np.einsum("ijk,ikl,ijl->ij", u, cov_mm2, u)
    result: Array = mine + mine.T
    return result


def pair_tolerance_mm(
    nominal_mm: Array, measured_mm: Array, covs_mm2: tuple[Array, Array], settings: FitSettings
) -> Array:
    """Permitted difference (n, n) of measured and nominal distance from the points' covariances (n, 3, 3) each.

    The number of sigmas is the two-sided normal quantile that lets all pairs of a clean set pass with 1 - false_alarm.
    """
    n = len(nominal_mm)
    d = distances(nominal_mm)
    variance = _distance_variance(nominal_mm, covs_mm2[0]) + _distance_variance(measured_mm, covs_mm2[1])
    sigmas = normal_upper(settings.false_alarm / max(n * (n - 1), 2))
    result: Array = sigmas * np.sqrt(variance + (settings.expansion_sigma * d) ** 2)
    return result


def repeated_median(difference: Array) -> float:
    """Median over points of the median over partners, symmetric (n, n): holds with nearly half of the points wrong."""
    n = len(difference)
    off = np.sort(np.where(np.eye(n, dtype=bool), np.inf, difference), axis=1)
    return float(np.sort(off[:, (n - 2) // 2])[(n - 1) // 2])


def estimated_sigma_mm(difference: Array, size_mm: float) -> float:
    """Standard deviation a coordinate, of nominal and measured together, from |d_P - d_J| (n, n) alone."""
    n = len(difference)
    sigma = repeated_median(difference) / (sqrt(2.0) * _SMALL_SAMPLE.get(n, 0.63))
    if n < _FEW:
        dof = 3 * n - 6
        sigma = sqrt((_PRIOR_DOF * _PRIOR_MM**2 + dof * sigma**2) / (_PRIOR_DOF + dof))
    return min(max(sigma, _FLOOR_MM), max(_LARGEST_MM, _LARGEST_RATIO * size_mm))


def estimated_tolerance_mm(n: int, sigma_mm: float) -> float:
    """Permitted |d_P - d_J| for n points whose sigma was estimated by `estimated_sigma_mm`."""
    if n < _FEW:
        return 4.0 * sqrt(2.0) * sigma_mm
    return _TAIL.get(n, 7.5) * sqrt(2.0) * _SMALL_SAMPLE.get(n, 0.63) * sigma_mm


def check_units(nominal_mm: Array, measured_mm: Array, settings: FitSettings) -> None:
    """Raise UnitMixUp when most distances are a unit's factor times the nominal; nothing is converted by itself."""
    d_j, d_p = distances(nominal_mm), distances(measured_mm)
    upper: NDArray[np.bool_] = np.triu(d_j > 1e-9, 1)
    if not bool(upper.any()):
        return
    ratio = float(np.median(d_p[upper] / d_j[upper]))
    for factor in UNIT_FACTORS:
        for f in (factor, 1.0 / factor):
            if abs(ratio / f - 1.0) < 0.02:
                raise UnitMixUp(settings.where, f"a factor of {f:.6g} points to two different units", value=ratio)
