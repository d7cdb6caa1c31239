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
    BadReply,
    ConsistencyTrip,
    DeviceRefused,
    DeviceSilent,
    DockingError,
    DriveFault,
    FeedbackMissing,
    LinkLost,
    MotionError,
    ReadBackMismatch,
    WrongIdentity,
)
from docking.motion.triggers import Trigger
from sim.plc import registers as reg
from tests.support.ready_modbus import ModbusScene, ReadyModbus, peak_mm_s, play_modbus

POLL_S, TIMEOUT_S, SCAN_S = 0.05, 0.05, 0.01
MISSING_CYCLES = 2
TOLD_S = 3.0 * SCAN_S
"""A command takes a scan to be obeyed; the motors follow a little later."""
LAB, FUSELAGE = ModbusScene(), ModbusScene("fuselage-modbus", shift_mm=8.0, speed_mm_s=5.0)


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
    "AX-05 limit switch": Row(press_limit, MotionError, "B.Z", TOLD_S, Trigger.LIMIT_SWITCH),
}
"""Positioner B is the victim. `slow`: its own watchdog stops it, along the ordinary ramp; it takes the others along.
Frozen registers go on as if all were well, but for the number of the scan. A switch may be read before its PLC has
stopped for it: one trigger all the same.
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


LOST_S = 6.0 * SCAN_S


def lose_scans(cell: ReadyModbus) -> None:
    """B plays nothing in six scans, as if its task had been overrun; then it goes on."""
    cell.victim.queue.lead_s = -LOST_S


def test_mb_05_path_times_apart_stop_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every axis is on its path and follows; only the places on the path are not one."""

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(0.5, lose_scans)

    cell = play_modbus(LAB, story, monkeypatch)
    assert cell.result is not None
    assert isinstance(cell.result.cause, ConsistencyTrip)
    assert cell.result.cause.where == "path times"
    assert "B is last" in str(cell.result.cause)
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is Trigger.COUPLING
    # Lost in six scans, told by the second read-back after that; nothing makes up for it.
    assert cell.stood_s() <= LOST_S + 2.0 * POLL_S + TOLD_S + cell.motion._bus.quick_ramp_s + 2.0 * SCAN_S
    speed = float(np.linalg.norm(peak_mm_s(cell.plan).reshape(-1, 3), axis=1).max())
    assert cell.residual_mm() <= LOST_S * speed + cell.stated_mm()
    cell.assert_at_rest_and_braked()
