"""The pose fit: one function over four estimators, with an honest covariance for each.

The default is maximum likelihood (`ml`). Reason: an instrument's noise is three to eight times smaller along the line
of sight than across it; the weighted fit reaches the Cramer-Rao bound (1.00 times it), SVD stays 1.13-1.3 times above,
a three-point pose 2.2-2.8 times, and only its chi-square tells noise from a wrong point. [Luo]'s least squares weighs
all points alike and starts from three points; it and SVD are the same optimum.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from docking.errors import BadArgument
from docking.geometry import rms
from docking.pose.layout import check_layout
from docking.pose.least_squares import fit_gauss_newton, fit_maximum_likelihood, weighted_centroid
from docking.pose.locks import Held, fit_locked
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


def _weights(screened: Screened, settings: FitSettings) -> Array | None:
    """The points' weights (n,), None where all weigh 1."""
    if not settings.weights:
        return None
    stated = dict(settings.weights)
    return np.array([stated.get(name, 1.0) for name in screened.names])


def _equally_weighted(screened: Screened, weights: Array | None, found: tuple[Pose, int]) -> _Estimate:
    """An estimate that ignores covariances, with the covariance that its points' covariances give it."""
    X, iterations = found
    s = total_cov_mm2(screened.nominal_cov_mm2, screened.measured_cov_mm2, X.R)
    pivot = weighted_centroid(screened.measured_mm, s)
    return _Estimate(X, iterations, unweighted_cov(X.apply(screened.nominal_mm), s, pivot, weights), pivot)


def _corners(screened: Screened, settings: FitSettings) -> list[int]:
    """Rows of the triangle: the one asked for, else the largest."""
    if settings.triangle is None:
        return list(best_triangle(screened.nominal_mm))
    for name in settings.triangle:
        if name not in screened.names:
            raise BadArgument("triangle", "it is not among the points that are used", value=name)
    return [screened.names.index(name) for name in settings.triangle]


def _three_point(screened: Screened, settings: FitSettings) -> _Estimate:
    rows = _corners(screened, settings)
    check_layout(screened.nominal_mm[rows], settings)
    estimator = partial(fit_three_point, triangle=(0, 1, 2))
    nominal, measured = screened.nominal_mm[rows], screened.measured_mm[rows]
    X = estimator(nominal, measured)
    s = total_cov_mm2(screened.nominal_cov_mm2, screened.measured_cov_mm2, X.R)
    pivot = weighted_centroid(screened.measured_mm, s)
    return _Estimate(X, 0, propagated_cov(estimator, nominal, measured, s[rows], pivot), pivot)


def _maximum_likelihood(screened: Screened, covs: tuple[Array, Array], settings: FitSettings) -> _Estimate:
    start, sigma = fit_svd(screened.nominal_mm, screened.measured_mm), settings.expansion_sigma
    if settings.locks:
        found = fit_locked(screened.nominal_mm, screened.measured_mm, covs, start, Held(dict(settings.locks), sigma))
    else:
        found = fit_maximum_likelihood(screened.nominal_mm, screened.measured_mm, covs, start, sigma)
    expansion_cov = found.cov[6] if sigma > 0.0 else None
    return _Estimate(found.X_MN, found.iterations, found.cov[:6, :6], found.pivot_mm, found.expansion, expansion_cov)


def fit_pose(screened: Screened, settings: FitSettings | None = None) -> Fit:
    """Fit X_MN to screened points; the pivot of the covariance is their weighted centroid in M.

    Raises TooFewPoints, DegenerateTargets, BadArgument (a corner of the triangle that is not used). Residuals are
    judged by the caller: `Fit.chi2` with `Fit.dof` = 3 n - 6, and one more for each held degree of freedom.
    """
    settings = FitSettings() if settings is None else settings
    check_layout(screened.nominal_mm, settings)
    weights, covs = _weights(screened, settings), (screened.nominal_cov_mm2, screened.measured_cov_mm2)
    if settings.method == "ml":
        if weights is not None:
            covs = covs[0] / weights[:, None, None], covs[1] / weights[:, None, None]
        e = _maximum_likelihood(screened, covs, settings)
    elif settings.method == "three-point":
        e = _three_point(screened, settings)
    elif settings.method == "svd":
        X = fit_svd(screened.nominal_mm, screened.measured_mm, weights)
        e = _equally_weighted(screened, weights, (X, 0))
    else:
        found = fit_gauss_newton(screened.nominal_mm, screened.measured_mm, weights=weights)
        e = _equally_weighted(screened, weights, found)
    return _judged(screened, e, total_cov_mm2(*covs, e.X_MN.R), settings)


def _judged(screened: Screened, e: _Estimate, cov_mm2: Array, settings: FitSettings) -> Fit:
    """The estimate with its residuals (n, 3), measured by the points' total covariances (n, 3, 3)."""
    fitted = e.X_MN.apply(screened.nominal_mm)
    r = screened.measured_mm - fitted - e.expansion * (fitted - e.pivot_mm)
    chi2 = float(np.vdot(r, np.linalg.solve(cov_mm2, r[:, :, None])[:, :, 0]))
    if settings.expansion_sigma > 0.0 and e.expansion_cov is not None:
        chi2 += (e.expansion / settings.expansion_sigma) ** 2
    return Fit(
        X_MN=e.X_MN, cov=e.cov, pivot_mm=e.pivot_mm, names=screened.names, residuals_mm=r, rms_mm=rms(r),
        max_mm=float(np.sqrt(np.max(np.sum(r * r, axis=1)))), method=settings.method, iterations=e.iterations,
        chi2=chi2, dof=3 * len(r) - 6 + len(settings.locks), rejected=screened.rejected, expansion=e.expansion,
        expansion_cov=e.expansion_cov,
    )  # fmt: skip
