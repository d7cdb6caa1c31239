"""Whole plans: limits on the emitted set-points, rigidity, refusals. docs/mechanics.md, sections 9 to 13."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import (
    AxisLimitExceeded,
    BallReactionOut,
    BallSwivelExceeded,
    DockingError,
    PlanInputInvalid,
    StrokeExceeded,
)
from docking.kinematics import Positioners, socket_positions
from docking.planning import PlanRequest, PlanSettings, displaced, make_plan, position_at
from docking.types import Array, Correction, Plan
from tests.reference_geometry import AXES, FACE, SETTINGS, crooked_axes, rc1, rc3, with_com

STILL = np.zeros(3)
Triple = tuple[float, float, float]


def request(shift: Triple, rotation_deg: Triple = (0, 0, 0), **other: object) -> PlanRequest:
    correction = Correction(FACE, np.radians(rotation_deg), np.array(shift))
    plain = PlanRequest(1, "align", "correction", np.zeros(12), correction, 5.0, 0.01, False)
    return replace(plain, **other)  # type: ignore[arg-type]


def wide() -> Positioners:
    """RC-1 with strokes that never bind."""
    return replace(rc1(), stroke_mm=np.tile([-5000.0, 5000.0], (12, 1)))


def differences(plan: Plan) -> list[Array]:
    """Largest |v|, |a|, |j| of each axis from the table alone, at rest before and after."""
    q = np.vstack([np.tile(plan.q_mm[0], (3, 1)), plan.q_mm, np.tile(plan.q_mm[-1], (3, 1))])
    return [np.abs(np.diff(q, order, axis=0)).max(axis=0) / plan.period_s**order for order in (1, 2, 3)]


def rigid_error(positioners: Positioners, q: Array, reference: Array) -> float:
    figure, start = socket_positions(positioners, q), socket_positions(positioners, reference)
    gaps = np.linalg.norm(figure[..., :, None, :] - figure[..., None, :, :], axis=-1)
    return float(np.abs(gaps - np.linalg.norm(start[:, None] - start[None], axis=-1)).max())


@st.composite
def cells(draw: st.DrawFn) -> tuple[Positioners, PlanSettings, PlanRequest]:
    """A crooked cell with its own limit on every axis, a start and a correction, on either kind of bus."""
    seed = draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    geometry = rc1(crooked_axes(seed, base_deg=draw(st.sampled_from([0.0, 0.5, 20.0]))))
    positioners = replace(
        geometry,
        stroke_mm=np.tile([-2000.0, 2000.0], (12, 1)),
        v_mm_s=rng.uniform(1, 20, 12),
        a_mm_s2=rng.uniform(2, 40, 12),
        j_mm_s3=rng.uniform(10, 400, 12),
    )
    queued = draw(st.booleans())
    scale = draw(st.sampled_from([1e-9, 1e-3, 0.1, 1.0]))
    correction = Correction(
        rng.uniform(-5000, 5000, 3), scale * np.radians(rng.uniform(-3, 3, 3)), scale * rng.uniform(-100, 100, 3)
    )
    asked = PlanRequest(
        seed, "s", "k", rng.uniform(-50, 50, 12), correction, draw(st.sampled_from([0.2, 5.0, 1000.0])),
        0.1 if queued else draw(st.sampled_from([0.002, 0.01, 0.02])), queued,
    )  # fmt: skip
    bus = {"start_skew_s": 0.001, "clock_ppm": 50.0, "playback_ramp_s": 0.5, "sync_error_mm": 0.2} if queued else {}
    return positioners, replace(SETTINGS, **bus), asked


@settings(deadline=None, max_examples=60)
@given(cells())
def test_emitted_set_points_stay_inside_every_limit(cell: tuple[Positioners, PlanSettings, PlanRequest]) -> None:
    positioners, plan_settings, asked = cell
    plan = make_plan(asked, positioners, plan_settings)
    v, a, j = differences(plan)
    assert np.all(v <= positioners.v_mm_s * (1 + 1e-6))
    assert np.all(a <= positioners.a_mm_s2 * (1 + 1e-6))
    assert np.all(j <= positioners.j_mm_s3 * (1 + 1e-5) + 1e-3)
    balls = np.linalg.norm(np.diff(socket_positions(positioners, plan.q_mm), axis=0), axis=2) / plan.period_s
    assert balls.max() <= asked.speed_mm_s * (1 + 1e-6)
    assert rigid_error(positioners, plan.q_mm, asked.q_now_mm) <= 1e-6
    np.testing.assert_array_equal(plan.q_mm[0], asked.q_now_mm)
    assert (plan.s[0], plan.s[-1]) == (0.0, 1.0)
    assert plan.rate_slew_per_s > 0.0
    if plan_settings.playback_ramp_s:
        assert plan.rate_slew_per_s == pytest.approx(2.0)
    bend = np.abs(np.diff(plan.q_mm, 2, axis=0)) / plan.period_s**2
    slope = np.abs(np.diff(plan.q_mm, axis=0)) / plan.period_s * plan.rate_slew_per_s
    ramping = bend + np.minimum(slope[1:], slope[:-1])
    assert np.all(ramping.max(axis=0) <= positioners.a_mm_s2 * 1.001)


@pytest.mark.parametrize("rotation", [(0, 0, 0), (0.5, -0.5, 0.5), (0, 0, 2)])
def test_between_the_rows_the_part_stays_rigid(rotation: tuple[float, float, float]) -> None:
    positioners, asked = replace(wide(), axes_W=crooked_axes(4)), request((-20, 5, 3), rotation)
    plan = make_plan(asked, positioners, SETTINGS)
    times = np.random.default_rng(0).uniform(-0.1, plan.duration_s + 0.1, 500)
    q = np.array([position_at(plan, float(t)) for t in times])
    assert rigid_error(positioners, q, asked.q_now_mm) <= 1e-9
    np.testing.assert_allclose(position_at(plan, plan.t_s[7]), plan.q_mm[7], atol=1e-12)
    np.testing.assert_array_equal(position_at(plan, -1.0), plan.q_mm[0])
    np.testing.assert_allclose(position_at(plan, 1e9), plan.q_mm[-1], atol=1e-12)
    linear = np.array([np.interp(times, plan.t_s, plan.q_mm[:, k]) for k in range(12)]).T
    assert rigid_error(positioners, linear, asked.q_now_mm) <= 1e-6


def test_the_end_is_where_the_correction_says() -> None:
    positioners, asked = rc1(crooked_axes(2)), request((-20, 5, 3), (0.2, 0.1, -0.4))
    plan = make_plan(asked, positioners, SETTINGS)
    goal = displaced(asked.correction, socket_positions(positioners, plan.q_mm[0]))
    np.testing.assert_allclose(socket_positions(positioners, plan.q_mm[-1]), goal, atol=1e-9)
    left = {axis: left for axis, _, left in plan.margins}
    assert left["A.X"] >= 10.0 - 5.0
    assert len(plan.plan_hash) == 64


def test_an_insertion_takes_the_time_of_its_speed() -> None:
    """200 mm at 5 mm/s with half of 10 mm/s^2: D/V + V/A + A/J = 41.1 s."""
    plan = make_plan(request((-200, 0, 0)), rc1(), SETTINGS)
    assert plan.duration_s == pytest.approx(200 / 5 + 5 / 5 + 5 / 50, abs=0.03)
    assert plan.speed_limited_by == "stage speed"
    assert {axis: room for axis, room, _ in plan.margins}["B.X"] == pytest.approx(150.0, abs=1e-6)
    slow_axis = np.where(np.array(AXES) == "C.X", 0.5, 10.0)
    slowed = make_plan(request((-200, 0, 0)), replace(rc1(), v_mm_s=slow_axis), SETTINGS)
    assert slowed.speed_limited_by == "C.X speed"
    assert slowed.duration_s == pytest.approx(400, rel=0.01)


def test_own_clocks_bound_the_speed() -> None:
    """v <= delta / (skew + 2 ppm T): 10 ms of skew and 0.02 mm allow 2 mm/s."""
    bus = replace(SETTINGS, start_skew_s=0.010, sync_error_mm=0.02)
    plan = make_plan(request((-20, 0, 0)), rc1(), bus)
    assert plan.speed_limited_by == "start skew of the bus"
    assert differences(plan)[0].max() == pytest.approx(2.0, rel=0.01)
    with pytest.raises(AxisLimitExceeded, match="drift"):
        make_plan(request((-400, 0, 0)), rc1(), replace(SETTINGS, clock_ppm=50.0, sync_error_mm=0.02))


def test_queued_plans_end_on_the_grid_and_leave_room_for_the_devices_ramp() -> None:
    bus = replace(SETTINGS, playback_ramp_s=0.5)
    plan = make_plan(request((-100, 0, 0), period_s=0.1, linear_interpolation=True), rc1(), bus)
    assert plan.duration_s == pytest.approx(0.1 * (len(plan.t_s) - 1))
    assert plan.rate_slew_per_s == 2.0
    speed = np.abs(np.diff(plan.q_mm, axis=0))[1:] / 0.1
    bend = np.abs(np.diff(plan.q_mm, 2, axis=0)) / 0.01
    assert np.all(speed / 0.5 + bend <= 10.0 * 1.02)
    assert plan.duration_s < 27.0


def test_chord_error_is_stated_for_linear_interpolation_only() -> None:
    asked = request((0, 0, 0), (0.0, 0.0, 2.0), period_s=0.1, linear_interpolation=True)
    plan = make_plan(asked, wide(), SETTINGS)
    turn = np.radians(2.0) * np.diff(plan.s).max()
    assert plan.chord_error_mm == pytest.approx(np.hypot(6000, 3600) * turn**2 / 8)
    assert 0.0 < plan.chord_error_mm <= SETTINGS.chord_error_mm
    tight = make_plan(asked, wide(), replace(SETTINGS, chord_error_mm=1e-7))
    assert tight.speed_limited_by == "chord error of the interpolation"
    assert tight.chord_error_mm <= 1e-7
    assert make_plan(replace(asked, linear_interpolation=False), wide(), SETTINGS).chord_error_mm == 0.0


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-9, 1e-6])
def test_moves_of_almost_nothing_are_plans(size: float) -> None:
    plan = make_plan(request((size, 0, 0), (size, 0, 0)), rc1(), SETTINGS)
    assert len(plan.t_s) >= 5
    np.testing.assert_allclose(plan.displacement_mm, 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("asked", "axis"),
    [
        (request((0, 74, 0)), "A.Y"),
        (request((149, 0, 0)), "A.X"),
        (request((0, 0, -199)), "A.Z"),
        (request((0, 0, 0), (0, 0, 1.4)), "A.Y"),
        (request((0, 0, 0), (0, 2.0, 0)), "A.Z"),
    ],
)
def test_strokes_with_their_margin(asked: PlanRequest, axis: str) -> None:
    with pytest.raises(StrokeExceeded, match=axis) as refusal:
        make_plan(asked, rc1(), SETTINGS)
    assert "s = " in refusal.value.cause
    assert isinstance(refusal.value.limit, float)


def test_passive_strokes_are_checked_too() -> None:
    strokes = rc3().stroke_mm.copy()
    strokes[7] = -40.0, 40.0
    with pytest.raises(StrokeExceeded, match=r"C\.Y"):
        make_plan(request((0, 50, 0)), replace(rc3(), stroke_mm=strokes), SETTINGS)


def test_a_bulge_inside_the_move_is_seen() -> None:
    """A ball turning about its positioner leaves the stroke in the middle of the move and is back inside at the end."""
    pivot = np.array([-3000.0, -6800.0, -1200.0])
    aside = request((0, 0, 0), correction=Correction(pivot, np.radians([0, 0, -10.0]), STILL))
    q_start = make_plan(aside, wide(), SETTINGS).q_mm[-1]
    bulge = replace(aside, q_now_mm=q_start, correction=Correction(pivot, np.radians([0, 0, 20.0]), STILL))
    through = make_plan(bulge, wide(), SETTINGS).q_mm[:, 1]
    assert through.max() > max(through[0], through[-1]) + 50.0
    strokes = wide().stroke_mm.copy()
    strokes[1, 1] = max(through[0], through[-1]) + 30.0
    with pytest.raises(StrokeExceeded, match=r"A\.Y"):
        make_plan(bulge, replace(wide(), stroke_mm=strokes), SETTINGS)


def test_from_outside_only_the_way_back_is_allowed() -> None:
    q = np.zeros(12)
    q[1::3] = 80.0  # 7 mm beyond the margin of all Y axes
    back = make_plan(request((0, -4, 0), q_now_mm=q), rc1(), SETTINGS)
    np.testing.assert_allclose(back.q_mm[-1, 1::3], 76.0)
    for shift in ((0, 1, 0), (10, 0, 0), (0, -155, 0)):
        with pytest.raises(StrokeExceeded):
            make_plan(request(shift, q_now_mm=q), rc1(), SETTINGS)


def test_swivel_is_counted_from_the_built_attitude() -> None:
    make_plan(request((0, 0, 0), (0, 0, 14.9)), wide(), SETTINGS)
    with pytest.raises(BallSwivelExceeded):
        make_plan(request((0, 0, 0), (0, 0, 15.1)), wide(), SETTINGS)
    tight = replace(rc1(), swivel_rad=np.radians([15.0, 15.0, 0.3, 15.0]))
    with pytest.raises(BallSwivelExceeded, match="C"):
        make_plan(request((0, 0, 0), (0, 0, 0.4)), tight, SETTINGS)
    built = Rotation.from_euler("z", 40.0, degrees=True).as_matrix()
    askew = replace(wide(), neutral_R_WC=built, balls_C_mm=wide().balls_C_mm @ built)
    make_plan(request((0, 0, 0), (0, 0, 14.9)), askew, SETTINGS)
    with pytest.raises(BallSwivelExceeded):
        make_plan(request((0, 0, 0), (0, 0, 15.1)), askew, SETTINGS)


def test_reactions_over_the_tolerance_of_the_centre_of_mass() -> None:
    make_plan(request((1, 0, 0)), rc1(), with_com([600.0, 200.0, 0.0], 100.0))
    with pytest.raises(BallReactionOut, match="A"):
        make_plan(request((1, 0, 0)), rc1(), with_com([2100.0, 400.0, 0.0]))
    with pytest.raises(BallReactionOut, match="A"):
        make_plan(request((1, 0, 0)), rc1(), with_com([1500.0, 400.0, 0.0], 250.0))
    with pytest.raises(BallReactionOut, match="B"):
        make_plan(request((1, 0, 0)), rc3(d_z_driven=False), with_com([600.0, 400.0, 0.0]))
    weak = replace(rc1(), rated_n=np.tile([10000.0, 10000.0, 19000.0], (4, 1)))
    with pytest.raises(BallReactionOut, match=r"C\.Z"):
        make_plan(request((1, 0, 0)), weak, SETTINGS)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("field", ["q_now_mm", "speed_mm_s", "period_s", "pivot", "rotation", "shift"])
def test_what_is_not_a_number_is_refused(field: str, bad: float) -> None:
    good = request((1, 0, 0))
    if field in ("speed_mm_s", "period_s"):
        asked = replace(good, **{field: bad})
    elif field == "q_now_mm":
        asked = replace(good, q_now_mm=np.where(np.arange(12) == 5, bad, 0.0))
    else:
        name = {"pivot": "pivot_W_mm", "rotation": "rotvec_rad", "shift": "shift_mm"}[field]
        asked = replace(good, correction=replace(good.correction, **{name: np.array([0.0, bad, 0.0])}))
    with pytest.raises(PlanInputInvalid):
        make_plan(asked, rc1(), SETTINGS)


def test_zero_negative_and_misshapen_input_is_refused() -> None:
    for asked in (
        request((1, 0, 0), speed_mm_s=0.0),
        request((1, 0, 0), speed_mm_s=-5.0),
        request((1, 0, 0), period_s=0.0),
        request((1, 0, 0), q_now_mm=np.zeros(11)),
        request((1, 0, 0), (0, 0, 200.0)),
    ):
        with pytest.raises(PlanInputInvalid):
            make_plan(asked, rc1(), SETTINGS)


def test_the_hash_is_of_the_content() -> None:
    plan = make_plan(request((5, 0, 0)), rc1(), SETTINGS)
    assert make_plan(request((5, 0, 0)), rc1(), SETTINGS).plan_hash == plan.plan_hash
    others = [
        request((5.0000001, 0, 0)),
        request((5, 0, 0), plan_id=2),
        request((5, 0, 0), stage="insert"),
        request((5, 0, 0), q_now_mm=np.full(12, 1e-9)),
        request((5, 0, 0), speed_mm_s=4.0),
    ]
    hashes = {make_plan(asked, rc1(), SETTINGS).plan_hash for asked in others}
    assert len(hashes | {plan.plan_hash}) == len(others) + 1


def test_refusals_speak_in_both_languages() -> None:
    with pytest.raises(DockingError) as refusal:
        make_plan(request((0, 74, 0)), rc1(), SETTINGS)
    assert "A.Y" in refusal.value.text("zh")
    assert refusal.value.remedy("zh") != refusal.value.remedy("en")
