"""The strain of a part from its load cells, and the step that takes it away: against statics told again here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import LoadCellSilent, PlanInputInvalid, StrokeExceeded
from docking.planning.relief import LoadCellErrors, ReliefSettings, Scales, StepRequest, Tare, Weighing, relief_plan
from tests.reference_geometry import SETTINGS, crooked_axes, rc1

POSITIONERS = rc1(crooked_axes(3))
M = len(POSITIONERS.axes)
PERFECT = LoadCellErrors(np.tile([10e3, 10e3, 50e3], 4), crosstalk=1e-9, drift_per_h=0.0, resolution_n=1e-6)
EXACT = ReliefSettings(PERFECT)
REAL = ReliefSettings(LoadCellErrors(np.tile([10e3, 10e3, 50e3], 4)))
Q = np.zeros(M)
RNG = np.random.default_rng(11)


def arms() -> np.ndarray:
    balls = POSITIONERS.origins_W_mm
    return balls - balls.mean(axis=0)


def wrench_rows() -> np.ndarray:
    """(6, m): force and moment in W that a force along each axis exerts, by virtual work; rotations in m."""
    rows = np.zeros((6, M))
    for i, (arm, inverse) in enumerate(zip(arms(), POSITIONERS.axes_inverse, strict=True)):
        for j in range(3):
            force = inverse[j]
            rows[:3, 3 * i + j] = force
            rows[3:, 3 * i + j] = np.cross(arm, force) / 1000.0
    return rows


def self_equilibrated(amount_n: float) -> np.ndarray:
    """A random internal force (m,) along the axes: no resultant, no moment."""
    null = np.linalg.svd(wrench_rows())[2][6:]
    force = null.T @ RNG.standard_normal(len(null))
    return amount_n * force / np.abs(force).max()


def carrying() -> np.ndarray:
    """The forces (m,) that the weight needs and no more: least energy in the springs."""
    weight = SETTINGS.load.mass_kg * SETTINGS.load.gravity_m_s2
    # Ball centres follow the axes at zero; the component's own frame lies where its balls fit them.
    com = SETTINGS.load.com_C_mm - POSITIONERS.balls_C_mm.mean(axis=0)
    need = -np.concatenate([weight, np.cross(com, weight) / 1000.0])
    return np.linalg.pinv(wrench_rows()) @ need


def weighing(force_n: np.ndarray) -> Weighing:
    return Weighing(Q, force_n, np.zeros(M))


@pytest.mark.parametrize("amount_n", [50.0, 1500.0])
def test_weight_drops_out_and_the_internal_force_is_left(amount_n):
    strain = self_equilibrated(amount_n)
    scales = Scales(POSITIONERS, SETTINGS, EXACT, Q)
    seen = scales.strain(weighing(carrying() + strain), None)
    assert seen.internal_n == pytest.approx(strain, abs=1e-3 * amount_n)
    at_balls = np.einsum("kji,kj->ki", POSITIONERS.axes_inverse, strain.reshape(-1, 3))
    assert seen.ball_n == pytest.approx(np.linalg.norm(at_balls, axis=1), rel=1e-3)


def test_the_step_takes_the_force_away_and_leaves_the_component_where_it_is():
    strain = self_equilibrated(300.0)
    scales = Scales(POSITIONERS, SETTINGS, replace(EXACT, share=1.0, rise=10.0), Q)
    force = carrying() + strain
    step = scales.step_mm(scales.strain(weighing(force), None), weighing(force))
    stiffness = POSITIONERS.stiffness_n_per_mm.reshape(-1)
    assert force + stiffness * step == pytest.approx(carrying(), abs=1.0)
    assert wrench_rows() @ (stiffness * step) == pytest.approx(np.zeros(6), abs=1e-6 * np.abs(stiffness * step).max())
    wrong_way = scales.strain(weighing(force - stiffness * step), None)
    assert wrong_way.largest_n > 1.9 * scales.strain(weighing(force), None).largest_n


@pytest.mark.parametrize("amount_n", [300.0, 1500.0, 6000.0])
def test_no_step_is_longer_than_allowed_nor_raises_a_ball_by_more_than_half_the_limit(amount_n):
    strain = self_equilibrated(amount_n)
    scales = Scales(POSITIONERS, SETTINGS, EXACT, Q)
    before = scales.strain(weighing(carrying() + strain), None)
    step = scales.step_mm(before, weighing(carrying() + strain))
    assert 0.0 < np.abs(step).max() <= EXACT.step_mm * (1.0 + 1e-12)
    moved = carrying() + strain + POSITIONERS.stiffness_n_per_mm.reshape(-1) * step
    after = scales.strain(weighing(moved), None)
    assert np.all(after.force_n - before.force_n <= 0.5 * scales.rise_limit_n(before) + 1e-6)
    assert after.largest_n < before.largest_n


def test_a_tare_takes_off_what_level_load_cells_add_and_not_what_vertical_ones_show():
    """150 N of cross-talk on every level axis, and a real warp of 400 N since then."""
    level = np.tile([1.0, 1.0, 0.0], 4) * 150.0 * RNG.standard_normal(M)
    warp = np.zeros(M)
    warp[2::3] = 400.0 * np.array([1.0, -1.0, 1.0, -1.0])
    scales = Scales(POSITIONERS, SETTINGS, REAL, Q)
    zero, now = weighing(carrying() + level), weighing(carrying() + level + warp)
    off = [np.abs(scales.strain(now, tare).internal_n - warp).max() for tare in (None, Tare(zero, 0.1))]
    assert off[1] < 60.0
    sigmas = [scales.strain(now, tare).sigma_n for tare in (None, Tare(zero, 0.1))]
    assert sigmas[1] < 0.6 * sigmas[0]
    vertical = scales.strain(now, Tare(now, 0.1)).internal_n[2::3]
    # A warp that was there at the tare is no error of a load cell, but for the fifth that zero drift may have added.
    assert np.abs(vertical) == pytest.approx(np.full(4, 400.0), rel=0.22)


def test_what_load_cells_may_invent_moves_no_axis():
    level = np.tile([1.0, -1.0, 0.0], 4) * 100.0
    seen = Scales(POSITIONERS, SETTINGS, REAL, Q).strain(weighing(carrying() + level), None)
    assert seen.largest_n == 0.0
    assert seen.sigma_n > 100.0


@pytest.mark.parametrize("tared", [True, False])
def test_a_push_from_outside_is_no_strain(tared):
    scales = Scales(POSITIONERS, SETTINGS, REAL, Q)
    tare = Tare(weighing(carrying()), 0.1) if tared else None
    push = np.linalg.pinv(wrench_rows()) @ np.array([0.0, 6000.0, 0.0, 0.0, 0.0, 0.0])
    quiet, pushed = (scales.strain(weighing(carrying() + p), tare) for p in (0.0 * push, push))
    assert np.all(quiet.foreign_n <= quiet.foreign_limit_n)
    assert np.any(pushed.foreign_n > pushed.foreign_limit_n)
    assert pushed.largest_n < 1.0


def test_a_missing_load_cell_is_named():
    force = carrying()
    force[7] = np.nan
    with pytest.raises(LoadCellSilent, match=r"C\.Y"):
        Scales(POSITIONERS, SETTINGS, REAL, Q).strain(weighing(force), None)


def request(step: np.ndarray, period_s: float = 0.01) -> StepRequest:
    return StepRequest(1, Q, step, period_s)


@pytest.mark.parametrize("period_s", [0.01, 0.1])
@pytest.mark.parametrize("length_mm", [0.05, 0.004])
def test_the_plan_is_straight_slow_and_inside_every_limit(length_mm, period_s):
    step = length_mm * RNG.uniform(-1.0, 1.0, M)
    step[5] = -length_mm
    plan = relief_plan(request(step, period_s), POSITIONERS, SETTINGS, EXACT)
    assert (plan.kind, plan.q_mm[0].tolist()) == ("relief", Q.tolist())
    assert plan.q_mm[-1] == pytest.approx(step, abs=1e-15)
    assert np.all(np.abs(plan.q_mm - plan.s[:, None] * step) < 1e-15)
    speed = np.diff(plan.q_mm, axis=0) / plan.period_s
    assert np.abs(speed).max() <= 0.1
    padded = np.vstack([np.zeros((2, M)), speed, np.zeros((2, M))])
    acceleration = np.diff(padded, axis=0) / plan.period_s
    jerk = np.diff(acceleration, axis=0) / plan.period_s
    assert np.all(np.abs(acceleration).max(axis=0) <= POSITIONERS.a_mm_s2)
    assert np.all(np.abs(jerk).max(axis=0) <= POSITIONERS.j_mm_s3 * (1.0 + 1e-6))
    assert plan.bounds is not None
    assert np.all(plan.bounds.jam_n < 1500.0)


def test_a_plan_differs_from_every_other_by_its_hash():
    steps = [0.01 * np.eye(M)[k] for k in range(3)]
    hashes = {relief_plan(request(step), POSITIONERS, SETTINGS, EXACT).plan_hash for step in steps}
    assert len(hashes) == 3


@pytest.mark.parametrize("length_mm", [0.0501, float("nan"), float("inf")])
def test_a_longer_step_is_refused(length_mm):
    with pytest.raises(PlanInputInvalid):
        relief_plan(request(np.where(np.arange(M) == 2, length_mm, 0.0)), POSITIONERS, SETTINGS, EXACT)


def test_a_step_past_the_end_of_a_stroke_is_refused_and_one_back_is_not():
    low = POSITIONERS.stroke_mm[4, 0] + SETTINGS.stroke_margin_mm
    q = Q.copy()
    q[4] = low
    for by_mm, fits in ((-0.02, False), (0.02, True)):
        asked = StepRequest(1, q, by_mm * np.eye(M)[4], 0.01)
        if fits:
            relief_plan(asked, POSITIONERS, SETTINGS, EXACT)
            continue
        with pytest.raises(StrokeExceeded, match=r"B\.Y"):
            relief_plan(asked, POSITIONERS, SETTINGS, EXACT)
