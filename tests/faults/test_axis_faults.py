"""Rows AX-01 to AX-07, AX-09, AX-10: what happens to an axis, a brake or a load cell."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from docking.errors import (
    AxisAtLimit,
    AxisDrift,
    AxisNotEnabled,
    AxisStuck,
    BallForceTrip,
    BallUnloaded,
    ConsistencyTrip,
    DockingError,
    DriveFault,
    EnableFailed,
    EncoderJump,
    FollowingErrorTrip,
    InternalForceTrip,
    LoadCellSilent,
    MeasuredForceTrip,
    MeasuredWarpTrip,
    WarpTrip,
)
from sim.canopen.drives import Stage
from tests.support.fault_rows import Row, T, params, run_row
from tests.support.invariants import judge
from tests.support.motion_record import QUICK_STOP
from tests.support.planned_moves import a_shift, lab_site
from tests.support.ready_cell import ReadyCell, Scene, play

COUPLING = (ConsistencyTrip, InternalForceTrip, WarpTrip)
FORCE_FRAME_S = 0.1
"""The load cells report every tenth SYNC."""


def slow(cell: ReadyCell, share: float, *axes: str) -> None:
    """These axes (none named: all) reach only so much of the speed that they have at this instant."""
    t_s, motor = cell.record.motors(cell.loop.time() - 0.05)
    speed = np.abs(motor[-1] - motor[-2]) / (t_s[-1] - t_s[-2])
    for axis in axes or cell.cell.axis_names:
        cell.plant.weaken(axis, max(share * float(speed[cell.index(axis)]), 1e-3), 20.0)


def crossing_s(cell: ReadyCell, axis: str) -> float:
    """When the axis' following error passed its limit: at rest the low one, at full speed the high one."""
    limits, k = cell.cell.limits, cell.index(axis)
    ticks = [tick for tick in cell.recorded.ticks if tick.t_s > cell.start_s]
    t_s = np.array([tick.t_s for tick in ticks])
    target, motor = (np.array([getattr(tick, name)[k] for tick in ticks]) for name in ("target_mm", "motor_mm"))
    speed = np.abs(np.gradient(target, t_s))
    slope = (limits.following_error_vmax_mm - limits.following_error_rest_mm) / cell.positioners.v_mm_s[k]
    over = np.abs(target - motor) > limits.following_error_rest_mm + slope * speed
    return float(t_s[np.argmax(over)]) if over.any() else float("nan")


def test_ax_01_axes_that_lag_together_stop_on_the_path():
    """No figure is strained: only the following error tells."""
    cell = play(Scene(), lambda cell: cell.during(0.4, slow, cell, 0.7))
    outcome = judge(cell)
    assert isinstance(cell.cause, FollowingErrorTrip), cell.cause
    assert outcome.reaction == "path"
    worst = min((crossing_s(cell, axis) for axis in cell.cell.axis_names), key=lambda t: (np.isnan(t), t))
    assert cell.fault_s + outcome.reacted_s - worst <= 2 * T + 3 * T
    assert outcome.residual_mm <= cell.cell.limits.ball_residual_mm


@pytest.mark.parametrize("axis", ["A.X", "C.Y", "B.Z"])
def test_ax_02_an_axis_that_lags_inside_its_own_limit_is_seen_by_the_figure(axis):
    def lead(cell: ReadyCell) -> None:
        """Straight along the axis: askew, the vertical axes bound the speed so far that load cells are the first."""
        shift = 6.0 * np.eye(3)["XYZ".index(axis[-1])]
        cell.plan_from = lambda standing: a_shift(lab_site("lab-can"), shift, 4.0, standing)  # type: ignore[method-assign]

    cell = play(Scene(before=lead), lambda cell: cell.during(0.3, slow, cell, 0.8, axis))
    outcome = judge(cell, axis)
    print(axis, cell.cause, outcome)
    assert isinstance(cell.cause, COUPLING), cell.cause
    assert axis in str(cell.cause)
    assert outcome.reaction == "path"
    limits = cell.cell.limits
    assert outcome.residual_mm <= limits.ball_residual_mm + 0.02
    assert outcome.force_n <= 1.25 * limits.internal_force_n


def jammed(axis: str, share: float, full: bool = False) -> Row:
    return Row(
        f"AX-03-{axis}-{share}",
        lambda cell: cell.plant.jam(axis),
        (AxisStuck,),
        axis,
        ("path",),
        5 * T,
        broken=axis,
        share=share,
        still_s=0.15,
        full=full,
    )


