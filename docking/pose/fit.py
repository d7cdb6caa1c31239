"""The pose fit: one function over the three methods of [Luo], with an honest covariance for each.

The default is weighted least squares (`least-squares` with the points' covariances). Reason: an instrument's noise is
three to eight times smaller along the line of sight than across it; the weighted fit is the maximum-likelihood
estimate and reaches the Cramer-Rao bound (1.00 times it), SVD stays 1.13-1.3 times above, a three-point pose 2.2-2.8
times, and only the weighted fit's chi-square tells noise from a wrong point. With equal weights least squares and SVD
are the same optimum; SVD remains for comparison and as the start.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from docking.geometry import rms
from docking.pose.layout import check_layout
from docking.pose.least_squares import fit_gauss_newton, fit_maximum_likelihood, weighted_centroid
from docking.pose.settings import FitSettings
from docking.pose.svd import fit_svd
from docking.pose.three_point import best_triangle, fit_three_point
from docking.pose.uncertainty import propagated_cov, total_cov_mm2, unweighted_cov
from docking.types import Array, Fit, Pose, Screened


class _Estimate(NamedTuple):
    X_MN: Pose
    iterations: int
    cov: Array
    pivot_mm: Array
    expansion: float = 0.0
    expansion_cov: Array | None = None


def _closed_form(screened: Screened, X: Pose, iterations: int) -> _Estimate:
    """An equally weighted estimate with the covariance that its points' covariances give it."""
    s = total_cov_mm2(screened.nominal_cov_mm2, screened.measured_cov_mm2, X.R)
    pivot = weighted_centroid(screened.measured_mm, s)
    return _Estimate(X, iterations, unweighted_cov(X.apply(screened.nominal_mm), s, pivot), pivot)


def _three_point(screened: Screened) -> _Estimate:
    triangle = best_triangle(screened.nominal_mm)
    rows = list(triangle)
    estimator = partial(fit_three_point, triangle=(0, 1, 2))
    nominal, measured = screened.nominal_mm[rows], screened.measured_mm[rows]
    X = estimator(nominal, measured)
    s = total_cov_mm2(screened.nominal_cov_mm2, screened.measured_cov_mm2, X.R)
    pivot = weighted_centroid(screened.measured_mm, s)
    return _Estimate(X, 0, propagated_cov(estimator, nominal, measured, s[rows], pivot), pivot)


def _maximum_likelihood(screened: Screened, expansion_sigma: float) -> _Estimate:
    start = fit_three_point(screened.nominal_mm, screened.measured_mm)
    covs = (screened.nominal_cov_mm2, screened.measured_cov_mm2)
    found = fit_maximum_likelihood(screened.nominal_mm, screened.measured_mm, covs, start, expansion_sigma)
    expansion_cov = found.cov[6] if expansion_sigma > 0.0 else None
    return _Estimate(found.X_MN, found.iterations, found.cov[:6, :6], found.pivot_mm, found.expansion, expansion_cov)


def _estimate(screened: Screened, settings: FitSettings) -> _Estimate:
    if settings.method == "svd":
        return _closed_form(screened, fit_svd(screened.nominal_mm, screened.measured_mm), 0)
    if settings.method == "three-point":
        return _three_point(screened)
    if not settings.weighted:
        return _closed_form(screened, *fit_gauss_newton(screened.nominal_mm, screened.measured_mm))
    return _maximum_likelihood(screened, settings.expansion_sigma)


def fit_pose(screened: Screened, settings: FitSettings | None = None) -> Fit:
    """Fit X_MN to screened points; the pivot of the covariance is their weighted centroid in M.

    Raises TooFewPoints, DegenerateTargets. Residuals are judged by the caller: `Fit.chi2` with `Fit.dof` = 3 n - 6.
    """
    settings = FitSettings() if settings is None else settings
    check_layout(screened.nominal_mm, settings)
    e = _estimate(screened, settings)
    fitted = e.X_MN.apply(screened.nominal_mm)
    r = screened.measured_mm - fitted - e.expansion * (fitted - e.pivot_mm)
    s = total_cov_mm2(screened.nominal_cov_mm2, screened.measured_cov_mm2, e.X_MN.R)
    chi2 = float(np.einsum("ni,ni->", r, np.linalg.solve(s, r[:, :, None])[:, :, 0]))
    if settings.expansion_sigma > 0.0 and e.expansion_cov is not None:
        chi2 += (e.expansion / settings.expansion_sigma) ** 2
    worst = float(np.max(np.linalg.norm(r, axis=1)))
    return Fit(
        X_MN=e.X_MN, cov=e.cov, pivot_mm=e.pivot_mm, names=screened.names, residuals_mm=r, rms_mm=rms(r), max_mm=worst,
        method=settings.method, iterations=e.iterations, chi2=chi2, dof=3 * len(r) - 6, rejected=screened.rejected,
        expansion=e.expansion, expansion_cov=e.expansion_cov,
    )  # fmt: skip
