"""Looks at the Modbus devices of a cell: positioner PLCs and I/O modules. Reads only, on connections of its own."""

from __future__ import annotations

import asyncio
import cmath
import math
import struct
from collections.abc import Mapping
from typing import Any

from docking.config.cell import CellFile, ModbusBus, PositionerConfig
from docking.config.inputs import ModbusModule
from docking.errors import BadReply, DockingError, WrongIdentity
from docking.ports import SerialLink
from docking.types import Identity
from drivers.look import AxisValue, Found, Stopwatch
from drivers.maps.io_modules import load_modbus_io
from drivers.modbus_client import ModbusUnit, Tap, tapped
from drivers.modbus_requests import RegisterUnit
from drivers.modbus_wires import units_of
from drivers.register_map import RegisterMap, load_map

ROUND_TRIPS = 10
LISTEN_S = 0.3
"""How long it takes at least to see a host that is alive."""
PHASE_S = 0.5
"""How long the scan counters are watched to find when the controllers scan."""


class _Station:
    """One connection and how long its answers took."""

    def __init__(self, name: str, where: str, unit: RegisterUnit, address: str) -> None:
        self.name, self.where, self.unit, self.address = name, where, unit, address
        self.watch = Stopwatch()

    async def connect(self) -> None:
        if not self.unit.connected:
            await self.unit.connect()


