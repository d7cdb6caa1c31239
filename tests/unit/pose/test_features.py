"""Docking features: the error is a difference, its sigma holds every part, and a missing part refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from docking.errors import CheckPointDisagrees, SigmaMissing
from docking.geometry import euler_to_matrix
from docking.pose import Budget, Features, check_points_agree, feature_errors, goal_pose
from docking.types import RISK_LIMIT, Fit, Points, Pose

ZERO = np.zeros((6, 6))
QUIET = Budget(0.0, 0.0, 0.0)
TURN = Pose(euler_to_matrix(0.02, -0.01, 0.6), np.array([100.0, 200.0, -50.0]))
NEAR = Pose(np.eye(3), np.array([-4000.0, 0.0, 0.0]))
FACE = np.array([[4000.0, 2000.0, 0.0], [4000.0, -2000.0, 0.0], [4000.0, 0.0, 2000.0], [4000.0, 0.0, -2000.0]])


def fit(X: Pose, cov: np.ndarray = ZERO, pivot: np.ndarray | None = None) -> Fit:
    c = X.t_mm if pivot is None else pivot
    return Fit(X, cov, c, (), np.zeros((0, 3)), 0.0, 0.0, "least-squares", 1, 0.0, 0)


def features(sigma_mm: float = 1e-6) -> Features:
    s = np.full(4, sigma_mm)
    return Features(("A", "B", "C", "D"), FACE, FACE - [4000.0, 0.0, 0.0], s, s, np.full(4, 0.2))


def test_error_is_component_minus_mate_in_w() -> None:
    mate = fit(TURN)
    component = fit(TURN @ Pose(np.eye(3), np.array([-4000.0, 0.0, 0.3])))
    errors = feature_errors(component, mate, features(), QUIET)
    assert np.allclose(errors.error_mm, TURN.R @ [0.0, 0.0, 0.3], atol=1e-9)
    assert errors.norm_mm == pytest.approx([0.3] * 4)
    assert not errors.accepted()


def test_every_part_of_sigma_counts_once() -> None:
    cov = np.diag([0, 0, 0, 0.03**2, 0.01**2, 0.01**2])
    base = feature_errors(fit(Pose.identity(), cov), fit(Pose.identity()), features(), QUIET)
    assert base.sigma_mm == pytest.approx([0.03] * 4, rel=1e-6)
    both = feature_errors(fit(Pose.identity(), cov), fit(Pose.identity(), cov), features(), QUIET)
    assert both.sigma_mm == pytest.approx([0.03 * np.sqrt(2)] * 4, rel=1e-6)
    drift = feature_errors(fit(Pose.identity(), cov), fit(Pose.identity()), features(), Budget(0.04, 0.0, 0.0))
    assert drift.sigma_mm == pytest.approx([0.05] * 4, rel=1e-6)
    nominal = feature_errors(fit(Pose.identity()), fit(Pose.identity()), features(0.03), QUIET)
    assert nominal.sigma_mm == pytest.approx([0.03 * np.sqrt(2)] * 4)


def test_risk_knows_what_the_features_have_in_common() -> None:
    """With nothing measured off, |error| / sigma follows chi with 3 degrees of freedom; a drift moves all features
    alike and so counts once, the features' own sigmas each for themselves."""
    inside = 1.0 - special.chdtrc(3, (0.2 / 0.08) ** 2)
    drift = feature_errors(fit(NEAR), fit(Pose.identity()), features(), Budget(0.08, 0.0, 0.0))
    assert drift.risk == pytest.approx(1.0 - inside, abs=0.01)
    own = feature_errors(fit(NEAR), fit(Pose.identity()), features(0.08 / np.sqrt(2)), QUIET)
    assert own.risk == pytest.approx(1.0 - inside**4, abs=0.015)


def test_a_feature_is_accepted_by_error_and_sigma_and_by_the_risk_of_all() -> None:
    """Along one direction 0.98 of the tolerance as e + 2 sigma is accepted and 1.01 not; where e = 0 and all directions
    are as uncertain it is the risk that refuses."""
    cov = np.diag([0, 0, 0, 0.05**2, 1e-12, 1e-12])
    for error_mm, accepted in ((0.096, True), (0.102, False)):
        shifted = Pose(np.eye(3), NEAR.t_mm + np.array([error_mm, 0.0, 0.0]))
        found = feature_errors(fit(shifted, cov), fit(Pose.identity()), features(), QUIET)
        assert (found.accepted(), found.risk < RISK_LIMIT) == (accepted, True)
    found = feature_errors(fit(NEAR), fit(Pose.identity()), features(0.07 / np.sqrt(2)), QUIET)
    assert np.all(found.norm_mm + 2.0 * found.sigma_mm < 0.2)
    assert not found.accepted()


def test_a_fit_with_larger_residuals_than_stated_is_believed_less() -> None:
    cov = np.diag([0, 0, 0, 0.03**2, 0.01**2, 0.01**2])
    for chi2, factor in ((36.0, np.sqrt(3.0)), (12.0, 1.0), (3.0, 1.0)):
        loud = replace(fit(NEAR, cov), chi2=chi2, dof=12)
        for pair in ((loud, fit(Pose.identity())), (fit(NEAR), replace(loud, X_MN=Pose.identity()))):
            found = feature_errors(*pair, features(), QUIET)
            assert found.sigma_mm == pytest.approx([0.03 * factor] * 4, rel=1e-6)


