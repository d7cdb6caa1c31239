"""Rows PLN-01 to PLN-06: what is never planned, and what a plan never does."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.config.budget import docked_pose
from docking.errors import DockingError, MateTooNear, PlanInputInvalid, StrokeExceeded
from docking.geometry import exp_so3, pose_from_vector
from docking.kinematics import axis_positions
from docking.planning import PlanRequest, Scene, correction_to, make_plan
from docking.planning.path import rigid_path
from docking.types import Array, Correction, Plan, Pose
from sim.virtual_time import run_virtual
from tests.reference_geometry import FACE, GUARDED, SETTINGS, crooked_axes, rc1
from tests.support.dry_cell import DryCell, files
from tests.support.planned_moves import lab_site

Triple = tuple[float, float, float]


def asked(shift: Triple, turn_deg: Triple = (0.0, 0.0, 0.0), **other: object) -> PlanRequest:
    correction = Correction(FACE, np.radians(turn_deg), np.array(shift))
    plain = PlanRequest(1, "align", "align", np.zeros(12), correction, 5.0, 0.01, False)
    return replace(plain, **other)  # type: ignore[arg-type]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 100_000))
def test_pln_01_a_move_is_refused_exactly_when_some_point_of_its_path_is_out_of_stroke(seed: int) -> None:
    """Against the strokes at every 0.01 mm of the path; the refusal names an axis that is out, its s and its limit."""
    rng = np.random.default_rng(seed)
    positioners = replace(rc1(crooked_axes(seed)), stroke_mm=np.tile([-30.0, 30.0], (12, 1)))
    request = asked((0, 0, 0), q_now_mm=rng.uniform(-20, 20, 3)[np.arange(12) % 3], correction=Correction(
        rng.uniform(-4000, 4000, 3), np.radians(rng.uniform(-0.4, 0.4, 3)), rng.uniform(-25, 25, 3)
    ))  # fmt: skip
    path = rigid_path(positioners, request.q_now_mm, request.correction)
    s = np.linspace(0.0, 1.0, int(path.travel_mm / 0.01) + 2)
    room = (28.0 - np.abs(path.axes_mm(s))).min(axis=0)
    if abs(room.min()) < 1e-3:
        return
    if room.min() > 0.0:
        plan = make_plan(request, positioners, GUARDED)
        np.testing.assert_allclose([row[1] for row in plan.margins], room + 2.0, atol=2e-3)
        return
    with pytest.raises(StrokeExceeded) as refusal:
        make_plan(request, positioners, GUARDED)
    error = refusal.value
    assert room[positioners.axes.index(error.where)] < 0.0
    assert abs(float(error.value)) > abs(float(error.limit)) == 28.0  # type: ignore[arg-type]
    assert "s = " in error.cause
    assert "fit" in error.cause or "already" in error.cause


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 100_000), st.sampled_from(["lab-can", "lab-modbus"]))
def test_pln_02_set_points_stay_inside_speed_acceleration_jerk_and_the_bound_of_a_jammed_axis(
    seed: int, name: str
) -> None:
    site, queued = lab_site(name), name == "lab-modbus"
    rng = np.random.default_rng(seed)
    correction = Correction(site.pivot_mm, np.radians(rng.uniform(-0.5, 0.5, 3)), rng.uniform(-6, 6, 3))
    request = asked((0, 0, 0), correction=correction, period_s=0.1 if queued else 0.01, linear_interpolation=queued)
    plan, axes = make_plan(request, site.positioners, site.settings), site.positioners
    q = np.vstack([np.tile(plan.q_mm[0], (3, 1)), plan.q_mm, np.tile(plan.q_mm[-1], (3, 1))])
    limits = (axes.v_mm_s, axes.a_mm_s2, axes.j_mm_s3)
    for order, limit in enumerate(limits, start=1):
        emitted = np.abs(np.diff(q, order, axis=0)).max(axis=0) / plan.period_s**order
        assert np.all(emitted <= limit * (1 + 1e-5))
    assert plan.bounds is not None
    assert plan.bounds.jam_n.max() <= 150.0 * (1 + 1e-9)
    peak = np.abs(np.diff(plan.q_mm, axis=0)).max(axis=0) / plan.period_s
    np.testing.assert_allclose(plan.bounds.peak_mm_s, peak, atol=1e-9)


def lab_scene(standoff_mm: float, off: Array, goal_mm: float) -> tuple[Scene, Pose]:
    cell, job = files("lab-can")
    docked, mate = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    here = Pose(docked.R, docked.t_mm + np.array([-standoff_mm, 0.0, 0.0]) + off)
    goal = Pose(docked.R, docked.t_mm - np.array([goal_mm, 0.0, 0.0]))
    return Scene(here, mate, docked, goal_mm, standoff_mm), goal


@pytest.mark.parametrize(("off_mm", "clear"), [(0.1, True), (-0.1, False)])
@pytest.mark.parametrize("side", [1, 2])
def test_pln_03_a_near_miss_of_a_tenth_of_a_millimetre_is_told_from_a_clear_way(
    side: int, off_mm: float, clear: bool
) -> None:
    """A post beside the front edges of the laboratory dummy, 0.7 mm +- 0.1 mm from where they pass."""
    site = lab_site()
    cell, job = files("lab-can")
    edge = max(point[side] for point in job.component.outline_mm[0])
    low, high = np.full(3, -300.0), np.full(3, 300.0)
    low[0], high[0] = -6.0, -5.0
    low[side], high[side] = edge + 0.7 + off_mm, edge + 50.0
    post = np.array([[low, high]])
    guarded = replace(
        site.settings,
        mate=replace(site.settings.mate, boxes_M_mm=np.concatenate([site.settings.mate.boxes_M_mm, post])),
    )
    scene, goal = lab_scene(8.0, np.zeros(3), 3.0)
    face = np.array(job.component.docking_face_mm)
    q = axis_positions(site.positioners, scene.X_WC.apply(site.positioners.balls_C_mm))
    request = asked(
        (0, 0, 0), q_now_mm=q, correction=correction_to(scene.X_WC, goal, face), scene=scene, speed_mm_s=2.0
    )
    if clear:
        make_plan(request, site.positioners, guarded)
        return
    with pytest.raises(MateTooNear, match="box 1") as refusal:
        make_plan(request, site.positioners, guarded)
    assert float(refusal.value.value) == pytest.approx(0.6, abs=0.02)  # type: ignore[arg-type]
    assert cell.limits.clearance_mm - cell.limits.contact_mm == pytest.approx(refusal.value.limit)


def test_pln_04_an_axis_that_moved_since_the_plan_keeps_it_from_starting(tmp_path: Path) -> None:
    """0.06 mm between plan and confirmation: no intent, no set-point that moves."""

    async def story() -> DryCell:
        cell = DryCell("lab-can", 1, tmp_path / "run.jsonl")
        await cell.build()
        confirm = cell.operator.confirm

        async def slow(plan: Plan, shown: dict[str, object]) -> object:
            cell.far.plant.displace("B.Y", 0.06)
            await asyncio.sleep(0.2)
            return await confirm(plan, shown)

        cell.operator.confirm = slow  # type: ignore[method-assign,assignment]
        await cell.dock()
        return cell

    cell = run_virtual(story)
    assert not cell.records("intent")
    assert not cell.plans
    (code, where), *_ = cell.alarms()
    assert code in (6002, 2122), (
        cell.alarms()
    )  # the plan is stale, or the drift was met before the question was answered
    assert "B.Y" in where or "B.Y" in str(cell.records("alarm")[0])


BAD = (float("nan"), float("inf"), float("-inf"))
SCENE = Scene(Pose.identity(), Pose.identity(), Pose.identity(), 3.0, 10.0)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    "where",
    ["q_now_mm", "speed_mm_s", "period_s", "pivot_W_mm", "rotvec_rad", "shift_mm", "X_WC", "X_WM", "X_WG",
     "standoff_mm", "from_standoff_mm"],
)  # fmt: skip
def test_pln_05_no_number_that_is_none_is_planned_with(where: str, bad: float) -> None:
    good = asked((1, 0, 0), scene=SCENE)
    three = np.array([0.0, bad, 0.0])
    if where == "from_standoff_mm" and bad == float("inf"):
        return  # the station before the first one
    changed = {
        "q_now_mm": lambda: replace(good, q_now_mm=np.where(np.arange(12) == 5, bad, 0.0)),
        "speed_mm_s": lambda: replace(good, speed_mm_s=bad),
        "period_s": lambda: replace(good, period_s=bad),
        "standoff_mm": lambda: replace(good, scene=replace(SCENE, standoff_mm=bad)),
        "from_standoff_mm": lambda: replace(good, scene=replace(SCENE, from_standoff_mm=bad)),
    }
    if where.startswith("X_"):
        request = replace(good, scene=replace(SCENE, **{where: Pose(np.eye(3), three)}))
    elif where in changed:
        request = changed[where]()
    else:
        request = replace(good, correction=replace(good.correction, **{where: three}))
    with pytest.raises(PlanInputInvalid):
        make_plan(request, rc1(), GUARDED)


def test_pln_05_nor_with_nothing_or_with_less_than_nothing() -> None:
    for request in (
        asked((1, 0, 0), speed_mm_s=0.0),
        asked((1, 0, 0), speed_mm_s=-1.0),
        asked((1, 0, 0), period_s=0.0),
        asked((1, 0, 0), q_now_mm=np.zeros(0)),
        asked((1, 0, 0), scene=replace(SCENE, standoff_mm=-1.0)),
    ):
        with pytest.raises(DockingError):
            make_plan(request, rc1(), GUARDED)


def straightness_mm(points: Array) -> float:
    """Largest distance of `points` (n, m) from the straight line between the first and the last."""
    way = points[-1] - points[0]
    along = (points - points[0]) @ way / (way @ way)
    return float(np.linalg.norm(points - points[0] - along[:, None] * way, axis=1).max())


def test_pln_06_axes_of_unequal_limits_stay_on_the_straight_line() -> None:
    """One s for all axes: each has its own limits of jerk, acceleration and speed, and none leaves the line."""
    rng = np.random.default_rng(6)
    positioners = replace(
        rc1(exp_so3(np.array([0.1, 0.2, 0.3])) @ np.tile(np.eye(3), (4, 1, 1))),
        stroke_mm=np.tile([-500.0, 500.0], (12, 1)), v_mm_s=rng.uniform(2, 10, 12), a_mm_s2=rng.uniform(5, 50, 12),
        j_mm_s3=rng.uniform(20, 500, 12),
    )  # fmt: skip
    plan = make_plan(asked((90.0, 60.0, -35.0)), positioners, SETTINGS)
    assert straightness_mm(plan.q_mm) <= 1e-9
    off_line = [straightness_mm(plan.q_mm[:, 3 * i : 3 * i + 3]) for i in range(4)]
    assert max(off_line) <= 1e-9


@pytest.mark.peer
def test_pln_06_the_peer_leaves_it_and_says_nothing() -> None:
    ruckig = pytest.importorskip("ruckig")
    generator, wanted, trajectory = ruckig.Ruckig(3), ruckig.InputParameter(3), ruckig.Trajectory(3)
    wanted.synchronization = ruckig.Synchronization.Phase
    wanted.current_position, wanted.target_position = [0.0] * 3, [90.0, 60.0, -35.0]
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [5.0] * 3, [10.0] * 3, [50.0, 20.0, 200.0]
    result = generator.calculate(wanted, trajectory)
    assert result in (ruckig.Result.Working, ruckig.Result.Finished)
    times = np.linspace(0.0, trajectory.duration, 500)
    points = np.array([trajectory.at_time(float(t))[0] for t in times])
    assert straightness_mm(points) > 0.1
