"""`docking monitor`: what the positioners and the inputs of a cell say, live. Reads only; nothing is enabled."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from docking.assemble.looking import Ends, LookRequest, load_looked_at, wires_of
from docking.assemble.real_time import on_interrupt, run_real
from docking.config import CellFile
from docking.config.cell import CanBus
from docking.config.inputs import InputsConfig
from docking.config.wired_forces import load_cell_ranges_n, wired_forces
from drivers.canopen.look import BusLook
from drivers.load_cells import measured_n
from drivers.look import AxisValue
from drivers.modbus_look import ModbusLook

PERIOD_S = 0.5
Levels = Mapping[str, tuple[bytes, tuple[int | None, ...]]]


def monitor(request: LookRequest, seconds: float | None, show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Call `show` with the newest values twice a second, for `seconds` or until interrupted; returns the last values.

    Raises ConfigError, PortMissing.
    """
    cell = load_looked_at(request)

    async def main() -> dict[str, Any]:
        async with wires_of(request, cell) as ends:
            return await _watch(cell, ends, seconds, show)

    return run_real(main, ticks=False)


async def _watch(
    cell: CellFile, ends: Ends, seconds: float | None, show: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    asked_to_end = asyncio.Event()
    on_interrupt(asked_to_end.set)
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    bus = BusLook(cell, ends.bus.can) if ends.bus.can is not None else None
    modbus = ModbusLook(cell, ends.bus.modbus, ends.tap, ends.bus.line)
    try:
        if bus is not None:
            await bus.open()
        while True:
            values = await _values(cell, bus, modbus)
            values["t_s"] = loop.time() - began_s
            show(values)
            left_s = math.inf if seconds is None else seconds - (loop.time() - began_s)
            if not left_s > 0.0 or await _pause(asked_to_end, min(PERIOD_S, left_s)):
                return values
    finally:
        modbus.close()
        if bus is not None:
            bus.close()


async def _pause(asked_to_end: asyncio.Event, seconds: float) -> bool:
    """Wait; True when the end was asked for."""
    try:
        async with asyncio.timeout(seconds):
            await asked_to_end.wait()
    except TimeoutError:
        return False
    return True


async def _values(cell: CellFile, bus: BusLook | None, modbus: ModbusLook) -> dict[str, Any]:
    streamed = bus is not None and isinstance(cell.bus, CanBus)
    axes = await bus.axes() if bus is not None and streamed else await modbus.axes()
    levels: dict[str, tuple[bytes, tuple[int | None, ...]]] = dict(await modbus.inputs())
    if bus is not None:
        levels |= await bus.inputs()
    wired_n = _wired_forces(cell, levels)
    axes = tuple(replace(axis, force_n=wired_n.get(axis.axis, axis.force_n)) for axis in axes)
    return {
        "cell": cell.name,
        "read_by": ("listening to the controller" if bus.controlled else "SDO") if bus is not None else "Modbus",
        "axes": [_axis(axis) for axis in axes],
        **(_inputs(cell.inputs, levels) if cell.inputs is not None else {"inputs": {}, "temperatures_c": {}}),
    }


def _wired_forces(cell: CellFile, levels: Levels) -> dict[str, float]:
    """What load cells on I/O modules read, by axis; NaN where that means no force."""
    found = {}
    for force in wired_forces(cell):
        _, counts = levels.get(force.module, (b"", ()))
        for name, channel, range_n in zip("XYZ", force.channels, load_cell_ranges_n(cell), strict=True):
            value = counts[channel] if channel < len(counts) else None
            found[f"{force.positioner}.{name}"] = measured_n(force, range_n, value)
    return found


def _axis(value: AxisValue) -> dict[str, Any]:
    """Values that are not known are None."""
    numbers = {
        "position_mm": value.position_mm,
        "following_error_mm": value.following_error_mm,
        "force_n": value.force_n,
    }
    known = {name: number if math.isfinite(number) else None for name, number in numbers.items()}
    return {"axis": value.axis, "state": value.state, **known}


def _inputs(config: InputsConfig, levels: Levels) -> dict[str, Any]:
    """Contacts and temperatures by name, undebounced; None where their module does not answer."""
    contacts: dict[str, bool | None] = {}
    for item in config.digital:
        data, _ = levels.get(item.module, (b"", ()))
        here = item.channel < 8 * len(data)
        level = bool(data[item.channel // 8] >> item.channel % 8 & 1) if here else None
        contacts[item.name] = None if level is None else level is (item.on == "high")
    celsius: dict[str, float | None] = {}
    for sensor in config.temperatures:
        _, counts = levels.get(sensor.module, (b"", ()))
        value = counts[sensor.channel] if sensor.channel < len(counts) else None
        celsius[sensor.name] = None if value is None else sensor.offset_c + sensor.celsius_per_count * value
    return {"inputs": contacts, "temperatures_c": celsius}


def monitor_text(values: dict[str, Any]) -> str:
    """One screen of values."""

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    lines = [f"{values['cell']}  {values['t_s']:.1f} s  ({values['read_by']}; reads only)"]
    lines.append(f"{'axis':<8}{'position mm':>14}{'following mm':>14}{'force N':>10}   state")
    lines += [
        f"{row['axis']:<8}{number(row['position_mm'], '.3f'):>14}{number(row['following_error_mm'], '.4f'):>14}"
        f"{number(row['force_n'], '.0f'):>10}   {row['state']}"
        for row in values["axes"]
    ]
    words = {True: "ON", False: "off", None: "unknown"}
    contacts = [f"{name} {words[given]}" for name, given in values["inputs"].items()]
    lines += ["inputs: " + ", ".join(contacts)] if contacts else []
    warm = [f"{name} {number(value, '.1f')} C" for name, value in values["temperatures_c"].items()]
    lines += ["temperatures: " + ", ".join(warm)] if warm else []
    return "\n".join(lines)
