"""Axes beside the positioners: who answers, and `docking single`, which moves one of them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

from docking.assemble.looking import Ends, LookRequest, Notify, load_looked_at, unheard, wires_of
from docking.assemble.real_time import run_real
from docking.assemble.timed import TimedSerial
from docking.config import CellFile
from docking.config.cell import SingleAxis
from docking.errors import BadArgument, DockingError
from docking.ports import SerialLink
from docking.transcript import TranscribedSerial
from drivers.links.serial_port import SerialPort
from drivers.look import Found
from drivers.modbus_rtu import RtuLine
from drivers.numerical_drive import DriveState, NumericalDrive, load_numerical_map

NO_WATCHDOG = "none: it goes on to its target when the controller falls silent"
ROUND_TRIPS = 5
MARGIN_S = 2.0
"""By which a move may outlast its way at its speed."""


@dataclass(frozen=True)
class SingleMove:
    """One move of one single axis, its speed (mm/s) that of the cell file where none is given."""

    look: LookRequest
    name: str
    target_mm: float
    speed_mm_s: float | None = None


def single_axis(move: SingleMove) -> tuple[CellFile, SingleAxis, float]:
    """The cell, the axis and the speed (mm/s) of a move; nothing is opened.

    Raises ConfigError, BadArgument for an axis, target or speed that is not in the cell.
    """
    name, target_mm, speed_mm_s = move.name, move.target_mm, move.speed_mm_s
    cell = load_looked_at(move.look)
    axis = _axis(cell, name)
    speed = axis.v_mm_s if speed_mm_s is None else speed_mm_s
    low, high = axis.stroke_mm
    if not (low <= target_mm <= high):
        raise BadArgument(f"{name}, target", f"{low:g} to {high:g}", value=target_mm)
    if not (0.0 < speed <= axis.v_mm_s):
        raise BadArgument(f"{name}, speed", f"above 0 to {axis.v_mm_s:g}", value=speed)
    return cell, axis, speed


def move_single(move: SingleMove, notify: Notify = unheard) -> dict[str, Any]:
    """Move one single axis and wait until it says that it is there.

    Nothing reaches an axis on its way: who interrupts, or meets an error then, is told that it may go on. Raises as
    `single_axis` and `NumericalDrive.move`.
    """
    cell, axis, speed = single_axis(move)
    name, target_mm = move.name, move.target_mm

    async def main() -> dict[str, Any]:
        async with wires_of(move.look, cell) as ends, _drive(axis, _line(axis, ends)) as drive:
            before = await drive.read()
            within_s = abs(target_mm - before.position_mm) / speed + speed / axis.a_mm_s2 + MARGIN_S
            notify("single_moving", name=name, before_mm=before.position_mm, target_mm=target_mm, speed_mm_s=speed)
            try:
                after = await drive.move(target_mm, speed, 1e-3 * axis.a_mm_s2, within_s)
            except (asyncio.CancelledError, DockingError):
                notify("single_goes_on", name=name, target_mm=target_mm)
                raise
            return {"axis": name, "before_mm": before.position_mm, "after_mm": after.position_mm, "speed_mm_s": speed}

    return run_real(main, ticks=False)


async def look_at_singles(cell: CellFile, ends: Ends) -> list[Found]:
    """What every single axis says of itself; reads only."""
    return [await _look(axis, ends) for axis in cell.single_axes]


async def _look(axis: SingleAxis, ends: Ends) -> Found:
    address, timed = f"{axis.line} unit {axis.unit}, {axis.map}", TimedSerial(_line(axis, ends))
    try:
        async with _drive(axis, timed) as drive:
            for _ in range(ROUND_TRIPS):
                state = await drive.read()
    except DockingError as error:
        return Found(f"single axis {axis.name}", address, round_trips_s=tuple(timed.taken_s), problem=error)
    units = f"stands at {state.position_mm:.2f} mm"
    return Found(f"single axis {axis.name}", address, None, _words(state), units, NO_WATCHDOG, tuple(timed.taken_s))


def _words(state: DriveState) -> str:
    if state.alarm:
        return f"alarm {state.alarm:#x}"
    return ", ".join(("servo on" if state.powered else "servo off", "homed" if state.homed else "not homed"))


def _axis(cell: CellFile, name: str) -> SingleAxis:
    known = {axis.name: axis for axis in cell.single_axes}
    if name not in known:
        cause = f"one of {', '.join(known)}" if known else "the cell has no [[single_axes]]"
        raise BadArgument("NAME", cause, value=name)
    return known[name]


def _line(axis: SingleAxis, ends: Ends) -> SerialLink:
    """The line of an axis; its bytes go to the transcript."""
    served = ends.singles.get(axis.line)
    # The pseudo-terminal of simulated devices has no parity to set.
    framing = axis.framing if served is None else "8N1"
    link = SerialPort(served or axis.line, axis.baud, f"single axis {axis.name}", framing)
    return link if ends.transcript is None else TranscribedSerial(link, ends.transcript, f"single:{axis.name}")


@contextlib.asynccontextmanager
async def _drive(axis: SingleAxis, link: SerialLink) -> AsyncIterator[NumericalDrive]:
    """The drive of an axis, its line open. Raises PortMissing."""
    unit = RtuLine(link, f"single axis {axis.name}", axis.baud, axis.timeout_s).unit(axis.name, axis.unit)
    await unit.connect()
    try:
        yield NumericalDrive(unit, load_numerical_map(axis.map))
    finally:
        unit.close()
