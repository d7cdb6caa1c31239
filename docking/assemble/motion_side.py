"""The motion side of a cell: drivers on their wires, monitors, the tick. All that the motion process has to load."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from functools import partial

from docking.assemble.wires import Addresses, NearBus
from docking.config import CellFile, JobFile
from docking.config.cell import ModbusBus
from docking.config.inputs import InputsConfig, ModbusModule
from docking.errors import ConfigInvalid, DockingError
from docking.motion import QueuedMotion, StreamedMotion
from docking.motion.arbiter import Mode
from docking.motion.channel import QueueChannel
from docking.motion.guarded import GuardedMotion, InputRules
from docking.motion.monitors import watch_from
from docking.motion.remote import LeaseSettings, RemoteMotion
from docking.motion.served import LocalMotion, ServedMotion, ServiceSettings
from docking.motion.triggers import Finding, Trigger
from docking.ports import LoadCells
from docking.transcript import Transcript
from drivers.canopen.io_module import CanIoModule
from drivers.canopen.positioners import CanopenPositioners
from drivers.canopen.profile_positioners import ProfilePositioners
from drivers.canopen.shared import SharedCan
from drivers.inputs import SILENT_AFTER, InputModule, WiredInputs
from drivers.load_cells import AnalogueLoadCells
from drivers.maps.objects import load_object_map
from drivers.modbus_client import Tap
from drivers.modbus_inputs import ModbusIoModule
from drivers.modbus_positioners import ModbusPositioners
from drivers.weighed_axes import WeighedControllers, WeighedDrives


def local_motion(cell: CellFile, job: JobFile, near: NearBus, transcript: Transcript | None = None) -> LocalMotion:
    """What drives the axes and reads the inputs, in the process that calls; `transcript` gets all bytes."""
    inputs, near = cell.inputs, near.transcribed(transcript)
    tap = transcript.modbus if transcript is not None else None
    if inputs is None:
        return _axes(cell, job, near, tap)
    shared = SharedCan(near.can) if near.can is not None else None
    axes = replace(near, can=shared.end()) if shared is not None else near
    modules = input_modules(inputs, shared, near.modbus, tap)
    weighing = {name: modules.pop(name) for name in sorted(inputs.weighing)}
    cells = AnalogueLoadCells(cell, weighing) if weighing else None
    motion = _axes(cell, job, axes, tap, cells)
    if cells is not None:
        cells.on_fault = partial(_force_missing, motion)
    return GuardedMotion(motion, WiredInputs(inputs, modules), input_rules(inputs))


def _force_missing(motion: LocalMotion, error: DockingError) -> None:
    """A cell that shows nothing stops a move with its own reason; before one, the monitors let none begin."""
    if motion.arbiter.mode is not Mode.OFF:
        motion.report(Finding(Trigger.FORCE_MISSING, error))


def _axes(cell: CellFile, job: JobFile, near: NearBus, tap: Tap | None, cells: LoadCells | None = None) -> LocalMotion:
    watch = watch_from(cell, job)
    if isinstance(cell.bus, ModbusBus):
        wires = near.modbus, tap, near.line
        positioners = ModbusPositioners(cell, *wires) if cells is None else WeighedControllers(cell, *wires, cells)
        return QueuedMotion(positioners, watch, cell.bus.poll_s)
    if near.can is None:
        raise ValueError("a CANopen cell needs the near end of its bus")
    if cell.bus.profile_position:
        if cells is not None:
            raise ConfigInvalid(cell.name, ("bus.profile_position: not together with wired load cells",))
        return QueuedMotion(ProfilePositioners(cell, near.can), watch, cell.bus.cycle_s)
    drives = CanopenPositioners(cell, near.can) if cells is None else WeighedDrives(cell, near.can, cells)
    return StreamedMotion(drives, watch, cell.limits.tick_late_cycles)


def input_modules(
    inputs: InputsConfig, shared: SharedCan | None, modbus: Addresses | None, tap: Tap | None = None
) -> dict[str, InputModule]:
    """The drivers of the modules, by name; CANopen ones on the bus that `shared` deals out."""
    modules: dict[str, InputModule] = {}
    words = load_object_map("cia402").abort_text
    for module in inputs.modules:
        if isinstance(module, ModbusModule):
            modules[module.name] = ModbusIoModule(module, (modbus or {}).get(module.name), tap)
        elif shared is not None:
            end = shared.end(CanIoModule.cobs(module))
            modules[module.name] = CanIoModule(module, end, words)
    return modules


def input_rules(inputs: InputsConfig) -> InputRules:
    """What the motion side does about each input."""
    of_axes = {
        use: {item.name: item.axis for item in inputs.digital if item.use == use and item.axis is not None}
        for use in ("limit-switch", "brake-closed")
    }
    return InputRules(
        emergency=inputs.names("emergency-stop"),
        protective=inputs.names("protective-stop"),
        silent_s={
            m.name: SILENT_AFTER * (m.poll_s if isinstance(m, ModbusModule) else m.refresh_s)
            for m in inputs.modules
            if m.name not in inputs.weighing
        },
        limits=of_axes["limit-switch"],
        brakes=of_axes["brake-closed"],
    )


def service_settings(cell: CellFile) -> ServiceSettings:
    """What the motion side does for its cell. PLCs keep the time of a move themselves, but live on the heartbeat."""
    bus, limits, motion = cell.bus, cell.limits, cell.motion
    queued = bus.queued
    return ServiceSettings(
        lease_s=motion.lease_s,
        feedback_s=motion.feedback_s,
        sync_error_mm=math.inf if queued else limits.sync_error_mm,
        late_limit_s=0.5 * bus.watchdog_s if isinstance(bus, ModbusBus) else limits.tick_late_cycles * bus.cycle_s,
    )


def lease_settings(cell: CellFile) -> LeaseSettings:
    """What the cell owes its motion side."""
    return LeaseSettings(cell.motion.lease_s, cell.motion.feedback_s)


def motion_beside(cell: CellFile, motion: LocalMotion) -> RemoteMotion:
    """A motion side on the loop of the cell itself, behind the same messages: what virtual time runs on."""
    near, far = QueueChannel.pair(asyncio.get_running_loop())
    remote = RemoteMotion(near, motion.axes, lease_settings(cell))
    ServedMotion(motion, far, service_settings(cell))
    return remote
