"""Correction, guard and the convergence loop: docs/mechanics.md (27) to (29), (49), (50)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import (
    CorrectionTooLarge,
    Diverging,
    IterationsExhausted,
    RiskTooHigh,
    ToleranceUnprovable,
)
from docking.planning import (
    Action,
    Attempt,
    ConvergenceSettings,
    GuardSettings,
    attempt,
    check_correction,
    correction_to,
    decide,
    displaced,
)
from docking.types import Correction, FeatureErrors, Pose

FACE = np.array([4000.0, 0.0, 0.0])


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.from_rotvec(rng.uniform(-1, 1, 3)).as_matrix(), rng.uniform(-9000, 9000, 3))


@given(seed=st.integers(0, 1000))
def test_the_correction_takes_every_point_to_the_goal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    now, goal, points = random_pose(rng), random_pose(rng), rng.uniform(-4000, 4000, (6, 3))
    correction = correction_to(now, goal, FACE)
    np.testing.assert_allclose(displaced(correction, now.apply(points)), goal.apply(points), atol=1e-7)


def test_a_rotation_about_the_face_reads_as_no_shift() -> None:
    """About a distant origin 0.15 deg would read as a shift of 10 mm."""
    turn = Rotation.from_euler("y", 0.15, degrees=True).as_matrix()
    now = Pose.identity()
    goal = Pose(turn, FACE - turn @ FACE)
    correction = correction_to(now, goal, FACE)
    np.testing.assert_allclose(correction.shift_mm, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.degrees(correction.rotvec_rad), [0.0, 0.15, 0.0], atol=1e-12)
    np.testing.assert_array_equal(correction.pivot_W_mm, FACE)
    assert np.linalg.norm(goal.t_mm) == pytest.approx(10.47, abs=0.01)


def shift(mm: float, deg: float = 0.0) -> Correction:
    return Correction(FACE, np.radians([0.0, 0.0, deg]), np.array([0.0, mm, 0.0]))


@pytest.mark.parametrize(
    ("correction", "gap_mm", "passes"),
    [
        (shift(49.9, 1.9), None, True),
        (shift(50.1), None, False),
        (shift(0.0, 2.1), None, False),
        (shift(3.9), 300.0, True),
        (shift(4.1), 300.0, False),
        (shift(1.9), 10.0, True),
        (shift(2.1), 10.0, False),
        (shift(0.49), 0.0, True),
        (shift(0.51), 0.0, False),
        (shift(0.0, 0.009), 0.0, True),
        (shift(0.0, 0.011), 0.0, False),
        (shift(float("nan")), None, False),
        (shift(0.0, float("nan")), 3.0, False),
    ],
)
def test_guard(correction: Correction, gap_mm: float | None, passes: bool) -> None:
    if passes:
        check_correction(correction, GuardSettings(), "align", gap_mm)
        return
    with pytest.raises(CorrectionTooLarge, match="align"):
        check_correction(correction, GuardSettings(), "align", gap_mm)


def look(error: float, sigma: float = 0.01, corrections: int = 0, passes: int = 2, tolerance: float = 0.2) -> Attempt:
    return Attempt(corrections, passes, error, sigma, tolerance, error + 2 * sigma <= tolerance)


SETTINGS = ConvergenceSettings()


def test_attempt_takes_the_feature_with_the_largest_bound() -> None:
    errors = FeatureErrors(
        ("a", "b"), np.array([[0.1, 0, 0], [0, 0.06, 0.08]]), np.array([0.01, 0.03]), np.array([0.2, 0.2]), 0.001
    )
    assert attempt(errors, 1, 2) == Attempt(1, 2, pytest.approx(0.1), 0.03, 0.2, True, 0.001)
    unknown = FeatureErrors(errors.names, errors.error_mm, np.array([0.01, np.nan]), errors.tolerance_mm, 0.0)
    assert not attempt(unknown, 1, 2).accepted


@pytest.mark.parametrize(
    ("history", "action"),
    [
        ([look(0.17)], Action.DONE),
        ([look(0.19)], Action.MOVE),
        ([look(5.0)], Action.MOVE),
        ([look(0.04, 0.09)], Action.MEASURE_MORE),
        ([look(0.04, 0.09, passes=6)], Action.OUT_OF_TOLERANCE),
        ([look(0.08, 0.09)], Action.MEASURE_MORE),
        ([look(0.08, 0.09, passes=6)], Action.MOVE),
        ([look(1.0), look(1.5, corrections=1)], Action.MOVE),
        ([look(1.0), look(1.5, corrections=1), look(2.0, corrections=2)], Action.ABORT),
        ([look(1.0), look(1.5, corrections=1), look(1.2, corrections=2)], Action.MOVE),
        ([look(0.3), look(0.305, corrections=1), look(0.31, corrections=2)], Action.MOVE),
        ([look(1.0), look(1.1, corrections=1), look(1.5, corrections=1)], Action.MOVE),
        ([look(1.0 / (n + 1), corrections=n) for n in range(5)], Action.MOVE),
        ([look(2.0 / (n + 1), corrections=n) for n in range(6)], Action.OUT_OF_TOLERANCE),
        ([look(float("nan"))], Action.ABORT),
        ([look(0.1, float("inf"))], Action.ABORT),
    ],
)
def test_decide(history: list[Attempt], action: Action) -> None:
    verdict = decide(history, SETTINGS, "stand-off")
    assert verdict.action is action
    assert (verdict.error is not None) == (action in (Action.ABORT, Action.OUT_OF_TOLERANCE))
    assert (verdict.corrections, verdict.max_corrections) == (history[-1].corrections, 5)


def test_each_end_has_its_own_error() -> None:
    worse = [look(1.0), look(1.5, corrections=1), look(2.0, corrections=2)]
    spent = [look(2.0 / (n + 1), corrections=n) for n in range(6)]
    assert isinstance(decide(worse, SETTINGS).error, Diverging)
    assert isinstance(decide(spent, SETTINGS).error, IterationsExhausted)
    assert isinstance(decide([look(0.04, 0.09, passes=6)], SETTINGS).error, ToleranceUnprovable)


def test_a_refusal_on_risk_alone_gives_the_risk_and_its_limit() -> None:
    inside = replace(look(0.02, 0.05, tolerance=0.2, passes=6), accepted=False, risk=0.031)
    error = decide([inside], SETTINGS).error
    assert isinstance(error, RiskTooHigh)
    assert error.value == pytest.approx(3.1)
    assert error.limit == pytest.approx(2.5)
    assert "3.1 %" in error.text()
    assert "3.1 %" in error.text("zh")
    assert error.exit_code == 3
    wide = decide([look(0.04, 0.09, passes=6)], SETTINGS).error
    assert isinstance(wide, ToleranceUnprovable)
    assert not isinstance(wide, RiskTooHigh)
    assert (wide.value, wide.limit) == (pytest.approx(0.22), 0.2)


def test_the_dead_band_is_a_quarter_of_a_tight_tolerance() -> None:
    inside = look(0.02, 0.05, tolerance=0.1, passes=6)
    outside = look(0.03, 0.02, tolerance=0.06, passes=6)
    assert decide([inside], SETTINGS).action is Action.OUT_OF_TOLERANCE
    assert decide([outside], SETTINGS).action is Action.MOVE