def at_a_switch(stops: bool, share: float, full: bool = False) -> Row:
    return Row(
        f"AX-05-{'stops-' if stops else ''}{share}",
        lambda cell: cell.faults.limit_switch("B.X", stops=stops),
        (AxisAtLimit, AxisNotEnabled) if stops else (AxisAtLimit,),
        "B.X",
        ("quick-stop",) if stops else ("path",),
        2 * T,
        broken="B.X" if stops else None,
        share=share,
        full=full,
    )


def jump(name: str, offset_mm: float, sign: float = 1.0, full: bool = False) -> Row:
    return Row(
        f"AX-06-{name}",
        lambda cell: cell.faults.misread("B.X", offset_mm, sign),
        (EncoderJump,),
        "B.X",
        ("quick-stop",),
        2 * T,
        full=full,
    )


def force(name: str, offset_n: float, errors: tuple[type[DockingError], ...], full: bool = False) -> Row:
    return Row(
        f"AX-07-{name}",
        lambda cell: cell.plant.misread_force("A.Z", offset_n),
        errors,
        "A" if len(errors) == 1 else "",
        ("path",),
        2 * FORCE_FRAME_S + 2 * T,
        still_s=0.15,
        full=full,
    )


MEASURED = (BallForceTrip, MeasuredForceTrip, MeasuredWarpTrip)
"""A load cell that reads too much shows as overload of its ball or as strain of the part."""

ROWS = [
    jammed("A.X", 0.5),
    jammed("C.Y", 0.3),
    jammed("B.Z", 0.7),
    jammed("D.X", 0.2, full=True),
    at_a_switch(False, 0.1),
    at_a_switch(False, 0.5),
    at_a_switch(False, 0.9, full=True),
    at_a_switch(True, 0.5),
    jump("plus-1", 1.0),
    jump("minus-1", -1.0),
    jump("one-turn", 10.0),
    jump("sign", 0.0, -1.0),
    force("railed", 1e9, (BallForceTrip,)),
    force("nan", float("nan"), (*MEASURED, LoadCellSilent)),
    force("overload", 450.0, MEASURED),
    force("lost-contact", -140.0, (*MEASURED, BallUnloaded)),
]


@pytest.mark.parametrize("row", params(ROWS))
def test_a_fault_of_an_axis(row):
    run_row(row)


def test_ax_07_a_single_spike_of_a_load_cell_stops_nothing():
    def spike(cell: ReadyCell) -> None:
        cell.plant.misread_force("A.Z", 600.0)
        cell.loop.call_later(FORCE_FRAME_S, cell.plant.misread_force, "A.Z", 0.0)

    cell = play(Scene(), lambda cell: cell.during(0.5, spike, cell))
    assert judge(cell).reaction == "none"
    assert cell.result.result == "done"


def test_ax_07_a_load_cell_that_falls_silent_stops_all():
    row = Row(
        "AX-07-silent",
        lambda cell: cell.faults.lose_forces("A.Z"),
        (DockingError,),
        "A",
        ("path",),
        3 * FORCE_FRAME_S + 0.1 + 2 * T,
        share=0.3,
    )
    run_row(row)


# at rest -----------------------------------------------------------------------------------------------------------
async def watch_at_rest(cell: ReadyCell, seconds: float) -> None:
    """Stand enabled for a while, as if it were a move that never starts."""
    cell.start_s = cell.fault_s = cell.loop.time()
    await asyncio.sleep(seconds)
    cell.ended_s = cell.loop.time()


def fault_at_rest(cell: ReadyCell) -> DockingError:
    """What the motion side holds against the cell."""
    with pytest.raises(DockingError) as caught:
        cell.motion.feedback()
    return caught.value