def test_rotation_acts_through_the_arm() -> None:
    cov = np.diag([0.0, 0.0, (10e-6) ** 2, 0, 0, 0])
    errors = feature_errors(fit(Pose.identity(), cov), fit(Pose.identity()), features(), QUIET)
    assert errors.sigma_mm == pytest.approx(10e-6 * np.hypot(FACE[:, 0], FACE[:, 1]), rel=1e-3)


def test_temperature_acts_through_the_arm_unless_the_fit_estimated_it() -> None:
    e = 23e-6 * 0.3
    errors = feature_errors(fit(Pose.identity()), fit(Pose.identity()), features(), Budget(0.0, e, 0.0))
    assert errors.sigma_mm == pytest.approx(e * np.linalg.norm(FACE, axis=1), rel=1e-3)
    known = replace(fit(Pose.identity()), expansion=1e-5, expansion_cov=np.array([0, 0, 0, 0, 0, 0, 1e-12]))
    errors = feature_errors(known, fit(Pose.identity()), features(), Budget(0.0, None, 0.0))
    assert errors.sigma_mm == pytest.approx(1e-6 * np.linalg.norm(FACE, axis=1), rel=1e-3)
    assert np.allclose(errors.error_mm, FACE * 1e-5 + [4000.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "budget", [Budget(None, 0.0, 0.0), Budget(0.0, None, 0.0), Budget(0.0, 0.0, None), Budget(float("nan"), 0.0, 0.0)]
)
def test_an_unknown_sigma_refuses(budget: Budget) -> None:
    with pytest.raises(SigmaMissing):
        feature_errors(fit(Pose.identity()), fit(Pose.identity()), features(), budget)


def test_unknown_feature_or_fit_sigma_refuses() -> None:
    for sigma in (0.0, float("nan"), -1.0):
        with pytest.raises(SigmaMissing, match="A"):
            feature_errors(fit(Pose.identity()), fit(Pose.identity()), features(sigma), QUIET)
    with pytest.raises(SigmaMissing):
        feature_errors(fit(Pose.identity(), np.full((6, 6), np.nan)), fit(Pose.identity()), features(), QUIET)


def test_goal_brings_the_features_together() -> None:
    component = fit(Pose(euler_to_matrix(0.1, 0.2, -0.3), np.array([5.0, 6.0, 7.0])))
    goal = goal_pose(component, fit(TURN), features())
    assert np.allclose(goal.apply(FACE), TURN.apply(features().mate_mm), atol=1e-9)
    back = goal_pose(component, fit(TURN), features(), np.array([-30.0, 0.0, 0.0]))
    assert np.allclose(back.apply(FACE) - goal.apply(FACE), [-30.0, 0.0, 0.0], atol=1e-9)


def test_goal_honours_the_tight_tolerance() -> None:
    f = features()
    bent = f.mate_mm + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0.4], [0, 0, 0]])
    f = Features(f.names, f.component_mm, bent, f.component_sigma_mm, f.mate_sigma_mm, np.array([0.1, 0.1, 10.0, 0.1]))
    goal = goal_pose(fit(Pose.identity()), fit(Pose.identity()), f)
    gap = np.linalg.norm(goal.apply(f.component_mm) - f.mate_mm, axis=1)
    assert np.max(gap[[0, 1, 3]]) < 0.002
    assert gap[2] == pytest.approx(0.4, abs=0.002)


def test_check_points() -> None:
    sigma = np.broadcast_to(0.01**2 * np.eye(3), (2, 3, 3))
    nominal = Points(("K1", "K2"), np.array([[0.0, 0, 0], [1000.0, 0, 0]]), sigma)
    seen = TURN.apply(nominal.xyz_mm) + np.array([[0.01, 0, 0], [0, -0.02, 0]])
    off = check_points_agree(fit(TURN), nominal, Points(nominal.names, seen, sigma)).off_mm
    assert np.allclose(off, [[0.01, 0, 0], [0, -0.02, 0]])
    with pytest.raises(CheckPointDisagrees) as caught:
        check_points_agree(fit(TURN), nominal, Points(nominal.names, seen + np.array([[0, 0, 0], [0, 0, 0.2]]), sigma))
    assert caught.value.where == "K2"
    assert caught.value.value == pytest.approx(np.hypot(0.02, 0.2))
    assert caught.value.limit == pytest.approx(0.0141421 * np.sqrt(17.73), rel=0.01)
    for lost in (np.nan, np.inf):
        with pytest.raises(CheckPointDisagrees):
            check_points_agree(fit(TURN), nominal, Points(nominal.names, np.full((2, 3), lost), sigma))
    with pytest.raises(SigmaMissing):
        check_points_agree(fit(TURN), nominal, Points(nominal.names, seen, np.full((2, 3, 3), np.nan)))
