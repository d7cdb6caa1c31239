"""All positioner PLCs of a cell around one plant: one scan every 10 ms, two common lines, one server a positioner.

RUN and GROUP_OK are wired AND: each is high only while every PLC releases it. All PLCs see an edge in the same scan;
their clocks differ, so their path times drift apart by the difference of `clock_ppm`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from docking.config.cell import CellFile
from sim.plc.drives import FailedDrives
from sim.plc.modbus_rtu import ModbusRtuLine
from sim.plc.modbus_tcp import ModbusTcpConnection
from sim.plc.playback import Point
from sim.plc.positioner import SCAN_S, Lines, PositionerPlc
from sim.plc.registers import AXES, State
from sim.plc.reply_faults import ReplyFaults
from sim.plc.sensors import PlantView, Readings, Sensors
from sim.wires.pacing import DeviceEnd

Address = tuple[str, int]
FOLLOWING_ERROR_FACTOR = 2.0
"""A PLC trips at this multiple of the cell's following error limit, after the host had its chance."""


class PlcGroup:
    """The simulated positioner PLCs; `clock_ppm` and `start_late_s` hold one number a positioner.

    `tap(name, sent, data)` hears all bytes.
    """

    def __init__(
        self,
        plant: PlantView,
        cell: CellFile,
        clock_ppm: Sequence[float],
        loop: asyncio.AbstractEventLoop,
        start_late_s: Sequence[float] = (),
    ) -> None:
        self._plant, self._cell, self._loop = plant, cell, loop
        self.tap: Callable[[str, bool, bytes], None] | None = None
        count = len(cell.positioners)
        late_s = tuple(start_late_s) or (0.0,) * count
        has_force = np.repeat([p.load_cell and cell.load_cells is not None for p in cell.positioners], AXES)
        self._readings = Readings(plant, has_force)
        trip_mm = FOLLOWING_ERROR_FACTOR * cell.limits.following_error_vmax_mm
        self.plcs = tuple(
            PositionerPlc(p, Sensors(self._readings, i), trip_mm, loop.time, late_s[i])
            for i, p in enumerate(cell.positioners)
        )
        self._clocked = tuple((plc, 1.0 + 1e-6 * ppm) for plc, ppm in zip(self.plcs, clock_ppm, strict=True))
        self._driven = np.array(cell.driven, dtype=np.bool_)
        self._target_mm = np.array(plant.encoder_mm(), dtype=np.float64)
        self._powered = np.zeros(len(self._driven), dtype=np.bool_)
        self._braked = self._driven.copy()
        self._drives = FailedDrives(np.array([a.a_quick_mm_s2 for p in cell.positioners for a in p.axes]))
        self._step_mm = np.zeros(len(self._driven))
        self._dt_s = SCAN_S
        self._targets: list[Point] = []
        self._states: list[tuple[State, bool]] = []
        self._before_s = self._due_s = loop.time()
        self._timer: asyncio.TimerHandle | None = None
        self._servers: list[asyncio.AbstractServer] = []
        self._connections: set[ModbusTcpConnection] = set()
        self.faults = {p.name: ReplyFaults() for p in cell.positioners}

    async def serve(self, addresses: Mapping[str, Address] | None = None) -> dict[str, Address]:
        """Start scanning and listen; return the address of every positioner.

        `addresses` overrides the cell file by positioner name; positioners that share an address answer there by
        their units. Port 0 asks for a free port of its own.
        """
        units: dict[Address, dict[int, PositionerPlc]] = {}
        wanted = {
            p.name: (addresses or {}).get(p.name, (p.host or "127.0.0.1", p.port or 502))
            for p in self._cell.positioners
        }
        result: dict[str, Address] = {}
        for config, plc in zip(self._cell.positioners, self.plcs, strict=True):
            address = wanted[config.name]
            unit = config.unit or 1
            if address in units and address[1] != 0:
                units[address][unit] = plc
                result[config.name] = address
                continue
            shared = {unit: plc}
            server = await self._listen(address, shared)
            bound = server.sockets[0].getsockname()[:2] if server.sockets else address
            units[address] = shared
            result[config.name] = bound
        self._due_s = self._before_s = self._loop.time()
        self._schedule()
        return result

    def serve_line(self, end: DeviceEnd, baud: int) -> ModbusRtuLine:
        """Start scanning and answer for all positioners at the end of one serial line, each by its unit."""
        units = {p.unit or 1: plc for p, plc in zip(self._cell.positioners, self.plcs, strict=True)}
        self._due_s = self._before_s = self._loop.time()
        self._schedule()
        return ModbusRtuLine(units, end, baud, self._loop, faults=self._faults_of(units))

    async def _listen(self, address: Address, units: Mapping[int, PositionerPlc]) -> asyncio.Server:
        names = [p.name for p, plc in zip(self._cell.positioners, self.plcs, strict=True) if plc in units.values()]
        hear, faults = partial(self._hear, "+".join(names)), self._faults_of(units)

        def connection() -> ModbusTcpConnection:
            return ModbusTcpConnection(units, self._connections, hear, faults)

        server = await self._loop.create_server(connection, *address)
        self._servers.append(server)
        return server

    def _faults_of(self, units: Mapping[int, PositionerPlc]) -> dict[int, ReplyFaults]:
        names = {id(plc): p.name for p, plc in zip(self._cell.positioners, self.plcs, strict=True)}
        return {unit: self.faults[names[id(plc)]] for unit, plc in units.items()}

    def _hear(self, name: str, sent: bool, data: bytes) -> None:
        if self.tap is not None:
            self.tap(name, sent, data)

    async def close(self) -> None:
        """Stop scanning, close servers and connections."""
        if self._timer is not None:
            self._timer.cancel()
        for connection in tuple(self._connections):
            connection.close()
        for server in self._servers:
            server.close()
            await server.wait_closed()
        self._servers.clear()

    def heard_s(self) -> float:
        """When a heartbeat of the host came last to any PLC; NaN before the first."""
        return max((plc.heard_s for plc in self.plcs if plc.heard_s == plc.heard_s), default=float("nan"))

    def drop_connections(self, name: str) -> None:
        """Cut every connection to the positioner `name` (fault injection)."""
        plc = self._plc_of(name)
        for connection in tuple(self._connections):
            if connection.serves(plc):
                connection.close()

    def press_limit(self, axis: str, pressed: bool = True) -> None:
        """Set the limit switch of `axis` (fault injection)."""
        plc, index = self._axis(axis)
        plc.guard.limit[index] = pressed

    def fail_drive(self, axis: str, torque: bool = True) -> None:
        """Have the drive of `axis` go to fault: it ramps down by itself, or without `torque` its brake takes the axis.

        Its PLC hears of it in the next scan but one, as of anything that happens right after its inputs were read.
        """
        index = self._cell.axis_names.index(axis)
        speed_mm_s = float(self._step_mm[index]) / self._dt_s
        self._drives.fail(index, float(self._target_mm[index]), speed_mm_s, torque)

    def repair_drive(self, axis: str) -> None:
        """The drive of `axis` is no longer in fault."""
        plc, index = self._axis(axis)
        self._drives.repair(self._cell.axis_names.index(axis))
        plc.guard.drive_fault[index] = False

    def _axis(self, axis: str) -> tuple[PositionerPlc, int]:
        number, index = divmod(self._cell.axis_names.index(axis), AXES)
        return self.plcs[number], index

    def _plc_of(self, name: str) -> PositionerPlc:
        return next(plc for p, plc in zip(self._cell.positioners, self.plcs, strict=True) if p.name == name)

    def _schedule(self) -> None:
        # On a real loop a late scan is followed by the next one on the grid; a long pause is not made up for.
        self._due_s = max(self._due_s + SCAN_S, self._loop.time())
        self._timer = self._loop.call_at(self._due_s, self._tick)

    def _tick(self) -> None:
        self.scan(self._loop.time())
        self._schedule()

    def scan(self, now_s: float) -> None:
        """One scan of all PLCs and one step of the plant."""
        dt_s, self._before_s = now_s - self._before_s, now_s
        for plc in self.plcs:
            plc.think(now_s)
        lines = Lines(
            run=all(plc.releases_run_line for plc in self.plcs),
            group_ok=all(plc.releases_group_line for plc in self.plcs),
        )
        for plc, rate in self._clocked:
            plc.play(lines, now_s, dt_s * rate)
        before_mm, self._dt_s = self._target_mm, dt_s or SCAN_S
        self._draw()
        self._step_mm = self._target_mm - before_mm
        asked = (self._target_mm, self._powered, self._braked)
        failed = self._drives.indices
        self._plant.step(now_s, *(self._drives.lead(dt_s, *asked) if failed else asked))
        for index in failed:
            self.plcs[index // AXES].guard.drive_fault[index % AXES] = True
        self._readings.next_scan()

    def _draw(self) -> None:
        """Put what has changed of the PLCs' outputs into arrays; passive axes have neither motor nor brake."""
        targets = [plc.target_mm for plc in self.plcs]
        if targets != self._targets:
            self._targets = targets
            self._target_mm = np.array([mm for target in targets for mm in target])
        states = [(plc.state, plc.braked) for plc in self.plcs]
        if states != self._states:
            self._states = states
            self._powered = np.repeat([plc.powered for plc in self.plcs], AXES) & self._driven
            self._braked = np.repeat([plc.braked for plc in self.plcs], AXES) & self._driven