@pytest.mark.parametrize(("axis", "speed_mm_s"), [("A.Z", -0.5), ("C.Y", 0.05)])
def test_ax_04_an_axis_that_drifts_at_rest_is_braked(axis, speed_mm_s):
    seen: list[tuple[DockingError, float, float]] = []

    async def story(cell: ReadyCell) -> None:
        k = cell.index(axis)
        await asyncio.sleep(0.3)
        cell.plant.creep(axis, speed_mm_s)
        begun_s, start_mm = cell.loop.time(), cell.recorded.ticks[-1].motor_mm[k]
        await watch_at_rest(cell, 0.02 / abs(speed_mm_s) + 10 * T)
        sent = cell.record.sent()
        told_s = float(sent.t_s[np.argmax((sent.t_s > begun_s) & (sent.word == QUICK_STOP).any(axis=1))])
        travel_mm = abs(speed_mm_s) * (told_s - begun_s)
        seen.append((fault_at_rest(cell), told_s - begun_s, travel_mm))
        await asyncio.sleep(0.5)
        assert abs(cell.recorded.ticks[-1].motor_mm[k] - start_mm) > 0.02
        assert cell.group.drives.braked.all()
        assert not cell.group.drives.powered.any()

    play(Scene(), story)
    error, told_s, travel_mm = seen[0]
    print(error, told_s, travel_mm)
    assert isinstance(error, AxisDrift)
    assert axis in str(error)
    assert 0.018 <= travel_mm <= 0.02 + abs(speed_mm_s) * 3 * T + 0.002


def test_ax_09_a_brake_that_does_not_open_keeps_all_off():
    async def story(cell: ReadyCell) -> None:
        cell.start_s = cell.loop.time()
        with pytest.raises(EnableFailed, match=r"B\.Z"):
            await cell.motion.enable()
        assert cell.group.drives.braked.all()
        assert not cell.group.drives.powered.any()

    def before(cell: ReadyCell) -> None:
        cell.faults.seize_brake("B.Z", closed=True)

    play(Scene(before=before, enabled=False), story)


@pytest.mark.parametrize("axis", ["B.Z", "C.Z"])
def test_ax_09_a_brake_that_slips_after_a_stop_is_named(axis):
    """The drive that tripped stands braked and without torque; its load pulls it through the brake."""

    async def story(cell: ReadyCell) -> None:
        cell.during(0.5, cell.group.trip, axis, 0x2310)
        await cell.move()
        assert isinstance(cell.cause, DriveFault)
        assert cell.group.drives.stages[cell.index(axis)] is Stage.FAULT
        cell.plant.creep(axis, -0.2)
        await asyncio.sleep(0.3)
        with pytest.raises(DockingError):
            await cell.motion.enable()

    play(Scene(), story)


# held ----------------------------------------------------------------------------------------------------------------
async def hold_then(cell: ReadyCell, change, *args) -> None:
    """Hold in the middle of the move, change something, ask to resume."""
    cell.write("intent", {"plan_hash": cell.plan.plan_hash})
    cell.start_s = cell.loop.time()
    cell.fault_s = cell.start_s + 0.4 * cell.plan.duration_s
    moving = asyncio.get_running_loop().create_task(cell.motion.start(cell.plan.plan_hash))
    await asyncio.sleep(0.4 * cell.plan.duration_s)
    cell.motion.request("hold")
    await asyncio.sleep(1.5 / cell.plan.rate_slew_per_s + 0.3)
    change(*args)
    await asyncio.sleep(0.5)
    cell.held_mm = cell.recorded.ticks[-1].motor_mm.copy()
    cell.motion.request("resume")
    cell.result = await moving
    cell.ended_s = cell.loop.time()
    await asyncio.sleep(1.0)


@pytest.mark.parametrize("what", ["position", "load"])
def test_ax_10_what_changed_while_it_was_held_is_not_resumed(what):
    async def story(cell: ReadyCell) -> None:
        if what == "position":
            await hold_then(cell, cell.plant.creep, "C.Y", 0.1)
        else:
            await hold_then(cell, cell.plant.misread_force, "A.X", 70.0)

    cell = play(Scene(), story)
    assert cell.result.result == "fault"
    if what == "position":
        # AX-04: it is told as what it is, after 0.02 mm, and braked.
        assert isinstance(cell.cause, AxisDrift), cell.cause
        assert 0.02 < abs(float(cell.cause.value)) <= 0.02 + 0.1 * 2 * T
        assert cell.result.stop.found_s - cell.fault_s <= 0.02 / 0.1 + 1.0
        assert cell.group.drives.braked.all()
    else:
        assert isinstance(cell.cause, MeasuredForceTrip), cell.cause
        assert "measure again" in str(cell.cause)
    assert cell.result.path_time_s < 0.6 * cell.plan.duration_s
    healthy = np.array([axis != "C.Y" for axis in cell.cell.axis_names])
    assert np.abs(cell.recorded.ticks[-1].motor_mm - cell.held_mm)[healthy].max() <= 0.003
