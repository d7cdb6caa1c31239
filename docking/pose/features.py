"""Docking features: how far component and mate are apart, how well that is known, and where the component must go.

Design rule 11: sigma of a feature holds component fit, mate fit, drift since the last reference check, the nominal
covariance of the features on both sides, and temperature; the largest eigenvalue counts. A missing sigma refuses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from docking.errors import CheckPointDisagrees, SigmaMissing
from docking.pose.svd import fit_svd
from docking.pose.uncertainty import largest_sigma_mm
from docking.types import Array, FeatureErrors, Fit, Points, Pose


@dataclass(frozen=True, eq=False)
class Features:
    """Docking features of a job: nominal points of the component (frame C) and of the mate (frame M) that must meet.

    `component_mm`, `mate_mm` (n, 3); `component_sigma_mm`, `mate_sigma_mm` (n,) of a feature against its body's
    targets, 1 sigma a coordinate; `tolerance_mm` (n,).
    """

    names: tuple[str, ...]
    component_mm: Array
    mate_mm: Array
    component_sigma_mm: Array
    mate_sigma_mm: Array
    tolerance_mm: Array


@dataclass(frozen=True)
class Budget:
    """What else makes a feature uncertain, 1 sigma; None is unknown and refuses.

    drift_sigma_mm       movement of the station between mate and component measurement, a coordinate
    component_expansion  relative expansion (1/K times K) of the component not contained in its fit; a fit that
    mate_expansion       estimates the expansion already carries it and ignores this entry
    """

    drift_sigma_mm: float | None
    component_expansion: float | None
    mate_expansion: float | None


def _required(value: float | None, where: str, what: str) -> float:
    if value is None or not (0.0 <= value < np.inf):
        raise SigmaMissing(where, value=what)
    return value


def _positive(sigma_mm: Array, names: tuple[str, ...], what: str) -> Array:
    for name, sigma in zip(names, sigma_mm, strict=True):
        if not (0.0 < sigma < np.inf):
            raise SigmaMissing(name, value=what)
    return sigma_mm


def _thermal_cov_mm2(fit: Fit, p_W_mm: Array, expansion_sigma: float) -> Array:
    """Covariance (n, 3, 3) of an expansion about the fit's pivot; zero where the fit estimated the expansion itself."""
    if fit.expansion_cov is not None:
        return np.zeros((len(p_W_mm), 3, 3))
    arm = expansion_sigma * (p_W_mm - fit.pivot_mm)
    result: Array = arm[:, :, None] * arm[:, None, :]
    return result


def feature_errors(component: Fit, mate: Fit, features: Features, budget: Budget) -> FeatureErrors:
    """Component minus mate at every feature in W, with sigma from the covariance of that difference.

    `component` is the fit X_WC, `mate` the fit X_WM, both from the same station: their covariances are those of the
    readings, and the station's own uncertainty, common to both, cancels in the difference. Raises SigmaMissing.
    """
    drift = _required(budget.drift_sigma_mm, "drift", "the station's drift")
    thermal_c = (
        _required(budget.component_expansion, "component", "its expansion") if component.expansion_cov is None else 0.0
    )
    thermal_m = _required(budget.mate_expansion, "mate", "its expansion") if mate.expansion_cov is None else 0.0
    sigma_c = _positive(features.component_sigma_mm, features.names, "the feature on the component")
    sigma_m = _positive(features.mate_sigma_mm, features.names, "the feature on the mate")
    at_c, at_m = component.predict(features.component_mm), mate.predict(features.mate_mm)
    isotropic = sigma_c**2 + sigma_m**2 + drift**2
    cov = component.point_cov_mm2(at_c) + mate.point_cov_mm2(at_m) + isotropic[:, None, None] * np.eye(3)
    cov += _thermal_cov_mm2(component, at_c, thermal_c) + _thermal_cov_mm2(mate, at_m, thermal_m)
    if not bool(np.all(np.isfinite(cov))):
        raise SigmaMissing("feature", "a fit has no covariance", value="the pose")
    return FeatureErrors(features.names, at_c - at_m, largest_sigma_mm(cov), features.tolerance_mm)


def goal_pose(component: Fit, mate: Fit, features: Features, standoff_W_mm: Array | None = None) -> Pose:
    """Pose X_WC that brings the component's features onto the measured mate's, weighted by 1 / tolerance^2.

    The component keeps the expansion that its fit found. `standoff_W_mm` (3,) is added to the goal's translation.
    """
    here = component.predict(features.component_mm)
    body = component.X_MN.inverse().apply(here)
    X_WC = fit_svd(body, mate.predict(features.mate_mm), features.tolerance_mm**-2.0)
    shift = np.zeros(3) if standoff_W_mm is None else standoff_W_mm
    return Pose(X_WC.R, X_WC.t_mm + shift)


class CheckPoints(NamedTuple):
    """Measured minus predicted (n, 3) of points kept out of a fit, and how long each difference might be (n,)."""

    off_mm: Array
    limit_mm: Array


def check_points_agree(fit: Fit, nominal: Points, measured: Points, false_alarm: float = 0.001) -> CheckPoints:
    """Compare the points kept out of the fit with where it puts them.

    `nominal` in the body's frame and `measured` in the fit's M, same names in the same order. The test is chi-square
    with 3 degrees of freedom on fit, reading and nominal covariance. Raises CheckPointDisagrees naming the worst,
    SigmaMissing where a covariance is not known.
    """
    predicted = fit.predict(nominal.xyz_mm)
    off = measured.xyz_mm - predicted
    R = fit.X_MN.R
    cov = fit.point_cov_mm2(predicted) + measured.cov_mm2 + R @ nominal.cov_mm2 @ R.T
    if not bool(np.all(np.isfinite(cov))):
        raise SigmaMissing("check point", value="a check point")
    statistic = np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[:, :, None])[:, :, 0])
    quantile = float(chi2.isf(false_alarm / max(len(off), 1), 3))
    size = np.linalg.norm(off, axis=1)
    limit = size * np.sqrt(quantile / np.maximum(statistic, np.finfo(float).tiny))
    for i in np.argsort(-statistic):
        if not (statistic[i] <= quantile):
            known = float(limit[i]) if np.isfinite(limit[i]) else None
            raise CheckPointDisagrees(measured.names[i], value=float(size[i]), limit=known)
    return CheckPoints(off, limit)
