"""The simulated far end of a cell: one plant, its instrument and its positioners, on virtual or on real wires."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Wires
from docking.assemble.transcribed import TranscribedDevice, TranscribedStation
from docking.assemble.wires import LINE, can_of
from docking.config import CellFile, JobFile
from docking.config.build import plan_period_s
from docking.config.cell import CanBus, ModbusBus
from docking.config.inputs import CanModule, ModbusModule
from docking.config.wired_forces import as_axes_know_it
from docking.transcript import Transcript
from sim.canopen.group import DriveGroup
from sim.canopen.io_module import IoModule
from sim.canopen.settings import DriveSettings
from sim.canopen.shares import PlantShare, PlantShares
from sim.input_world import InputWorld
from sim.instrument import Instrument
from sim.plant import Plant
from sim.plc.group import PlcGroup
from sim.plc.io_module import IoRegisters, IoServer
from sim.plc.modbus_rtu import ModbusRtuLine
from sim.plc.numerical_drive import NumericalAxis
from sim.trace import AxisTrace
from sim.tracker.geocom import GeocomStation
from sim.tracker.line import LineTrackerDevice
from sim.truth import TruthFile, load_truth
from sim.wires.can_frames import CanEnd
from sim.wires.pacing import DeviceEnd, character_bits
from sim.wires.pty_serial import PtySerial
from sim.wires.shared_end import SharedEnd
from sim.wires.unix_can import UnixCanServer
from sim.wires.virtual_can import VirtualCan, VirtualCanEnd
from sim.wires.virtual_serial import VirtualSerial

LOCAL = "127.0.0.1"


def truth_path(cell_path: Path) -> Path:
    """`NAME.sim.toml` beside `NAME.toml`."""
    return cell_path.with_name(cell_path.name.removesuffix(".toml") + ".sim.toml")


def truth_of(cell_path: Path) -> TruthFile:
    """The plant's truth of a simulated cell; the controller never reads it."""
    return load_truth(truth_path(cell_path))


@dataclass
class FarEnd:
    """The simulated devices of one cell. `plant` is the truth, `world` what the inputs are wired to; `devices` are held
    so that they live."""

    plant: Plant
    instrument: Instrument
    truth: TruthFile
    loop: asyncio.AbstractEventLoop
    seed: int
    world: InputWorld
    devices: list[Any] = field(default_factory=list)
    line: VirtualSerial | None = None
    positioner_line: VirtualSerial | None = None
    transcript: Transcript | None = None
    shares: PlantShares | None = None

    def tracker(self, cell: CellFile, wire: DeviceEnd) -> None:
        """Put the instrument on a serial wire."""
        device = {"line": LineTrackerDevice, "geocom": GeocomStation}[cell.tracker.protocol]
        self.devices.append(device(self.instrument, wire, self.loop, self.seed))

    def drives(self, cell: CellFile, wire: CanEnd, *, shared_cpu: bool = False, channel: str | None = None) -> None:
        """Put the drives on a CAN bus; where there are several, those of `channel`."""
        share: PlantShare | None = None
        if channel is not None:
            cell = cell.on_channel(channel)
            self.shares = self.shares or PlantShares(self.plant, plan_period_s(cell))
            share = self.shares.share(cell.axis_names)
        drives = self.truth.drives
        settings = DriveSettings(
            sync_loss=drives.sync_loss,
            sync_loss_cycles=drives.sync_loss_cycles,
            shared_cpu=shared_cpu,
            watchdog_scatter_s=drives.watchdog_scatter_s,
            supported_modes=sum(1 << (mode - 1) for mode in drives.modes),
            homed=drives.homed,
            zero_off_mm=drives.zero_off_mm,
        )
        modules = [m for m in cell.inputs.modules if isinstance(m, CanModule)] if cell.inputs else []
        shared = SharedEnd(wire)
        # A bus of drives alone keeps its own end: every frame would pass one more pair of hands.
        end = shared.station() if modules else wire
        group = DriveGroup(share or self.plant, as_axes_know_it(cell), settings, end, self.loop)
        if share is not None:
            share.at = group.at
        group.start()
        self.devices.append(group)
        for module in modules:
            device = IoModule(module.name, module.node, self.world, shared.station(), self.loop)
            device.start()
            self.devices.append(device)

    async def plcs(self, cell: CellFile, addresses: dict[str, tuple[str, int]] | None) -> dict[str, tuple[str, int]]:
        """Let the positioner PLCs listen; return their addresses."""
        group = self._plc_group(cell)
        group.tap = self.transcript.modbus if self.transcript is not None else None
        return {**await group.serve(addresses), **await self.modbus_inputs(cell, LOCAL if addresses else None)}

    def plc_line(self, cell: CellFile, wire: DeviceEnd) -> None:
        """Put the positioner PLCs on one serial line, each by its unit."""
        if isinstance(cell.bus, ModbusBus):
            self.devices.append(self._plc_group(cell).serve_line(wire, cell.bus.baud))

    def _plc_group(self, cell: CellFile) -> PlcGroup:
        names = [p.name for p in cell.positioners]
        skew_s = cell.bus.start_skew_s if isinstance(cell.bus, ModbusBus) else 0.0
        late_s = np.random.default_rng([self.seed, len(names)]).uniform(0.0, skew_s, len(names)).tolist()
        group = PlcGroup(self.plant, as_axes_know_it(cell), [self.plant.clock_ppm[n] for n in names], self.loop, late_s)
        self.devices.append(group)
        return group

    async def modbus_inputs(self, cell: CellFile, host: str | None = None) -> dict[str, tuple[str, int]]:
        """Let the Modbus I/O modules listen, at the addresses of the cell or at free ports of `host`."""
        modules = [m for m in cell.inputs.modules if isinstance(m, ModbusModule)] if cell.inputs else []
        found = {}
        for module in modules:
            server = IoServer(IoRegisters(module.name, self.world, self.loop.time), module.unit)
            server.tap = self.transcript.modbus if self.transcript is not None else None
            self.devices.append(server)
            found[module.name] = await server.serve(*((host, 0) if host else (module.host, module.port)))
        return found

    def singles(self, cell: CellFile) -> dict[str, str]:
        """Let the single axes listen, each line on a pseudo-terminal; where, by line."""
        found = {}
        for line in dict.fromkeys(axis.line for axis in cell.single_axes):
            axes = [axis for axis in cell.single_axes if axis.line == line]
            wire = PtySerial(self.loop, axes[0].baud)
            wire.open()
            units = {axis.unit: NumericalAxis(self.loop.time, axis.v_mm_s) for axis in axes}
            self.devices += [ModbusRtuLine(units, wire, axes[0].baud, self.loop), wire]
            found[line] = wire.path
        return found

    def trace(self, path: Path) -> None:
        """Record where the axes are commanded and where they stand. Raises OSError."""
        bus = next(d for d in self.devices if isinstance(d, DriveGroup | PlcGroup))
        self.devices.append(AxisTrace(path, self.plant, bus.heard_s, self.loop))

    async def close(self) -> None:
        """Stop the devices."""
        for device in self.devices:
            close = getattr(device, "close", None)
            result = close() if close is not None else None
            if asyncio.iscoroutine(result):
                await result


