"""Rows MB-01 to MB-08: the wires between the controller and the PLCs of a Modbus cell, and the PLCs' own watch.

Every case is a move of a ready cell in virtual time. Stops are asserted on the motors: at rest in time, rigid within
what chords and clocks may part, braked, and no command that starts motion sent twice.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from docking.errors import (
    AxisStuck,
    BadReply,
    DeviceRefused,
    DeviceSilent,
    DockingError,
    DriveFault,
    FeedbackMissing,
    LinkLost,
    ReadBackMismatch,
    WrongIdentity,
)
from docking.kinematics import internal_force_matrix, socket_positions
from docking.kinematics.forces import consistency_projector
from docking.motion.triggers import Trigger
from sim.plc import registers as reg
from tests.support.ready_modbus import ModbusScene, ReadyModbus, peak_mm_s, play_modbus

POLL_S, TIMEOUT_S, SCAN_S = 0.05, 0.05, 0.01
MISSING_CYCLES = 2
TOLD_S = 3.0 * SCAN_S
"""A command takes a scan to be obeyed; the motors follow a little later."""
LAB, FUSELAGE = ModbusScene(), ModbusScene("fuselage-modbus", shift_mm=12.0, speed_mm_s=5.0)


# what happens on the wire ------------------------------------------------------------------------------------------
def once(act: Any) -> Callable[[ReadyModbus], None]:
    """Do this to the next exchange with positioner B."""

    def fault(cell: ReadyModbus) -> None:
        def tamper(frame: bytes) -> Any:
            cell.tamper = lambda later: None
            return act

        cell.tamper = tamper

    return fault


def always(act: Any) -> Callable[[ReadyModbus], None]:
    """Do this to every exchange with positioner B from now on."""
    return lambda cell: setattr(cell, "tamper", lambda frame: act)


def exception(code: int) -> Callable[[bytes], bytes]:
    return lambda reply: reply[:4] + struct.pack(">HBBB", 3, reply[6], reply[7] | 0x80, code)


def cut(reply: bytes) -> bytes:
    return reply[: len(reply) // 2]


def late_by_one(cell: ReadyModbus) -> None:
    """Every reply comes behind the one of the request before."""
    kept = [b""]

    def behind(reply: bytes) -> bytes:
        before, kept[0] = kept[0], reply
        return before + reply

    cell.tamper = lambda frame: behind


def reset(cell: ReadyModbus) -> None:
    cell.group.drop_connections("B")


def reset_all(cell: ReadyModbus) -> None:
    for positioner in cell.cell.positioners:
        cell.group.drop_connections(positioner.name)


def freeze(cell: ReadyModbus) -> None:
    """The registers of B stand still, though it answers and its axes go on."""
    status = cell.victim._status()
    cell.victim._status = lambda: status  # type: ignore[method-assign]


def hang(cell: ReadyModbus) -> None:
    """B takes no heartbeat in, though it scans and answers."""
    cell.victim._beat = lambda count: None  # type: ignore[method-assign]


def other_unit(cell: ReadyModbus) -> None:
    """Behind B's address stands another PLC from now on."""
    other = cell.group.plcs[2]
    cell.victim._status = lambda: other._status()  # type: ignore[method-assign]


def press_limit(cell: ReadyModbus) -> None:
    cell.group.press_limit("B.Z")


def fail_drive(cell: ReadyModbus) -> None:
    cell.group.fail_drive("C.X")


@dataclass(frozen=True)
class Row:
    """`fault` at 0.5 of the move; it ends `done` where `error` is None, else with that cause, which names `where`.

    `told_s`: when the last controller has been told at the latest; its quick ramp and two scans come on top.
    """

    fault: Callable[[ReadyModbus], Any]
    error: type[DockingError] | None
    where: str
    told_s: float
    trigger: Trigger | None = None
    slow: bool = False


