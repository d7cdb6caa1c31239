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
from tests.reference_geometry import AXES, FACE, GUARDED, NAMES, crooked_axes, rc1, rc3

STIFFNESS = 20000.0
UP = np.array([0.0, 0.0, 1.0])


def moved(positioners: Positioners, shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> Plan:
    correction = Correction(FACE, np.radians(turn_deg), np.array(shift))
    return make_plan(PlanRequest(1, "s", "align", np.zeros(12), correction, 10.0, 0.01, False), positioners, GUARDED)


def sockets(positioners: Positioners, q: Array) -> Array:
    return np.array([
        positioners.origins_W_mm[i] + positioners.axes_W[i] @ q[3 * i : 3 * i + 3] for i in range(len(NAMES))
    ])  # fmt: skip


def distortion(balls: Array, figure: Array) -> tuple[float, float, float]:
    """(largest ball residual, largest ball force, warp) of four balls held at `balls` by equal springs: Kabsch."""
    a, b = figure - figure.mean(axis=0), balls - balls.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    gap = b - a @ turn.T
    off = float(np.linalg.norm(gap, axis=1).max())
    return off, STIFFNESS * off, STIFFNESS * abs(float(gap[:, 2] @ [0.25, -0.25, 0.25, -0.25]))


def jammed(positioners: Positioners, plan: Plan, k: int, at_s: float) -> tuple[float, float, float]:
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
    ("shift", "turn_deg", "limit"),
    [
        ((-60, 0, 0), (0, 0, 0), "internal force"),
        ((0, 20, 0), (0, 0, 0), "internal force"),
        ((0, 0, 30), (0, 0, 0), "warp"),
        ((-12, 8, 3), (0.0, -0.05, 0.4), "internal force"),
        ((-12, 8, 3), (0.2, -0.1, 0.4), "warp"),
    ],
)
def test_no_axis_that_jams_anywhere_exceeds_its_bound_and_the_bound_is_near(shift, turn_deg, limit) -> None:
    positioners = rc1(crooked_axes(3, scale=0.0))
    plan = moved(positioners, shift, turn_deg)
    assert plan.bounds is not None
    worst = np.zeros((12, 3))
    for at in np.linspace(0.05, 0.95, 13):
        for k in range(12):
            worst[k] = np.maximum(worst[k], jammed(positioners, plan, k, float(at * plan.duration_s)))
    # Axes of a rotated positioner are square to each other, so equal springs along them are equal in every direction.
    assert np.all(worst[:, 0] <= plan.bounds.jam_mm * 1.001 + 1e-6)
    assert np.all(worst[:, 1] <= plan.bounds.jam_n * 1.01 + 0.1)
    fastest = int(np.argmax(plan.bounds.jam_n))
    assert plan.bounds.jam_n[fastest] <= 1.1 * worst[fastest, 1]
    assert plan.bounds.jam_mm[fastest] <= 1.1 * worst[fastest, 0]
    assert np.all(worst[:, 2] <= plan.bounds.jam_warp_n * 1.01 + 1.0)
    assert f"jammed: {limit}" in plan.speed_limited_by
    assert plan.bounds.jam_n.max() <= 1500.0
    assert plan.bounds.jam_warp_n.max() <= 300.0
    if limit == "warp":
        twisted = int(np.argmax(plan.bounds.jam_warp_n))
        assert 300.0 * 0.99 <= plan.bounds.jam_warp_n[twisted] <= 1.1 * worst[twisted, 2]


def test_the_permitted_speed_is_the_formulas() -> None:
    """c (stuck + v r + v^2 / 2a) = F: c = 13.9 kN/mm in X of RC-1, a = 200, r = 22 ms."""
    plan = moved(rc1(), (-100, 0, 0), (0, 0, 0))
    bound = jam_bound(rc1(), np.zeros(12), GUARDED.jam, UP)
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
    bound = jam_bound(rc3(), np.zeros(12), GUARDED.jam, UP)
    assert bound.force_per_mm[0] < 1.0
    assert bound.residual_per_mm[0] < 1e-4
    assert bound.force_per_mm[2] == pytest.approx(5000.0, rel=1e-3)


@pytest.mark.parametrize("axis", ["B.X", "C.X", "C.Y", "D.X", "D.Y"])
def test_an_axis_without_power_that_jams_holds_against_those_that_lead(axis: str) -> None:
    """The same strain as by that axis led to the wrong place: springs do not know who drives."""
    k, driven = AXES.index(axis), rc3().driven.copy()
    driven[k] = True
    free, led = (jam_bound(p, np.zeros(12), GUARDED.jam, UP) for p in (rc3(), rc1(driven=driven)))
    assert free.force_per_mm[k] > 5000.0
    for cost in ("residual_per_mm", "force_per_mm", "warp_per_mm"):
        assert getattr(free, cost)[k] == pytest.approx(getattr(led, cost)[k], rel=1e-9)
    v = np.full(12, 2.0)
    assert free.reach_mm(v)[k] == pytest.approx(0.1 + 2.0 * 0.032 + 4.0 / 400.0)
    assert free.reach_mm(v)[0] == pytest.approx(0.02 + 2.0 * 0.022 + 4.0 / 400.0)
    assert free.ramp_mm(v)[k] == 0.0, "without power it cannot ramp down"


def test_two_level_axes_in_a_row_are_springs_in_a_row() -> None:
    """A.X leads, B.X jams: along X two springs of 20 kN/mm in a row, 10 kN/mm, and a little yaw takes from it."""
    bound = jam_bound(rc3(), np.zeros(12), GUARDED.jam, UP)
    assert 9000.0 < bound.force_per_mm[AXES.index("B.X")] <= 10000.0