def make_far_end(cell: CellFile, job: JobFile, truth: TruthFile, seed: int) -> FarEnd:
    """Plant and instrument of one seed; call on the loop that will run them."""
    plant = Plant(cell, job, truth, seed)
    loop = asyncio.get_running_loop()
    world = InputWorld(cell, plant, loop, seed)
    return FarEnd(plant, Instrument(plant, cell, truth, seed), truth, loop, seed, world)


async def virtual_wires(cell: CellFile, far: FarEnd) -> Wires:
    """All devices on wires inside the process; returns the near ends."""
    far.line = serial = VirtualSerial(far.loop, cell.tracker.baud)
    far.tracker(cell, serial.far)
    if isinstance(cell.bus, CanBus):
        can = can_of(cell, await virtual_buses(cell, far))
        return Wires(serial=serial.near, can=can, modbus=await far.modbus_inputs(cell))
    if cell.bus.line is None:
        return Wires(serial=serial.near, modbus=await far.plcs(cell, None))
    bits = character_bits(cell.bus.framing)
    far.positioner_line = line = VirtualSerial(far.loop, cell.bus.baud, "Modbus line", bits)
    far.plc_line(cell, line.far)
    return Wires(serial=serial.near, modbus=await far.modbus_inputs(cell), line=line.near)


async def virtual_buses(cell: CellFile, far: FarEnd) -> dict[str, VirtualCanEnd]:
    """The drives on buses inside the process; returns the near ends by channel."""
    if not isinstance(cell.bus, CanBus):
        return {}
    ends = {}
    for channel in cell.bus.channels:
        bus = VirtualCan(far.loop, cell.bus.bitrate, channel)
        far_end = bus.end()
        await far_end.open()
        far.drives(cell, far_end, channel=channel if cell.bus.further_channels else None)
        ends[channel] = bus.end()
    return ends


async def real_wires(cell: CellFile, far: FarEnd, folder: Path, transcript: Transcript | None = None) -> dict[str, Any]:
    """All devices on real wires (pty, AF_UNIX CAN, loopback TCP); returns their addresses as plain data."""
    serial = PtySerial(far.loop, cell.tracker.baud)
    serial.open()
    far.transcript = transcript
    far.tracker(cell, TranscribedDevice(serial, transcript, "tracker") if transcript is not None else serial)
    far.devices.append(serial)
    found: dict[str, Any] = {"cell": cell.name, "tracker": serial.path}
    if cell.single_axes:
        found["singles"] = far.singles(cell)
    if isinstance(cell.bus, ModbusBus) and cell.bus.line is not None:
        return {**found, **await _real_line(cell, cell.bus, far)}
    if isinstance(cell.bus, ModbusBus):
        addresses = {p.name: (LOCAL, 0) for p in cell.positioners}
        found["modbus"] = {name: list(at) for name, at in (await far.plcs(cell, addresses)).items()}
        return found
    several = len(cell.bus.channels) > 1
    paths = {}
    for number, channel in enumerate(cell.bus.channels):
        bus = UnixCanServer(folder / (f"can{number}.sock" if several else "can.sock"))
        await bus.open()
        name = f"can:{channel}" if several else "can"
        end = TranscribedStation(bus, transcript, name) if transcript is not None else bus
        far.drives(cell, end, shared_cpu=True, channel=channel if several else None)
        far.devices.append(bus)
        paths[channel] = str(bus.path)
    found["can"] = paths if several else paths[cell.bus.channel]
    beside = {name: list(at) for name, at in (await far.modbus_inputs(cell, LOCAL)).items()}
    if beside:
        found["modbus"] = beside
    return found


async def _real_line(cell: CellFile, bus: ModbusBus, far: FarEnd) -> dict[str, Any]:
    """The positioner PLCs on one pty, Modbus inputs at free loopback ports; their addresses."""
    line = PtySerial(far.loop, bus.baud, bits=character_bits(bus.framing))
    line.open()
    far.plc_line(cell, TranscribedDevice(line, far.transcript, LINE) if far.transcript is not None else line)
    far.devices.append(line)
    inputs = {name: list(at) for name, at in (await far.modbus_inputs(cell, LOCAL)).items()}
    return {"line": line.path, **({"modbus": inputs} if inputs else {})}
