"""Rows CAN-01 to CAN-16: what happens on the bus while a part is moved."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from docking.errors import (
    AxisNotEnabled,
    ConsistencyTrip,
    DeviceRefused,
    DeviceSilent,
    DockingError,
    DriveFault,
    DriveWarning,
    EnableFailed,
    EventRefused,
    FeedbackMissing,
    FollowingErrorTrip,
    InternalForceTrip,
    LinkLost,
    ReadBackMismatch,
    TickLate,
    WrongIdentity,
)
from docking.motion.triggers import Trigger
from sim.canopen.drives import Stage
from sim.canopen.settings import DriveSettings
from sim.virtual_time import run_virtual
from tests.support.fault_rows import Row, T, params, run_row
from tests.support.invariants import HELD_MM, judge
from tests.support.motion_record import ENABLED, QUICK_STOP
from tests.support.ready_cell import ReadyCell, Scene, play

COUPLING = (ConsistencyTrip, InternalForceTrip, FollowingErrorTrip)
SILENCE_S = 0.28
"""1016h of the drives: so long after the last heartbeat they stop by themselves."""


def lost_read_backs(count: float):
    return lambda cell: cell.faults.lose_read_back("B.X", count)


def cut(cell: ReadyCell) -> None:
    cell.bus.cut("the controller went bus-off")


def queue_full(cell: ReadyCell) -> None:
    cell.near.drop("cannot send: no buffer space available")


def deaf(cell: ReadyCell) -> None:
    """The receiving side of the controller dies without a word."""
    cell.near.on_frames = lambda frames: None


ROWS = [
    Row("CAN-01-cut", cut, (LinkLost,), "can0", ("silence",), 2 * T, still_s=SILENCE_S + 0.1),
    Row(
        "CAN-01-without-a-word",
        lambda cell: cell.faults.wire.silence(),
        (FeedbackMissing, LinkLost),
        "",
        ("quick-stop", "silence"),
        4 * T,
        still_s=SILENCE_S + 0.1,
    ),
    # The second read-back in a row is due 15 ms after the fault and is missed by the tick after that.
    Row("CAN-02", lost_read_backs(float("inf")), (FeedbackMissing,), "B.X", ("path", "quick-stop"), 2.5 * T),
    Row("CAN-02-two", lost_read_backs(2), (FeedbackMissing,), "B.X", ("path", "quick-stop"), 2.5 * T),
    Row("CAN-05-warning", lambda c: c.faults.warn("B.X", 0x4210), (DockingError,), "too hot", ("path",), T),
    Row("CAN-05-generic", lambda c: c.faults.warn("D.Z", 0x1000), (DockingError,), "D.Z", ("path",), T, full=True),
    Row(
        "CAN-05-fault",
        lambda c: c.group.trip("B.X", 0x2310),
        (DriveFault,),
        "overcurrent",
        ("quick-stop",),
        2 * T,
        broken="B.X",
    ),
    Row("CAN-06", lambda c: c.faults.lose_heartbeat("B.X"), (DockingError,), "B.X", ("quick-stop",), 0.4 + T),
    Row("CAN-06-mute", lambda c: c.group.mute("C.Y"), (FeedbackMissing,), "C.Y", ("quick-stop",), 4 * T, broken="C.Y"),
    Row("CAN-07", lambda c: c.group.restart("B.X"), (DockingError,), "restarted", ("quick-stop",), T, broken="B.X"),
    Row(
        "CAN-07-loaded",
        lambda c: c.group.restart("B.Z"),
        (DockingError,),
        "restarted",
        ("quick-stop",),
        T,
        broken="B.Z",
        full=True,
    ),
    Row(
        "CAN-09",
        lambda c: c.faults.forge_set_point("B.X", 0.0),
        (DockingError,),
        "another sender",
        ("quick-stop",),
        T,
        broken="B.X",
    ),
    Row("CAN-10", deaf, (FeedbackMissing,), "", ("quick-stop",), 4 * T),
    Row(
        "CAN-13",
        lambda c: c.faults.leave_operational("B.X"),
        (DockingError,),
        "B.X",
        ("quick-stop",),
        4 * T,
        broken="B.X",
    ),
    Row("CAN-16", queue_full, (LinkLost,), "no buffer space", ("silence",), 2 * T, still_s=SILENCE_S + 0.1),
]


@pytest.mark.parametrize("row", params(ROWS))
def test_a_fault_on_the_bus(row):
    run_row(row)


def test_can_02_a_single_missed_read_back_stops_nothing():
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.faults.lose_read_back, "B.X", 1))
    assert judge(cell).reaction == "none"
    assert cell.result.result == "done"


def test_can_03_one_lost_set_point_is_made_up_for():
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.faults.lose_set_points, "B.X", 1))
    outcome = judge(cell)
    assert (cell.result.result, outcome.reaction) == ("done", "none")
    # One cycle at 2.9 mm/s.
    assert 0.003 < outcome.residual_mm <= 0.03


def test_can_03_set_points_that_do_not_arrive_stop_all():
    """The drive stands at its last target and reports no following error: the figure of the others leaves it."""
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.faults.lose_set_points, "B.X"))
    outcome = judge(cell, "B.X")
    assert isinstance(cell.cause, DockingError)
    assert "B.X" in str(cell.cause)
    assert outcome.reaction == "path"
    limit_mm = cell.cell.limits.ball_residual_mm + 0.05
    assert outcome.residual_mm <= limit_mm
    assert outcome.force_n <= 1.5 * cell.cell.limits.internal_force_n


@pytest.mark.parametrize("reaction", ["hold", "extrapolate", "quick-stop", "fault"])
def test_can_01_drives_that_hear_nothing_stop_by_their_own_watchdog(reaction):
    """Whatever a drive does when SYNC stops: 1016h brings it to rest, straight, as 6085h was written for this plan."""
    scene = Scene(drives=DriveSettings(sync_loss=reaction))
    cell = play(scene, lambda cell: cell.during(0.5, cut, cell))
    t_s, motor = cell.record.motors(cell.start_s)
    last_beat_s = max(beat for beat in cell.record.beats_s if beat <= cell.fault_s)
    moving = np.abs(np.diff(motor, axis=0)).max(axis=1) > 2e-4
    rest_s = t_s[1:][moving].max()
    assert rest_s - last_beat_s <= 0.3 + 0.1
    gap = cell.record.figure_gap_mm(motor, motor[0]).max()
    print(reaction, "rest after the last heartbeat", rest_s - last_beat_s, "residual", gap)
    assert gap <= 0.02
    assert isinstance(cell.cause, LinkLost)


def late_ticks(cell: ReadyCell, late_s, times: int) -> None:
    """The next ticks of the controller come late."""
    motion, left = cell.motion, [times]

    def late() -> None:
        if left[0] > 0:
            left[0] -= 1
            motion._timer = cell.loop.call_later(late_s(), type(motion)._tick, motion)
        else:
            del motion._tick
            motion._tick()

    motion._tick = late


@pytest.mark.parametrize("jitter_s", [0.0001, 0.001, 0.004])
def test_can_04_jitter_inside_half_a_cycle_stops_nothing(jitter_s):
    rng = np.random.default_rng(4)

    def begin(cell: ReadyCell) -> None:
        late_ticks(cell, lambda: float(rng.uniform(0.0, jitter_s)), 50)

    cell = play(Scene(), lambda cell: cell.during(0.2, begin, cell))
    assert cell.result.result == "done"
    _, motor = cell.record.motors(cell.start_s)
    assert cell.record.figure_gap_mm(motor, motor[0]).max() <= 0.002


@pytest.mark.parametrize("late_s", [0.025, 0.05])
def test_can_04_a_tick_that_comes_too_late_stops_on_the_path(late_s):
    cell = play(Scene(), lambda cell: cell.during(0.5, late_ticks, cell, lambda: late_s, 1))
    # The drives notice the missing SYNC at the same time and say so.
    assert isinstance(cell.cause, TickLate | AxisNotEnabled | DriveFault | DriveWarning)
    assert cell.result.result == "fault"
    _, motor = cell.record.motors(cell.start_s)
    assert cell.record.figure_gap_mm(motor, motor[0]).max() <= 0.02


def test_can_04_sync_that_stays_away_from_the_drives_stops_all():
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.faults.lose_sync))
    outcome = judge(cell)
    assert outcome.reaction in ("path", "quick-stop")
    assert outcome.reacted_s <= 4 * T
    assert outcome.residual_mm <= 0.02


def test_can_04_one_drive_that_misses_its_sync_takes_the_others_along():
    row = Row(
        "CAN-04-alone",
        lambda cell: cell.faults.stop_alone("B.X"),
        (DockingError,),
        "B.X",
        ("quick-stop",),
        2 * T,
        broken="B.X",
    )
    _, outcome = run_row(row)
    assert outcome.residual_mm <= 0.1


# before anything moves -------------------------------------------------------------------------------------------
async def bring_up_and_enable(cell: ReadyCell) -> None:
    await cell.motion.connect()
    await cell.motion.enable()


def refused(scene: Scene, before) -> tuple[ReadyCell, DockingError]:
    """The error that refuses to bring up or to enable a cell after `before(cell)`, and that nothing moved by then."""

    async def main() -> tuple[ReadyCell, DockingError]:
        cell = ReadyCell(scene)
        await cell.open()
        before(cell)
        with pytest.raises(DockingError) as caught:
            await bring_up_and_enable(cell)
        cell.start_s = 0.0
        await cell.close()
        return cell, caught.value

    cell, error = run_virtual(main)
    moved = [np.abs(tick.motor_mm - cell.recorded.ticks[0].motor_mm).max() for tick in cell.recorded.ticks]
    assert max(moved, default=0.0) <= HELD_MM
    assert not any(tick.powered.any() and not tick.braked.all() for tick in cell.recorded.ticks[-3:])
    assert not (cell.record.sent().word[-1:] == ENABLED).any()
    return cell, error


def test_can_06_a_node_that_never_sent_a_heartbeat_is_not_enabled():
    _, error = refused(Scene(), lambda cell: cell.faults.lose_heartbeat("B.Y"))
    assert isinstance(error, DeviceSilent)
    assert "B.Y" in str(error)


def test_can_08_two_drives_in_each_others_place_are_not_enabled():
    _, error = refused(Scene(), lambda cell: cell.faults.swap("A.X", "B.X"))
    assert isinstance(error, WrongIdentity)
    assert "A.X" in str(error)
    assert "1018h:04 serial" in str(error)


@pytest.mark.parametrize(
    ("sub", "name", "value"), [(1, "vendor", 0x5D1), (2, "product", 0x0402_0009), (3, "revision", 0x0001_0004)]
)
def test_can_08_a_drive_of_another_kind_is_not_enabled(sub, name, value):
    _, error = refused(Scene(), lambda cell: cell.faults.lie("D.Y", 0x1018, value, sub))
    assert isinstance(error, WrongIdentity)
    assert "D.Y" in str(error)
    assert f"1018h:{sub:02d} {name}" in str(error)


def test_can_08_two_devices_with_one_number_are_not_enabled():
    _, error = refused(Scene(), lambda cell: cell.faults.twin("C.Z"))
    assert isinstance(error, WrongIdentity)
    assert "C.Z" in str(error)


PROTECTING = [(0x1016, 1), (0x605A, 0), (0x6085, 0), (0x605E, 0), (0x6007, 0), (0x607D, 1), (0x6065, 0), (0x60C2, 1)]


@pytest.mark.parametrize(
    ("answer", "obj", "sub"),
    [
        pytest.param(
            answer, *address, id=f"{answer}-{address[0]:X}", marks=[pytest.mark.full] if (number + k) % 4 else []
        )
        for number, address in enumerate(PROTECTING)
        for k, answer in enumerate(("refuse_write", "ignore_write"))
        # 605Eh leaves the factory as it is wanted.
        if (answer, address[0]) != ("ignore_write", 0x605E)
    ],
)
def test_a_drive_that_does_not_take_what_protects_the_part_is_not_enabled(answer, obj, sub):
    _, error = refused(Scene(), lambda cell: getattr(cell.faults, answer)("D.Y", obj, sub))
    assert isinstance(error, DeviceRefused if answer == "refuse_write" else ReadBackMismatch)
    assert "D.Y" in str(error)
    assert f"{obj:04X}" in str(error)


def test_can_11_the_first_set_points_are_where_the_axes_stand():
    cell = play(Scene(), lambda cell: None)
    sent = cell.record.sent()
    first = int(np.argmax((sent.word == ENABLED).any(axis=1)))
    t_s, motor = cell.record.motors()
    standing = motor[np.searchsorted(t_s, sent.t_s[first]) - 1]
    assert np.abs(sent.target_mm[first] - standing).max() <= 0.01


def test_can_11_an_axis_that_is_not_where_its_first_set_point_is_keeps_all_off():
    def jump_when_switched_on(cell: ReadyCell) -> None:
        enter = cell.group.drives._enter

        def hook(index, stage, t_s, **rest) -> None:
            enter(index, stage, t_s, **rest)
            if index == 4 and stage is Stage.OPERATION:
                cell.faults.misread("B.Y", offset_mm=0.3)

        cell.group.drives._enter = hook

    _, error = refused(Scene(), jump_when_switched_on)
    assert isinstance(error, EnableFailed | ReadBackMismatch)
    assert "B.Y" in str(error)


def test_can_12_a_stop_is_not_overwritten_by_the_next_cycles():
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.group.trip, "B.X", 0x2310))
    sent = cell.record.sent()
    told = int(np.argmax((sent.word == QUICK_STOP).all(axis=1)))
    after = sent.word[told : told + 90]
    assert len(after) == 90
    assert (after != ENABLED).all()
    assert not ((after[:-1] != QUICK_STOP) & (after[1:] == QUICK_STOP)).any()


def test_can_07_a_warning_does_not_hide_the_restart_of_another_drive():
    def fault(cell: ReadyCell) -> None:
        cell.faults.warn("D.Z", 0x4210)
        cell.loop.call_later(0.5 * T, cell.group.restart, "B.X")

    cell, _ = run_row(
        Row("CAN-07-after-05", fault, (DriveWarning, DriveFault), "", ("quick-stop",), 2.5 * T, broken="B.X")
    )
    arbiter = cell.motion.arbiter
    assert Trigger.NODE_RESTARTED in {found.trigger for found in (arbiter.first, *arbiter.later)}
    assert arbiter.unreferenced == ("B.X",)


def test_can_05_an_emergency_whose_fault_shows_later_ends_as_that_fault():
    """The drive complains, is seen to go on, and is in fault a cycle later: the fault is what stopped the part."""

    def fault(cell: ReadyCell) -> None:
        cell.faults.warn("B.X", 0x2310)
        cell.loop.call_later(2.0 * T, cell.group.trip, "B.X", 0x2310)

    row = Row("CAN-05-late", fault, (DriveFault,), "overcurrent", ("quick-stop",), 4 * T, broken="B.X")
    cell, _ = run_row(row)
    arbiter = cell.motion.arbiter
    assert (arbiter.first.trigger, arbiter.later[0].trigger) == (Trigger.DRIVE_FAULT, Trigger.DRIVE_WARNING)


def test_can_04_a_drive_that_lost_its_sync_says_so():
    cell = play(Scene(), lambda cell: cell.during(0.5, cell.faults.stop_alone, "B.X"))
    assert "SYNC lost" in str(cell.cause)
    assert "B.X" in str(cell.cause)


def test_can_14_and_15_a_reset_is_one_held_edge_on_the_drive_in_fault_and_moves_nothing():
    """Three SYNCs without the bit, three with it, three without; every other controlword stays as it was."""
    order: list[float] = []

    async def story(cell: ReadyCell) -> None:
        cell.during(0.5, cell.group.trip, "B.X", 0x2310)
        await cell.move()
        standing = cell.recorded.ticks[-1].motor_mm.copy()
        order.append(cell.loop.time())
        with pytest.raises(EventRefused, match="supervisor"):
            await cell.motion.reset("operator")
        order.append(cell.loop.time())
        await cell.motion.reset("supervisor")
        order.append(cell.loop.time())
        with pytest.raises(DockingError):
            await cell.motion.start(cell.plan.plan_hash)
        await asyncio.sleep(0.5)
        assert np.abs(cell.recorded.ticks[-1].motor_mm - standing).max() <= HELD_MM
        await cell.motion.enable()
        assert cell.motion.feedback() is not None

    cell = play(Scene(), story)
    sent, k = cell.record.sent(), cell.index("B.X")
    assert not (sent.word[sent.t_s <= order[1]] & 0x80).any(), "nobody may reset who is not asked to"
    rows = (sent.t_s > order[1]) & (sent.t_s <= order[2])
    word = sent.word[rows]
    bit = (word[:, k] & 0x80) != 0
    edges = np.flatnonzero(np.diff(bit.astype(int)))
    assert len(edges) == 2, "one edge up, one down"
    assert edges[0] + 1 >= 3
    assert edges[1] - edges[0] >= 3
    assert (word[~bit, k] == 0).all()
    others = np.delete(word, k, axis=1)
    assert (others == others[0]).all()
    assert not (others & 0x80).any()


def test_can_15_a_fault_is_reset_by_order_only():
    async def story(cell: ReadyCell) -> None:
        cell.during(0.5, cell.group.trip, "B.X", 0x2310)
        await cell.move()
        assert not (cell.record.sent().word & 0x80).any()
        with pytest.raises(DockingError):
            await cell.motion.enable()
        assert not (cell.record.sent().word & 0x80).any()
        with pytest.raises(DockingError):
            await cell.motion.start(cell.plan.plan_hash)
        assert cell.group.drives.stages[cell.index("B.X")] is Stage.FAULT

    cell = play(Scene(), story)
    assert isinstance(cell.cause, DriveFault)
