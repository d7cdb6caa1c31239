"""Docking features: how far component and mate are apart, how well that is known, and where the component must go.

docs/decisions/0007: sigma of a feature holds component fit, mate fit, drift since the last reference check, the nominal
covariance of the features on both sides, and temperature; the largest eigenvalue counts. A missing sigma refuses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from docking.errors import CheckPointDisagrees, SigmaMissing
from docking.pose.goal import Goal, GoalRule, goal_of
from docking.pose.quantiles import chi2_upper
from docking.pose.uncertainty import joint_cov_mm2, largest_sigma_mm, own_cov_mm2
from docking.types import Array, FeatureErrors, Fit, Points, Pose

_RISK_DRAWS = 8192
"""A risk at its limit of 2.5 % is known to 0.17 %."""
_RISK_SEED = 1


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


def _fit_cov_mm2(fit: Fit, p_W_mm: Array, expansion_sigma: float) -> Array:
    """Joint covariance (3n, 3n) that a fit gives the points (n, 3), an expansion it did not estimate included.

    A fit whose residuals are larger than its covariances say is believed less, by its chi-square per degree of freedom
    (Birge ratio): the covariances miss something, and the features are where it would show.
    """
    birge = max(1.0, fit.chi2 / fit.dof) if fit.dof > 0 else 1.0
    return birge * joint_cov_mm2(fit, p_W_mm, expansion_sigma)


def feature_errors(
    component: Fit, mate: Fit, features: Features, budget: Budget, standoff_W_mm: Array | None = None
) -> FeatureErrors:
    """Component minus mate at every feature in W, with sigma from the covariance of that difference.

    `component` is the fit X_WC, `mate` the fit X_WM, both from the same station: their covariances are those of the
    readings, and the station's own uncertainty, common to both, cancels in the difference. `standoff_W_mm` (3,) is
    where the component should be short of the mate. Raises SigmaMissing.
    """
    drift = _required(budget.drift_sigma_mm, "drift", "the station's drift")
    thermal = [
        _required(sigma, where, "its expansion") if fit.expansion_cov is None else 0.0
        for fit, sigma, where in (
            (component, budget.component_expansion, "component"),
            (mate, budget.mate_expansion, "mate"),
        )
    ]
    sigma_c = _positive(features.component_sigma_mm, features.names, "the feature on the component")
    sigma_m = _positive(features.mate_sigma_mm, features.names, "the feature on the mate")
    at_c, at_m = component.predict(features.component_mm), mate.predict(features.mate_mm)
    count = len(features.names)
    joint = _fit_cov_mm2(component, at_c, thermal[0]) + _fit_cov_mm2(mate, at_m, thermal[1])
    joint += np.diag(np.repeat(sigma_c**2 + sigma_m**2, 3)) + drift**2 * np.tile(np.eye(3), (count, count))
    if not bool(np.all(np.isfinite(joint))):
        raise SigmaMissing("feature", "a fit has no covariance", value="the pose")
    error = at_c - at_m - (np.zeros(3) if standoff_W_mm is None else standoff_W_mm)
    risk = specific_risk(error, joint, features.tolerance_mm)
    sigma = largest_sigma_mm(own_cov_mm2(joint))
    return FeatureErrors(features.names, error, sigma, features.tolerance_mm, risk)


def specific_risk(error_mm: Array, joint_mm2: Array, tolerance_mm: Array) -> float:
    """Probability that any feature is out of its tolerance, given what was measured (specific risk, JCGM 106).

    `error_mm` (n, 3), `joint_mm2` (3n, 3n) the covariance of all errors together, `tolerance_mm` (n,). From fixed
    draws through the symmetric root, which has no jumps: nearly the same data give nearly the same number.
    """
    values, vectors = np.linalg.eigh(joint_mm2)
    draws = np.random.default_rng(_RISK_SEED).standard_normal((_RISK_DRAWS, len(joint_mm2)))
    off = draws @ (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T + error_mm.reshape(-1)
    outside = np.linalg.norm(off.reshape(_RISK_DRAWS, -1, 3), axis=2) > tolerance_mm
    return float(np.mean(np.any(outside, axis=1)))


def docked_goal(component: Fit, mate: Fit, features: Features, rule: GoalRule | None = None) -> Goal:
    """The pose that brings the component's features onto the measured mate's, and what it leaves at each of them."""
    rule = GoalRule() if rule is None else rule
    return goal_of(component, mate, (features.component_mm, features.mate_mm, features.tolerance_mm), rule)


def goal_pose(
    component: Fit,
    mate: Fit,
    features: Features,
    standoff_W_mm: Array | None = None,
    rule: GoalRule | None = None,
) -> Pose:
    """Pose X_WC of the docked goal, shifted by `standoff_W_mm` (3,). Without a rule: least squares, nothing locked."""
    X_WC = docked_goal(component, mate, features, rule).X_WC
    shift = np.zeros(3) if standoff_W_mm is None else standoff_W_mm
    return Pose(X_WC.R, X_WC.t_mm + shift)


class CheckPoints(NamedTuple):
    """Measured minus predicted (n, 3) of points kept out of a fit, and how long each difference might be (n,)."""

    off_mm: Array
    limit_mm: Array


def check_points_agree(fit: Fit, nominal: Points, measured: Points, false_alarm: float = 0.001) -> CheckPoints:
    """Compare the points kept out of the fit with where it puts them.

    `nominal` in the body's frame and `measured` in the fit's M, same names in the same order. Two chi-square tests on
    fit, reading and nominal covariance: each point (3 degrees of freedom), and all together with the fit's error common
    to them. Raises CheckPointDisagrees naming the worst, SigmaMissing where a covariance is not known.
    """
    predicted = fit.predict(nominal.xyz_mm)
    off = measured.xyz_mm - predicted
    R, count = fit.X_MN.R, len(off)
    joint = joint_cov_mm2(fit, predicted)
    for i, own in enumerate(measured.cov_mm2 + R @ nominal.cov_mm2 @ R.T):
        joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += own
    if not bool(np.all(np.isfinite(joint))):
        raise SigmaMissing("check point", value="a check point")
    cov = own_cov_mm2(joint)
    statistic = np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[:, :, None])[:, :, 0])
    size = np.linalg.norm(off, axis=1)
    quantile = chi2_upper(false_alarm / max(count, 1), 3)
    limit = size * np.sqrt(quantile / np.maximum(statistic, np.finfo(float).tiny))
    worst = int(np.argmax(np.where(np.isnan(statistic), np.inf, statistic)))
    if not (statistic[worst] <= quantile):
        raise _disagrees(measured.names[worst], float(size[worst]), float(limit[worst]), "")
    together = float(off.reshape(-1) @ np.linalg.solve(joint, off.reshape(-1)))
    allowed = chi2_upper(false_alarm, 3 * count)
    if not (together <= allowed):
        shrink = float(np.sqrt(allowed / together))
        cause = f"Each one might be, all {count} together are not."
        raise _disagrees(measured.names[worst], float(size[worst]), float(size[worst]) * shrink, cause)
    return CheckPoints(off, limit)


def _disagrees(name: str, size_mm: float, limit_mm: float, cause: str) -> CheckPointDisagrees:
    known = limit_mm if np.isfinite(limit_mm) else None
    return CheckPointDisagrees(name, cause, value=size_mm, limit=known)
