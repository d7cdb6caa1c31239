"""The bound on what a jammed axis does, against the same event played out step by step with other mathematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import StrainForeseen
from docking.kinematics import Positioners
from docking.planning import JamSettings, PlanRequest, make_plan, position_at
from docking.planning.jam import jam_bound
from docking.types import Array, Correction, Plan
from tests.reference_geometry import FACE, GUARDED, NAMES, crooked_axes, rc1, rc3

STIFFNESS = 20000.0


def moved(positioners: Positioners, shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> Plan:
    correction = Correction(FACE, np.radians(turn_deg), np.array(shift))
    return make_plan(PlanRequest(1, "s", "align", np.zeros(12), correction, 10.0, 0.01, False), positioners, GUARDED)


def sockets(positioners: Positioners, q: Array) -> Array:
    return np.array([
        positioners.origins_W_mm[i] + positioners.axes_W[i] @ q[3 * i : 3 * i + 3] for i in range(len(NAMES))
    ])  # fmt: skip


def distortion(balls: Array, figure: Array) -> tuple[float, float]:
    """(largest ball residual, largest ball force) of four balls held at `balls` by equal springs: Kabsch by SVD."""
    a, b = figure - figure.mean(axis=0), balls - balls.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    off = float(np.linalg.norm(b - a @ turn.T, axis=1).max())
    return off, STIFFNESS * off


def jammed(positioners: Positioners, plan: Plan, k: int, at_s: float) -> tuple[float, float]:
    """Axis k stays where it is at `at_s`; after it hangs back by stuck_mm the others go on for the reaction time and
    then take their path rate to zero in a straight line of time, at a_quick of the fastest."""
    jam = GUARDED.jam
    held = position_at(plan, at_s)[k]
    after = np.arange(at_s, plan.duration_s, plan.period_s / 4)
    behind = np.abs(np.interp(after, plan.t_s, plan.q_mm[:, k]) - held)
    t = plan.duration_s
    if np.any(behind >= jam.stuck_mm):
        rows = slice(0, int(np.argmax(behind >= jam.stuck_mm)) + 1)
        t = float(np.interp(jam.stuck_mm, behind[rows], after[rows])) + jam.reaction_s
    speed = np.abs(position_at(plan, t + 1e-3) - position_at(plan, t - 1e-3)) / 2e-3
    t += 0.5 * float((speed / positioners.a_quick_mm_s2).max())
    q = position_at(plan, t)
    q[k] = held
    return distortion(sockets(positioners, q), sockets(positioners, plan.q_mm[0]))


@pytest.mark.parametrize(
    ("shift", "turn_deg"),
    [((-60, 0, 0), (0, 0, 0)), ((0, 20, 0), (0, 0, 0)), ((0, 0, 30), (0, 0, 0)), ((-12, 8, 3), (0.2, -0.1, 0.4))],
)
def test_no_axis_that_jams_anywhere_exceeds_its_bound_and_the_bound_is_near(shift, turn_deg) -> None:
    positioners = rc1(crooked_axes(3, scale=0.0))
    plan = moved(positioners, shift, turn_deg)
    assert plan.bounds is not None
    worst = np.zeros((12, 2))
    for at in np.linspace(0.05, 0.95, 13):
        for k in range(12):
            worst[k] = np.maximum(worst[k], jammed(positioners, plan, k, float(at * plan.duration_s)))
    # Axes of a rotated positioner are square to each other, so equal springs along them are equal in every direction.
    assert np.all(worst[:, 0] <= plan.bounds.jam_mm * 1.001 + 1e-6)
    assert np.all(worst[:, 1] <= plan.bounds.jam_n * 1.01 + 0.1)
    fastest = int(np.argmax(plan.bounds.jam_n))
    assert plan.bounds.jam_n[fastest] <= 1.1 * worst[fastest, 1]
    assert plan.bounds.jam_mm[fastest] <= 1.1 * worst[fastest, 0]
    assert "jammed: internal force" in plan.speed_limited_by
    assert plan.bounds.jam_n.max() <= 1500.0


def test_the_permitted_speed_is_the_formulas() -> None:
    """c (stuck + v r + v^2 / 2a) = F: c = 13.9 kN/mm in X of RC-1, a = 200, r = 22 ms."""
    plan = moved(rc1(), (-100, 0, 0), (0, 0, 0))
    bound = jam_bound(rc1(), np.zeros(12), GUARDED.jam)
    assert bound.residual_per_mm[:3] == pytest.approx([0.69, 0.58, 0.25], abs=0.01)
    assert bound.force_per_mm[:3] == pytest.approx(STIFFNESS * bound.residual_per_mm[:3], rel=1e-6)
    room = 1500.0 / bound.force_per_mm[0] - 0.02
    v = 200.0 * (-0.022 + np.sqrt(0.022**2 + 2 * room / 200.0))
    assert plan.bounds is not None
    assert plan.bounds.peak_mm_s.max() == pytest.approx(v, rel=0.01)
    assert plan.bounds.quick_stop_s == pytest.approx(v / 200.0, rel=0.01)
    assert plan.bounds.ramp_mm[0] == pytest.approx(bound.residual_per_mm[0] * v * 0.022, rel=0.01)
    name, share = plan.bounds.limits[0]
    assert (name.split(" ", 1)[1], share) == ("jammed: internal force", pytest.approx(1.0, abs=1e-3))


def test_a_floor_of_the_ramp_and_a_slower_bus_cost_speed() -> None:
    peaks = []
    for jam in (JamSettings(), JamSettings(quick_floor_s=0.02), JamSettings(reaction_s=0.05), JamSettings(force_n=750)):
        asked = PlanRequest(1, "s", "k", np.zeros(12), Correction(FACE, np.zeros(3), np.array([-50.0, 0, 0])), 10.0,
                            0.01, False)  # fmt: skip
        plan = make_plan(asked, rc1(), replace(GUARDED, jam=jam))
        assert plan.bounds is not None
        assert plan.bounds.jam_n.max() <= jam.force_n * (1 + 1e-9)
        peaks.append(plan.bounds.peak_mm_s.max())
    assert peaks[0] > peaks[1] > peaks[2] > peaks[3]


def test_a_residual_limit_binds_where_it_is_the_stricter() -> None:
    asked = PlanRequest(1, "s", "k", np.zeros(12), Correction(FACE, np.zeros(3), np.array([-50.0, 0, 0])), 10.0, 0.01,
                        False)  # fmt: skip
    plan = make_plan(asked, rc1(), replace(GUARDED, jam=JamSettings(residual_mm=0.04)))
    assert "jammed: ball residual" in plan.speed_limited_by
    assert plan.bounds is not None
    assert 0.039 <= plan.bounds.jam_mm.max() <= 0.04


def test_what_no_speed_can_keep_is_refused_with_what_would_fit() -> None:
    asked = PlanRequest(1, "s", "k", np.zeros(12), Correction(FACE, np.zeros(3), np.array([-5.0, 0, 0])), 10.0, 0.01,
                        False)  # fmt: skip
    with pytest.raises(StrainForeseen, match="jammed: internal force") as refusal:
        make_plan(asked, rc1(), replace(GUARDED, jam=JamSettings(force_n=200.0)))
    assert refusal.value.limit == 200.0
    assert "would fit" in refusal.value.cause


def test_an_axis_that_alone_holds_a_direction_strains_nothing() -> None:
    """RC-3: A.X alone drives X; when it jams the part stays behind unstrained. A vertical axis warps it as in RC-1."""
    bound = jam_bound(rc3(), np.zeros(12), GUARDED.jam)
    driven = rc3().driven
    assert bound.force_per_mm[0] < 1.0
    assert bound.residual_per_mm[0] < 1e-4
    np.testing.assert_array_equal(bound.force_per_mm[~driven], 0.0)
    np.testing.assert_allclose(bound.residual_per_mm[~driven], 0.0, atol=1e-12)
    assert bound.force_per_mm[2] == pytest.approx(5000.0, rel=1e-3)