SILENT_S = POLL_S + 2.0 * TIMEOUT_S + TOLD_S
ROWS = {
    "MB-01 reply lost once": Row(once("reply"), None, "", 0.0),
    "MB-01 request lost once": Row(once("request"), None, "", 0.0),
    "MB-01 replies lost": Row(always("reply"), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING),
    "MB-01 requests lost": Row(
        always("request"), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING, slow=True
    ),
    "MB-02 busy once": Row(once(exception(6)), None, "", 0.0),
    "MB-02 busy": Row(always(exception(6)), DeviceRefused, "positioner B", 2.0 * POLL_S + TOLD_S, Trigger.DRIVE_FAULT),
    "MB-02 device failure": Row(
        once(exception(4)), DeviceRefused, "positioner B", POLL_S + TOLD_S, Trigger.DRIVE_FAULT
    ),
    "MB-03 connection reset": Row(reset, LinkLost, "positioner B", 0.005 + TOLD_S, Trigger.HEARTBEAT_LOST),
    "MB-03 all reset": Row(reset_all, LinkLost, "positioner", 0.12 + TOLD_S, Trigger.HEARTBEAT_LOST, slow=True),
    "MB-04 reply cut short": Row(once(cut), None, "", 0.0),
    "MB-04 replies cut short": Row(always(cut), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING),
    "MB-05 late replies": Row(late_by_one, None, "", 0.0),
    "MB-05 registers frozen": Row(
        freeze, FeedbackMissing, "B.X", (MISSING_CYCLES + 1.0) * POLL_S + TOLD_S, Trigger.FEEDBACK_MISSING
    ),
    "MB-05 heartbeat not taken": Row(hang, DriveFault, "B.X", 0.12 + TOLD_S, Trigger.HEARTBEAT_LOST, slow=True),
    "MB-06 other unit": Row(other_unit, WrongIdentity, "positioner B", POLL_S + TOLD_S, Trigger.DRIVE_FAULT),
    "AX-05 limit switch": Row(press_limit, DriveFault, "B.Z", TOLD_S, Trigger.LIMIT_SWITCH),
}
"""Positioner B is the victim. `slow`: its own watchdog stops it, along the ordinary ramp; it takes the others along.
Frozen registers go on as if all were well, but for the number of the scan.
"""


def run_row(scene: ModbusScene, row: Row, monkeypatch: pytest.MonkeyPatch, share: float = 0.5) -> ReadyModbus:
    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(share, row.fault)

    cell = play_modbus(scene, story, monkeypatch)
    cell.assert_no_second_start()
    assert cell.residual_mm() <= cell.stated_mm(), (cell.residual_mm(), cell.stated_mm())
    cell.assert_at_rest_and_braked()
    return cell


