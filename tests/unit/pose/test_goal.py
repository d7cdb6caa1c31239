"""The docked goal: minimax is the best worst feature by brute force, locks hold, expansion moves what it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from docking.geometry import euler_to_matrix, exp_so3, log_so3
from docking.pose import Features, goal_pose
from docking.pose.features import Budget, docked_goal, feature_errors
from docking.pose.goal import LOCKS, GoalRule, best_fit
from docking.types import Array, Fit, Pose

MINIMAX = GoalRule("minimax")
FACE = np.array([[4000.0, 2000.0, 0.0], [4000.0, -2000.0, 0.0], [4000.0, 0.0, 2000.0], [4000.0, 0.0, -2000.0]])


def figures(seed: int, count: int) -> tuple[Array, Array, Array]:
    """Features of the body, their targets that differ in shape by some 0.05 mm, tolerances."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([2000.0, -2000.0, -2000.0], [6000.0, 2000.0, 2000.0], (count, 3))
    X = Pose(euler_to_matrix(0.3, -0.2, 1.1), np.array([500.0, -300.0, 900.0]))
    return body, X.apply(body) + rng.normal(0.0, 0.05, (count, 3)), rng.uniform(0.1, 0.4, count)


def worst(X: Pose, body: Array, target: Array, tolerance: Array) -> float:
    return float(np.max(np.linalg.norm(X.apply(body) - target, axis=1) / tolerance))


def moved(X: Pose, step: Array, body: Array) -> Pose:
    """X displaced by mm at the features: three rotations about their middle, three shifts."""
    turn, middle = exp_so3(step[:3] / 2000.0), X.apply(body.mean(axis=0))
    return Pose(turn @ X.R, turn @ (X.t_mm - middle) + middle + step[3:])


@pytest.mark.parametrize(("seed", "count"), [(0, 3), (1, 4), (2, 4), (3, 6), (4, 12)])
def test_minimax_is_the_least_worst_error_by_brute_force(seed: int, count: int) -> None:
    """A general optimiser with one bound a feature finds the same value; no displacement of any size is better."""
    body, target, tolerance = figures(seed, count)
    squares, X = (best_fit(body, target, tolerance, rule) for rule in (GoalRule(), MINIMAX))
    least = worst(X, body, target, tolerance)
    assert least < worst(squares, body, target, tolerance) * 0.97

    def room(v: Array) -> Array:
        off = moved(squares, v[:6], body).apply(body) - target
        return np.asarray(v[6] ** 2 - np.sum((off / tolerance[:, None]) ** 2, axis=1))

    bound = {"type": "ineq", "fun": room}
    start = np.append(np.zeros(6), 1.1 * worst(squares, body, target, tolerance))
    brute = minimize(
        lambda v: v[6], start, constraints=[bound], method="SLSQP", options={"ftol": 1e-14, "maxiter": 400}
    )
    assert least == pytest.approx(brute.x[6], rel=1e-6)
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        other = moved(X, rng.normal(size=6) * 10.0 ** rng.uniform(-6.0, 0.0), body)
        assert worst(other, body, target, tolerance) > least - 1e-7