def test_the_level_speed_is_bounded_by_guides_that_may_jam() -> None:
    """F (0.1 + v 32 ms + v^2 / 2 a) = 1500 N: a cycle until a read-back shows it, then as for any axis."""
    asked = PlanRequest(1, "s", "k", np.zeros(12), Correction(FACE, np.zeros(3), np.array([-60.0, 0, 0])), 10.0, 0.01,
                        False)  # fmt: skip
    plan = make_plan(asked, rc3(), GUARDED)
    worst = jam_bound(rc3(), np.zeros(12), GUARDED.jam, UP).force_per_mm[AXES.index("B.X")]
    v = 200.0 * (-0.032 + np.sqrt(0.032**2 + 2.0 * (1500.0 / worst - 0.1) / 200.0))
    assert plan.bounds is not None
    assert plan.bounds.peak_mm_s[0] == pytest.approx(v, rel=0.01)
    assert plan.speed_limited_by == "B.X jammed: internal force"
    with pytest.raises(StrainForeseen, match="jammed: ball residual") as refusal:
        make_plan(asked, rc3(), replace(GUARDED, jam=JamSettings(passive_mm=0.5)))
    assert "limits.passive_mm = 0.5; less than 0.2 mm would fit" in refusal.value.cause


HELD_N, TOLERANCE_N = 13400.0, 268.0
D_Z = 11


def with_held_force() -> Positioners:
    """RC-3 whose D.Z holds its force."""
    only = np.eye(12)[D_Z]
    return replace(rc3(d_z_driven=False), held_n=HELD_N * only, held_tolerance_n=TOLERANCE_N * only)


def raised(mm: float, jam: JamSettings) -> Plan:
    asked = PlanRequest(1, "s", "k", np.zeros(12), Correction(FACE, np.zeros(3), np.array([0.0, 0.0, mm])), 10.0, 0.01,
                        False)  # fmt: skip
    return make_plan(asked, with_held_force(), replace(GUARDED, jam=jam))


def test_a_held_force_that_jams_holds_a_position_as_a_driven_axis_does() -> None:
    """The six others drive the part statically determinate: alone they strain nothing."""
    held, driven = (jam_bound(p, np.zeros(12), GUARDED.jam, UP) for p in (with_held_force(), rc3()))
    assert held.force_per_mm[D_Z] == pytest.approx(5000.0, rel=1e-3)
    for cost in ("residual_per_mm", "force_per_mm", "warp_per_mm"):
        assert getattr(held, cost)[D_Z] == pytest.approx(getattr(driven, cost)[D_Z], rel=1e-9)
    np.testing.assert_allclose(held.force_per_mm[with_held_force().driven], 0.0, atol=1.0)
    assert held.tolerance_mm[D_Z] == pytest.approx(TOLERANCE_N / 5000.0, rel=1e-3)
    assert np.isnan(np.delete(held.tolerance_mm, D_Z)).all()


@pytest.mark.parametrize("v", [0.1, 0.23, 0.3, 0.99, 3.0, 8.0])
def test_its_jam_is_seen_by_its_load_cell(v: float) -> None:
    """0.0536 mm, then two readings of 0.1 s. Its encoder shows where its force is, and tells nothing."""
    after_s = 0.022 + 0.5 * v / 200.0
    by_hand = 0.0536 + v * (0.2 + after_s)
    reach = jam_bound(with_held_force(), np.zeros(12), GUARDED.jam, UP).reach_mm(np.full(12, v))
    assert reach[D_Z] == pytest.approx(by_hand, rel=1e-3)
    assert reach[2] == pytest.approx(0.02 + v * after_s)


def test_the_speed_of_a_part_on_a_held_force_is_the_formulas() -> None:
    """5 kN/mm x (0.0536 + v 222 ms + v^2 / 2 a) = 600 N of warp, a = 200: 0.30 mm/s. The others would let it run."""
    plan = raised(60.0, JamSettings())
    assert plan.bounds is not None
    v = 200.0 * (-0.222 + np.sqrt(0.222**2 + 2.0 * (0.12 - TOLERANCE_N / 5000.0) / 200.0))
    assert plan.bounds.peak_mm_s[D_Z] == pytest.approx(v, rel=0.01)
    assert plan.speed_limited_by == "D.Z jammed: warp"
    assert plan.bounds.jam_warp_n[D_Z] == pytest.approx(600.0, rel=0.01)
    assert plan.bounds.jam_warp_n[D_Z] <= 600.0


def test_a_tolerance_over_the_limit_fits_no_speed() -> None:
    with pytest.raises(StrainForeseen, match=r"D\.Z jammed: warp") as refusal:
        raised(5.0, JamSettings(held_warp_n=250.0))
    assert "force_tolerance in mm = 0.0536" in refusal.value.cause


def test_the_vertical_speed_is_bounded_by_warp() -> None:
    """5 kN/mm x (0.02 + v 22 ms + v^2 / 2 a) = 300 N, a = 200: 1.55 mm/s where the force alone would let 8 mm/s."""
    plan = moved(rc1(), (0, 0, 40), (0, 0, 0))
    v = 200.0 * (-0.022 + np.sqrt(0.022**2 + 2.0 * 0.04 / 200.0))
    assert plan.bounds is not None
    assert plan.bounds.peak_mm_s[2] == pytest.approx(v, rel=0.01)
    assert plan.bounds.jam_warp_n.max() == pytest.approx(300.0, rel=0.01)
    assert plan.speed_limited_by.endswith("jammed: warp")