class ModbusLook:
    """The Modbus devices of a cell. `addresses` overrides the cell file by name, `link` its serial line; `tap` hears
    all bytes of TCP connections."""

    def __init__(
        self,
        cell: CellFile,
        addresses: Mapping[str, tuple[str, int]] | None = None,
        tap: Tap | None = None,
        link: SerialLink | None = None,
    ) -> None:
        self._cell, given = cell, addresses or {}
        self._bus = cell.bus if isinstance(cell.bus, ModbusBus) else None
        self._map: RegisterMap | None = load_map(self._bus.map) if self._bus is not None else None
        self._plcs = _positioners(cell, self._bus, given, tap, link) if self._bus is not None else {}
        modules = cell.inputs.modules if cell.inputs is not None else ()
        self._modules = {m.name: m for m in modules if isinstance(m, ModbusModule)}
        self._inputs = {m.name: _module(m, given.get(m.name), tap) for m in self._modules.values()}

    def close(self) -> None:
        for station in (*self._plcs.values(), *self._inputs.values()):
            station.unit.close()

    # who is there ------------------------------------------------------------------------------------------------
    async def find(self) -> tuple[Found, ...]:
        """Every positioner and module of the cell."""
        plcs = [await self._plc(config) for config in self._cell.positioners if config.name in self._plcs]
        return (*plcs, *[await self._module(module) for module in self._modules.values()])

    async def _plc(self, config: PositionerConfig) -> Found:
        station, layout = self._plcs[config.name], self._layout()
        identity, problem = None, None
        state = watchdog = units = ""
        try:
            await station.connect()
            head = await self._read(station, "identity")
            identity = Identity(station.where, head["vendor"], head["product"], head["serial"], head["firmware"])
            settings, status = await self._read(station, "settings"), await self._read(station, "status")
            armed = bool(status["flags"] & layout.flags["watchdog_armed"])
            state = layout.states.get(status["state"], f"state {status['state']}")
            state += f", {layout.fault(status['fault'])}" if status["fault"] else ""
            watchdog = f"{settings['watchdog_ms']} ms, {'armed' if armed else 'not armed'}"
            units = f"{layout.scale['position_per_mm']} counts/mm, scan {head['scan_ms']} ms, map {head['map_version']}"
            for _ in range(ROUND_TRIPS):
                await self._read(station, "status")
            self._prove(station, config, head)
        except DockingError as error:
            problem = error
        taken = tuple(station.watch.taken_s)
        return Found(station.where, station.address, identity, state, units, watchdog, taken, problem)

    def _prove(self, station: _Station, config: PositionerConfig, head: Mapping[str, Any]) -> None:
        layout = self._layout()
        if head["magic"] != layout.magic:
            raise BadReply(station.where, "The word order differs.", value=f"{head['magic']} for {layout.magic}")
        for key, wanted in (("station", config.name), ("map_version", layout.version)):
            if head[key] != wanted:
                raise WrongIdentity(station.where, f"Compared: {key}.", value=str(head[key]), limit=str(wanted))

    async def _module(self, module: ModbusModule) -> Found:
        station, layout = self._inputs[module.name], load_modbus_io(module.map)
        identity, problem = None, None
        try:
            await station.connect()
            block = layout.identity
            read = station.unit.read_inputs(block.address, block.count)
            head, _ = block.unpack(await station.watch.time(read))
            identity = Identity(station.where, head["vendor"], head["product"], head["serial"], head["firmware"])
            if head["magic"] != layout.magic:
                raise BadReply(station.where, "The word order differs.", value=f"{head['magic']:#x}")
        except DockingError as error:
            problem = error
        units = f"{layout.digital_inputs} contacts, {layout.analogue_inputs} analogue inputs"
        taken = tuple(station.watch.taken_s)
        beat = f"polled every {1e3 * module.poll_s:.0f} ms"
        return Found(station.where, station.address, identity, "", units, beat, taken, problem)

    async def controlled(self) -> bool:
        """True where a host keeps a PLC alive: the heartbeat that it repeats changes."""
        if self._bus is None:
            return False
        stations = [station for station in self._plcs.values() if station.unit.connected]
        before = [await self._host_beat(station) for station in stations]
        await asyncio.sleep(LISTEN_S + 2.0 * self._bus.poll_s)
        after = [await self._host_beat(station) for station in stations]
        return any(b is not None and a is not None and b != a for b, a in zip(before, after, strict=True))

    async def _host_beat(self, station: _Station) -> int | None:
        try:
            return int((await self._read(station, "status"))["hb_echo"])
        except DockingError:
            return None

    async def start_skew_s(self) -> tuple[float, float] | None:
        """Largest difference of the instants at which the controllers scan, and how well it is known; None where it
        cannot be seen.

        A common edge is seen by each controller in its next scan: no start can be more even than the scans are. Each
        scan counter is read over and over; a count that has moved between two reads bounds the instant of a scan.
        """
        stations = [station for station in self._plcs.values() if station.unit.connected]
        if self._bus is None or self._bus.line is not None or len(stations) < 2:
            # On one serial line the units are read in turn, too seldom to see a scan.
            return None
        seen = await asyncio.gather(*(self._ticks(station) for station in stations))
        if not all(seen):
            return None
        scan_s = self._bus.scan_s
        turns = [sum(cmath.exp(2j * math.pi * at / scan_s) for at, _ in ticks) for ticks in seen]
        phases = [cmath.phase(turn) / (2.0 * math.pi) * scan_s for turn in turns]
        apart = [abs((a - b + 0.5 * scan_s) % scan_s - 0.5 * scan_s) for a in phases for b in phases]
        return max(apart), max(width for ticks in seen for _, width in ticks)

    async def _ticks(self, station: _Station) -> list[tuple[float, float]]:
        """(instant, +-) of the scans that were seen to happen."""
        loop = asyncio.get_running_loop()
        end_s, found = loop.time() + PHASE_S, []
        before_s, before = loop.time(), -1
        while loop.time() < end_s:
            try:
                count = (await self._read(station, "status"))["hb_plc"]
            except DockingError:
                return []
            now_s = loop.time()
            if before >= 0 and count != before:
                found.append((0.5 * (before_s + now_s), 0.5 * (now_s - before_s)))
            before_s, before = now_s, count
        return found

    # values ------------------------------------------------------------------------------------------------------
    async def axes(self) -> tuple[AxisValue, ...]:
        """Where every axis stands."""
        return tuple([row for config in self._cell.positioners for row in await self._values(config)])

    async def _values(self, config: PositionerConfig) -> list[AxisValue]:
        station, layout = self._plcs[config.name], self._layout()
        names = [f"{config.name}.{axis.name}" for axis in config.axes]
        block = layout.blocks["status"]
        try:
            await station.connect()
            head, axes = block.unpack(await station.unit.read(block.address, block.count))
        except DockingError as error:
            return [AxisValue(name, str(error), math.nan, math.nan, math.nan) for name in names]
        state = layout.states.get(head["state"], "unknown")
        mm, no_force = 1.0 / layout.scale["position_per_mm"], layout.scale["no_force"]
        return [
            AxisValue(
                name,
                state,
                row[0] * mm,
                row[1] * mm,
                math.nan if row[2] == no_force else float(row[2] * layout.scale["force_n"]),
            )
            for name, row in zip(names, axes, strict=True)
        ]

    async def inputs(self) -> Mapping[str, tuple[bytes, tuple[int | None, ...]]]:
        """Levels and counts of every I/O module; empty where it does not answer."""
        found: dict[str, tuple[bytes, tuple[int | None, ...]]] = {}
        for name, station in self._inputs.items():
            layout = load_modbus_io(self._modules[name].map)
            try:
                await station.connect()
                levels = await station.unit.read_bits(layout.discrete_at, layout.digital_inputs)
                data = await station.unit.read_inputs(layout.analogue_at, layout.analogue_inputs)
            except DockingError:
                found[name] = (b"", ())
                continue
            counts = struct.unpack(f">{layout.analogue_inputs}h", data)
            found[name] = (levels, tuple(None if value == layout.broken else value for value in counts))
        return found

    def _layout(self) -> RegisterMap:
        if self._map is None:
            raise ValueError("this cell has no positioners on Modbus")
        return self._map

    async def _read(self, station: _Station, name: str) -> dict[str, Any]:
        block = self._layout().blocks[name]
        head, _ = block.unpack(await station.watch.time(station.unit.read(block.address, block.count)))
        return head


def _positioners(
    cell: CellFile,
    bus: ModbusBus,
    given: Mapping[str, tuple[str, int]],
    tap: Tap | None,
    link: SerialLink | None,
) -> dict[str, _Station]:
    addresses = {p.name: given.get(p.name, (p.host or "127.0.0.1", p.port or 502)) for p in cell.positioners}
    stations = {}
    for config, unit in zip(cell.positioners, units_of(cell, bus, addresses, tap, link), strict=True):
        at = bus.line if bus.line is not None else "{}:{}".format(*addresses[config.name])
        where = f"positioner {config.name}"
        stations[config.name] = _Station(config.name, where, unit, f"{at} unit {config.unit or 1}")
    return stations


def _module(config: ModbusModule, given: tuple[str, int] | None, tap: Tap | None) -> _Station:
    host, port = given or (config.host, config.port)
    where = f"input module {config.name}"
    unit = ModbusUnit(where, host, port, config.unit, config.timeout_s)
    unit.tap = tapped(tap, config.name)
    return _Station(config.name, where, unit, f"{host}:{port} unit {config.unit}")