def test_minimax_of_a_warped_face_by_hand() -> None:
    """One of four corners is 0.4 mm off the plane of the others: at best 0.1 of warp is left at every corner."""
    body = FACE
    target = FACE + np.array([[0.4, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    for rule in (MINIMAX, GoalRule()):
        X = best_fit(body, target, np.full(4, 0.2), rule)
        assert np.linalg.norm(X.apply(body) - target, axis=1) == pytest.approx([0.1] * 4, abs=1e-5)
    tight = np.array([0.1, 0.4, 0.4, 0.4])
    left = np.linalg.norm(best_fit(body, target, tight, MINIMAX).apply(body) - target, axis=1) / tight
    assert left == pytest.approx([0.4 / np.sum(tight)] * 4, rel=1e-4)


def test_figures_that_agree_leave_nothing() -> None:
    body, _, tolerance = figures(5, 5)
    X = Pose(euler_to_matrix(-0.4, 0.1, 0.2), np.array([1.0, 2.0, 3.0]))
    found = best_fit(body, X.apply(body), tolerance, MINIMAX)
    assert np.max(np.abs(found.apply(body) - X.apply(body))) < 1e-8


@pytest.mark.parametrize("kind", ["least-squares", "minimax"])
@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_keeps_its_degree_of_freedom_and_the_rest_is_best(kind: str, lock: str) -> None:
    body, target, tolerance = figures(6, 5)
    free = best_fit(body, target, tolerance, GoalRule())
    designed = moved(free, np.array([0.3, -0.2, 0.4, 0.1, -0.3, 0.2]), body)
    centre = (4000.0, 100.0, -50.0)
    rule = GoalRule(kind, (lock,), designed, centre)  # type: ignore[arg-type]
    X = best_fit(body, target, tolerance, rule)
    at = designed.apply(np.array(centre))
    change = {
        **dict(zip(("alpha", "beta", "gamma"), log_so3(X.R @ designed.R.T), strict=True)),
        **dict(zip("xyz", X.apply(np.array(centre)) - at, strict=True)),
    }
    assert abs(change.pop(lock)) < 1e-9
    assert all(abs(value) > 1e-6 for value in change.values())

    def cost(pose: Pose) -> float:
        share = np.linalg.norm(pose.apply(body) - target, axis=1) / tolerance
        return float(np.max(share) if kind == "minimax" else np.sum(share**2))

    names = [name for name in ("alpha", "beta", "gamma", "x", "y", "z") if name != lock]
    rng = np.random.default_rng(1)
    for _ in range(300):
        nudge = dict(zip(names, rng.normal(size=5) * 10.0 ** rng.uniform(-5.0, -1.0), strict=True))
        w = np.array([nudge.get(k, 0.0) / 2000.0 for k in ("alpha", "beta", "gamma")]) + log_so3(X.R @ designed.R.T)
        turn = exp_so3(w)
        there = X.apply(np.array(centre)) + [nudge.get(k, 0.0) for k in "xyz"]
        other = Pose(turn @ designed.R, there - turn @ (at - designed.t_mm))
        assert cost(other) > cost(X) - 1e-7


def test_all_locked_is_the_designed_pose_and_none_needs_no_design() -> None:
    body, target, tolerance = figures(7, 4)
    designed = Pose(euler_to_matrix(0.1, 0.0, 0.0), np.array([10.0, 0.0, 0.0]))
    assert best_fit(body, target, tolerance, GoalRule("minimax", LOCKS, designed)) is designed
    plain = best_fit(body, target, tolerance, GoalRule())
    told = best_fit(body, target, tolerance, GoalRule(docked=designed))
    assert np.allclose(plain.matrix(), told.matrix())


# expansion -----------------------------------------------------------------------------------------------------------
def fit(X: Pose, expansion: float = 0.0, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Fit:
    cov = np.zeros(7) if expansion else None
    return Fit(
        X, np.zeros((6, 6)), np.array(pivot), (), np.zeros((0, 3)), 0.0, 0.0, "ml", 1, 0.0, 0,
        expansion=expansion, expansion_cov=cov,
    )  # fmt: skip


def features() -> Features:
    small = np.full(4, 1e-6)
    mate = FACE - [4000.0, 0.0, 0.0]
    return Features(("A", "B", "C", "D"), FACE, mate, small, small, np.full(4, 0.2))


@pytest.mark.parametrize("rule", [GoalRule(), MINIMAX])
def test_expansion_of_component_and_mate_moves_the_goal(rule: GoalRule) -> None:
    """Both grew by 50 ppm about pivots of their own: features meet where both really stand, not where nominals do."""
    here = Pose(euler_to_matrix(0.01, 0.02, -0.01), np.array([-30.0, 5.0, 4.0]))
    there = Pose(euler_to_matrix(0.0, 0.0, 0.6), np.array([9000.0, 200.0, 50.0]))
    component, mate = fit(here, 50e-6, (-2000.0, 100.0, 0.0)), fit(there, 50e-6, (12000.0, 900.0, 0.0))
    X = goal_pose(component, mate, features(), rule=rule)
    landed = X.apply(component.grown(FACE))
    assert np.allclose(landed, mate.predict(features().mate_mm), atol=1e-6)
    assert np.linalg.norm(landed - there.apply(features().mate_mm), axis=1).min() > 0.1
    goal = docked_goal(component, mate, features(), rule)
    assert goal.misfit_mm == pytest.approx([0.0] * 4, abs=1e-6)
    after = replace(component, X_MN=X, pivot_mm=X.apply(here.inverse().apply(component.pivot_mm)))
    errors = feature_errors(after, mate, features(), Budget(0.0, None, None))
    assert np.max(errors.norm_mm) < 1e-6


def test_only_one_side_grown_leaves_a_misfit_that_is_told() -> None:
    component, mate = fit(Pose.identity(), 50e-6), fit(Pose.identity())
    goal = docked_goal(component, mate, features())
    assert goal.misfit_mm == pytest.approx([2000.0 * 50e-6] * 4, rel=1e-3)
    assert goal.share == pytest.approx(goal.misfit_mm / 0.2)


def test_grown_points_lie_where_predict_puts_them() -> None:
    one = fit(Pose(euler_to_matrix(0.4, 0.3, 0.2), np.array([1.0, 2.0, 3.0])), 30e-6, (500.0, 0.0, 100.0))
    balls = np.array([[-3000.0, -1800.0, -1200.0], [3000.0, 1800.0, -1200.0]])
    assert np.allclose(one.X_MN.apply(one.grown(balls)), one.predict(balls), atol=1e-9)
    stretch = np.linalg.norm(np.diff(one.grown(balls), axis=0)) / np.linalg.norm(np.diff(balls, axis=0))
    assert stretch == pytest.approx(1.0 + 30e-6, abs=1e-9)
