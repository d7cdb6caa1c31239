"""The units of a cell's positioners: each at a TCP address of its own, or all on one serial line."""

from __future__ import annotations

from collections.abc import Mapping

from docking.config.cell import CellFile, ModbusBus
from docking.errors import BadArgument
from docking.ports import SerialLink
from drivers.links.serial_port import SerialPort
from drivers.modbus_client import ModbusUnit, Tap, tapped
from drivers.modbus_requests import RegisterUnit
from drivers.modbus_rtu import RtuLine, exchange_s
from drivers.register_map import RegisterMap

REQUEST_BYTES, REPLY_BYTES = 13, 5
"""Of an RTU frame of function 23 besides its registers: the request, the reply."""


def units_of(
    cell: CellFile, bus: ModbusBus, addresses: Mapping[str, tuple[str, int]], tap: Tap | None, link: SerialLink | None
) -> list[RegisterUnit]:
    """A fresh unit for each positioner, not yet connected. `link` takes the place of the cell's serial port."""
    if bus.line is None:
        return [_tcp_unit(p.name, addresses[p.name], p.unit or 1, bus, tap) for p in cell.positioners]
    port = link or SerialPort(bus.line, bus.baud, "Modbus line", bus.framing)
    line = RtuLine(port, bus.line, bus.baud, bus.timeout_s)
    return [line.unit(f"positioner {p.name}", p.unit or 1) for p in cell.positioners]


def _tcp_unit(name: str, address: tuple[str, int], number: int, bus: ModbusBus, tap: Tap | None) -> RegisterUnit:
    unit = ModbusUnit(f"positioner {name}", *address, number, bus.timeout_s)
    unit.tap = tapped(tap, name)
    return unit


def line_poll_s(bus: ModbusBus, layout: RegisterMap, units: int) -> float:
    """Time (s) that one poll of all units takes on the line, with a segment for each; a unit answers within a scan."""
    request = REQUEST_BYTES + 2 * (layout.blocks["heartbeat"].count + layout.blocks["segment"].count)
    reply = REPLY_BYTES + 2 * layout.blocks["status"].count
    return units * exchange_s(bus.baud, request, reply, bus.scan_s)


def require_line(bus: ModbusBus, layout: RegisterMap, units: int) -> None:
    """Polls of a serial line must fit between each other, feed every queue and reach every watchdog.

    Raises BadArgument: the line is too slow for `poll_s` or `segment_s`, or two polls last longer than `watchdog_s`.
    """
    if bus.line is None:
        return
    least_s = line_poll_s(bus, layout, units)
    for key, given_s, needed_s in (
        ("poll_s", bus.poll_s, least_s),
        ("segment_s", bus.segment_s, least_s),
        ("watchdog_s", bus.watchdog_s, 2.0 * bus.poll_s),
    ):
        if not needed_s <= given_s:
            cause = f"too short for {units} units on one line of {bus.baud} bit/s"
            raise BadArgument(f"bus.{key}", cause, value=given_s, limit=round(needed_s, 4))