@pytest.mark.parametrize("name", ROWS)
def test_a_row_on_the_lab_cell(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_row(LAB, name, monkeypatch)


@pytest.mark.parametrize("name", ["MB-01 replies lost", "MB-03 connection reset", "AX-05 limit switch"])
def test_a_row_on_the_fuselage_cell(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_row(FUSELAGE, name, monkeypatch)


def assert_row(scene: ModbusScene, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]
    cell = run_row(scene, row, monkeypatch)
    result = cell.result
    assert result is not None, cell.refused
    if row.error is None:
        assert (result.result, result.cause) == ("done", None)
        last = cell.record.motors()[1][-1]
        assert np.abs(last - cell.plan.q_mm[-1]).max() <= 0.002
        return
    assert result.result == "fault"
    assert isinstance(result.cause, row.error), repr(result.cause)
    assert row.where in str(result.cause)
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is row.trigger
    ramp_s = cell.cell.bus.ramp_s if row.slow else cell.motion._bus.quick_ramp_s  # type: ignore[union-attr]
    bound_s = row.told_s + ramp_s + 2.0 * SCAN_S
    stood_s = cell.stood_s()
    print(f"{scene.name} {name}: at rest {stood_s:.3f} s after it, {bound_s:.3f} s stated; residual "
          f"{cell.residual_mm():.4f} of {cell.stated_mm():.4f} mm; {result.cause}")  # fmt: skip
    assert stood_s <= bound_s
    if row.fault is reset_all:
        return
    # Where the motors stand is where the result says that they stand.
    motor = cell.record.motors()[1][-1]
    assert np.abs(motor - result.commanded_mm).max() <= cell.stated_mm() + 0.01


def test_mb_04_replies_in_pieces_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sliced at every byte, each piece in a segment of its own."""

    class Sliced:
        def __init__(self) -> None:
            self.count = 0

    seen = Sliced()

    def fault(cell: ReadyModbus) -> None:
        connection = next(c for c in cell.group._connections if c.serves(cell.victim))
        write = connection._transport.write

        def sliced(data: bytes) -> None:
            seen.count += 1
            at = seen.count % len(data)
            write(data[:at])
            cell.loop.call_later(0.004, write, data[at:])

        connection._transport.write = sliced  # type: ignore[method-assign]

    cell = run_row(LAB, Row(fault, None, "", 0.0), monkeypatch)
    assert cell.result is not None
    assert cell.result.result == "done"
    assert seen.count > 40


# before anything moves ----------------------------------------------------------------------------------------------
def swap_hosts(cell: ReadyModbus) -> None:
    plcs = cell.group.plcs
    plcs[0]._identity, plcs[1]._identity = plcs[1]._identity, plcs[0]._identity


def swap_words(cell: ReadyModbus) -> None:
    identity = cell.victim._identity
    cell.victim._identity = identity[2:4] + identity[:2] + identity[4:]


def little_positions(cell: ReadyModbus) -> None:
    """Only the strokes have their words swapped."""
    words = struct.unpack(">18H", cell.victim._limits)
    cell.victim._limits = struct.pack(">18H", *(words[i ^ 1] for i in range(18)))


def no_watchdog(cell: ReadyModbus) -> None:
    take = cell.victim._set

    def without(settings: Any) -> None:
        settings.watchdog_ms = 0
        take(settings)

    cell.victim._set = without  # type: ignore[method-assign]


def five_seconds(cell: ReadyModbus) -> None:
    take = cell.victim._set

    def longer(settings: Any) -> None:
        settings.watchdog_ms = 5000
        take(settings)

    cell.victim._set = longer  # type: ignore[method-assign]


NOGO = {
    "MB-06 swapped hosts": (swap_hosts, WrongIdentity, "positioner A"),
    "MB-07 word order": (swap_words, BadReply, "positioner B"),
    "MB-07 words of positions": (little_positions, ReadBackMismatch, "positioner B, stroke of X"),
    "MB-08 watchdog off": (no_watchdog, ReadBackMismatch, "positioner B, watchdog_ms"),
    "MB-08 watchdog of 5 s": (five_seconds, ReadBackMismatch, "positioner B, watchdog_ms"),
}


@pytest.mark.parametrize("name", NOGO)
def test_nothing_is_powered_on_what_is_not_proved(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, error, where = NOGO[name]

    async def story(cell: ReadyModbus) -> None:
        change(cell)
        with pytest.raises(error) as refused:
            await cell.bring_up()
        assert where in str(refused.value)
        await asyncio.sleep(0.5)
        assert not any(tick.powered.any() for tick in cell.recorded.ticks)
        assert not cell.commands

    play_modbus(LAB, story, monkeypatch)


@pytest.mark.parametrize("scene", [LAB, FUSELAGE], ids=lambda scene: scene.name)
def test_mb_08_a_silent_host_is_noticed_by_every_plc(scene: ModbusScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The host dies as a process does: sockets stay open, nothing is said any more."""

    def die(cell: ReadyModbus) -> None:
        assert cell.motion._keeper is not None
        cell.motion._keeper.cancel()

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        begun = cell.loop.create_task(cell.move(0.5, die))
        await asyncio.sleep(0.5 * cell.plan.duration_s + 3.0)
        begun.cancel()
        await asyncio.gather(begun, return_exceptions=True)
        cell.watched_until_s = cell.loop.time()

    cell = play_modbus(scene, story, monkeypatch)
    t_s, target = cell.record.set_points(cell.fault_s)
    steps = np.abs(np.diff(target, axis=0)).max(axis=1) / np.diff(t_s)
    slowed_s = t_s[1:][steps < 0.97 * steps[0]][0] - cell.fault_s
    assert slowed_s <= 0.15
    assert cell.stood_s() <= 0.12 + cell.cell.bus.ramp_s + TOLD_S  # type: ignore[union-attr]
    assert cell.residual_mm() <= cell.stated_mm()
    assert {plc.fault for plc in cell.group.plcs} <= {reg.Fault.WATCHDOG, reg.Fault.GROUP_LINE}
    cell.assert_at_rest_and_braked()


# a dying axis -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Stated:
    """Formula 3 at the planned peak speed of an axis: mm at the worst ball, N of internal force."""

    residual_mm: float
    force_n: float


def stated(cell: ReadyModbus, axis: str) -> Stated:
    """d = stuck + v (2 scans + lag) + v t / 2, t = max(2 scans, max_i v_i / a_i); times the axis's column."""
    k, axes, bus = cell.index(axis), cell.positioners, cell.cell.bus
    peak = peak_mm_s(cell.plan)
    ramp_s = max(2.0 * SCAN_S, float(np.max(peak / axes.a_quick_mm_s2)))
    d_mm = cell.cell.limits.stuck_mm + peak[k] * (2.0 * SCAN_S + bus.servo_lag_s + 0.5 * ramp_s)
    balls = socket_positions(axes, cell.plan.q_mm[0])
    to_ball = np.zeros((len(axes.axes), len(axes.axes)))
    for i, columns in enumerate(axes.axes_W):
        to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = columns
    residual = (consistency_projector(balls) @ to_ball)[:, k].reshape(-1, 3)
    force = internal_force_matrix(axes, balls)[:, k].reshape(-1, 3)
    return Stated(
        d_mm * float(np.linalg.norm(residual, axis=1).max()), d_mm * float(np.linalg.norm(force, axis=1).max())
    )


def jam_cases() -> list[Any]:
    """Every axis at four places, at the planner's own speed and at 1 mm/s; a few by default."""
    few = {("A.X", 0.5, 5.0), ("B.Y", 0.35, 5.0), ("C.Z", 0.6, 5.0), ("D.Y", 0.5, 1.0)}
    axes = [f"{station}.{axis}" for station in "ABCD" for axis in "XYZ"]
    whole = [(axis, share, speed) for axis in axes for share in (0.2, 0.35, 0.5, 0.6) for speed in (5.0, 1.0)]
    return [
        pytest.param(*case, id="-".join(map(str, case)), marks=[] if case in few else [pytest.mark.full])
        for case in whole
    ]


@pytest.mark.parametrize(("axis", "share", "speed"), jam_cases())
def test_ax_08_a_seized_axis_costs_no_more_than_the_formula(
    axis: str, share: float, speed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift_mm = 40.0 if speed > 1.0 else 6.0
    scene = ModbusScene("fuselage-modbus", seed=3, shift_mm=shift_mm, turn_deg=0.1, speed_mm_s=speed)

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(share, lambda cell: cell.plant.jam(axis))

    cell = play_modbus(scene, story, monkeypatch)
    bound, peak = stated(cell, axis), peak_mm_s(cell.plan)[cell.index(axis)]
    force_n, residual_mm = cell.force_rise_n(), cell.residual_mm()
    print(f"AX-08 Modbus {axis} at {share}: peak {peak:.2f} mm/s, {residual_mm:.3f} of {bound.residual_mm:.3f} mm, "
          f"{force_n:.0f} of {bound.force_n:.0f} N; {cell.plan.speed_limited_by}")  # fmt: skip
    assert cell.result is not None
    # A crawling axis may be found by the host's own watch before it hangs back far enough for its PLC.
    assert isinstance(cell.result.cause, DriveFault | AxisStuck)
    assert axis in str(cell.result.cause)
    assert residual_mm <= bound.residual_mm + cell.stated_mm()
    assert force_n <= bound.force_n
    assert bound.force_n <= 1.001 * cell.cell.limits.internal_force_n
    # It is seen when it hangs back by stuck_mm, which takes a crawling axis its time.
    row = int(share * cell.plan.duration_s / cell.plan.period_s)
    there_mm_s = abs(cell.plan.q_mm[row + 1, cell.index(axis)] - cell.plan.q_mm[row, cell.index(axis)]) / 0.1
    assert cell.stood_s(axis) <= 1.2 * cell.cell.limits.stuck_mm / there_mm_s + 0.1
    cell.assert_at_rest_and_braked()
    cell.assert_no_second_start()
