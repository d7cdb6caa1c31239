"""Every fault that the simulated devices of a cell can have, by device and name: what scenarios choose from.

A device lists what it can do: drives and I/O modules their hooks, serial devices every field of their `faults`, the
plant what axes and parts may do, the inputs what a person or a sensor may do.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import UnionType
from typing import Any, get_args

from docking.config import CellFile
from docking.config.cell import CanBus
from sim.canopen.group import DriveGroup
from sim.canopen.io_module import IoModule
from sim.input_world import InputWorld
from sim.plant import Plant
from sim.plc.group import PlcGroup
from sim.plc.io_module import IoServer
from sim.plc.reply_faults import KINDS, ReplyFaults

Values = dict[str, Any]
LOST_FRAMES = ("lose_read_back", "lose_set_points", "lose_forces", "lose_heartbeat")
ONCE = (
    "twin",
    "swap",
    "leave_operational",
    "forge_set_point",
    "warn",
    "stop_alone",
    "disable_voltage",
    "refuse_write",
    "ignore_write",
    "lie",
)
"""Faults of a drive that nothing takes back."""


@dataclass(frozen=True)
class Fault:
    """`begin(**values)` lets it happen, `end()` takes it back; None where nothing does."""

    begin: Callable[..., None]
    end: Callable[[], None] | None = None

    def complaint(self, values: Values) -> str:
        """Why these values cannot be given; empty where they can."""
        taken = inspect.signature(self.begin, eval_str=True).parameters
        unknown = [name for name in values if name not in taken]
        if unknown:
            return f"{unknown[0]!r} is not a value of it; it takes {', '.join(taken) or 'none'}"
        needed = [n for n, p in taken.items() if p.default is inspect.Parameter.empty and n not in values]
        if needed:
            return f"it needs the value {needed[0]}"
        for name, value in values.items():
            if not _fits(value, taken[name].annotation):
                return f"{name} = {value!r} is of the wrong type"
        return ""


class FaultBook:
    """Faults by device and name, of the devices that are there."""

    def __init__(self, cell: CellFile, plant: Plant, world: InputWorld, devices: list[Any]) -> None:
        self.devices: dict[str, dict[str, Fault]] = {}
        self._plant(cell, plant)
        for device in devices:
            if isinstance(device, DriveGroup):
                self._drives(cell, device)
            elif isinstance(device, PlcGroup):
                self._plcs(cell, device)
            elif isinstance(device, IoModule):
                self._add(device.name, "restart", Fault(device.restart))
            elif isinstance(device, IoServer):
                self._module(device)
            elif dataclasses.is_dataclass(getattr(device, "faults", None)):
                self._fields(getattr(device, "kind", "tracker"), device.faults)
        self._inputs(cell, world)

    def line(self, device: str, unplug: Callable[[], None], replug: Callable[[], None]) -> None:
        """A serial line whose cable can be pulled."""
        self._add(device, "unplug", Fault(unplug, replug))

    def _add(self, device: str, name: str, fault: Fault) -> None:
        self.devices.setdefault(device, {})[name] = fault

    # the plant ---------------------------------------------------------------------------------------------------
    def _plant(self, cell: CellFile, plant: Plant) -> None:
        for axis, driven in zip(cell.axis_names, cell.driven, strict=True):
            free = partial(plant.release, axis)
            self._add(axis, "stuck", Fault(partial(plant.jam, axis), free))
            self._add(axis, "misread_force", _healed(partial(plant.misread_force, axis), offset_n=0.0))
            if driven:
                self._add(axis, "creep", Fault(partial(plant.creep, axis), free))
                self._add(axis, "weaken", Fault(partial(plant.weaken, axis)))
                self._add(axis, "slip", _healed(partial(plant.slip, axis), by_mm=0.0))
                self._add(axis, "displace", Fault(partial(plant.displace, axis)))
            else:
                self._add(axis, "lose_ball", Fault(partial(plant.lose_ball, axis)))
        for part in ("component", "mate"):
            self._add(part, "heat", Fault(partial(plant.heat, part)))

    # drives ------------------------------------------------------------------------------------------------------
    def _drives(self, cell: CellFile, group: DriveGroup) -> None:
        faults, bus = group.faults, _bus_name(cell, group)
        for axis in group.axes:
            for name in LOST_FRAMES:
                method = getattr(faults, name)
                self._add(axis, name, Fault(partial(method, axis), partial(method, axis, 0)))
            for name in ONCE:
                self._add(axis, name, Fault(partial(getattr(faults, name), axis)))
            off = partial(faults.limit_switch, axis, False)
            self._add(axis, "limit_switch", Fault(partial(_on, faults.limit_switch, axis), off))
            self._add(axis, "seize_brake", _healed(partial(faults.seize_brake, axis), closed=None))
            self._add(axis, "misread", _healed(partial(faults.misread, axis), offset_mm=0.0, sign=1.0))
            self._add(axis, "silent", Fault(partial(group.mute, axis, True), partial(group.mute, axis, False)))
            self._add(axis, "trip", Fault(partial(group.trip, axis)))
            self._add(axis, "restart", Fault(partial(group.restart, axis)))
        wire = faults.wire
        self._add(bus, "lose_sync", Fault(faults.lose_sync, partial(faults.lose_sync, 0)))
        self._add(bus, "silent", Fault(partial(wire.silence, True), partial(wire.silence, False)))
        self._add(bus, "delay", Fault(partial(_late, wire.delay), partial(wire.delay, None)))

    def _plcs(self, cell: CellFile, group: PlcGroup) -> None:
        for station in cell.positioners:
            self._add(station.name, "drop_connections", Fault(partial(group.drop_connections, station.name)))
            self._replies(station.name, group.faults[station.name])
        for axis in cell.axis_names:
            pressed, repair = partial(group.press_limit, axis), partial(group.repair_drive, axis)
            self._add(axis, "limit_switch", Fault(partial(_plain, pressed), partial(pressed, False)))
            self._add(axis, "fail_drive", Fault(partial(group.fail_drive, axis), repair))

    def _replies(self, device: str, faults: ReplyFaults) -> None:
        for name in KINDS:
            self._add(device, name, Fault(getattr(faults, name), partial(faults.heal, name)))

    # inputs and serial devices -----------------------------------------------------------------------------------
    def _module(self, server: IoServer) -> None:
        registers = server.registers
        self._add(registers.name, "drop_connections", Fault(server.drop_connections))
        self._replies(registers.name, server.faults)
        stuck = partial(setattr, registers, "stuck")
        self._add(registers.name, "frozen", Fault(partial(stuck, True), partial(stuck, False)))

    def _inputs(self, cell: CellFile, world: InputWorld) -> None:
        inputs = cell.inputs
        if inputs is None:
            return
        for item in inputs.digital:
            give, drop = partial(world.hold, item.name, True), partial(world.hold, item.name, False)
            self._add(item.name, "drop", Fault(drop, give))
            self._add(item.name, "press", Fault(give, drop))
        for sensor in inputs.temperatures:
            broken = partial(world.break_sensor, sensor.name)
            self._add(sensor.name, "broken", Fault(partial(_plain, broken), partial(broken, False)))
            self._add(sensor.name, "misread", _healed(partial(world.misread, sensor.name), by_k=0.0))
        for force in inputs.forces:
            torn = partial(world.break_sensor, force.name)
            self._add(force.name, "broken", Fault(partial(_plain, torn), partial(torn, False)))
            stray = partial(world.force_current, force.name)
            self._add(force.name, "current", Fault(stray, partial(world.free_current, force.name)))
        for module in inputs.modules:
            mute = partial(world.mute, module.name)
            self._add(module.name, "silent", Fault(partial(_plain, mute), partial(mute, False)))

    def _fields(self, device: str, faults: Any) -> None:
        """Every field of a device's `faults` is a fault; the value is true where none is given."""
        for field in dataclasses.fields(faults):
            before = getattr(faults, field.name)
            end = partial(setattr, faults, field.name, before)
            self._add(device, field.name, Fault(partial(_set, faults, field.name), end))


def _healed(begin: Callable[..., None], **healthy: Any) -> Fault:
    """A fault that is taken back by these values."""
    return Fault(begin, partial(begin, **healthy))


def _plain(act: Callable[[], None]) -> None:
    act()


def _bus_name(cell: CellFile, group: DriveGroup) -> str:
    """`bus`; with several of them `bus:CHANNEL`."""
    station = next(p for p in cell.positioners if f"{p.name}.{p.axes[0].name}" in group.axes)
    bus = cell.bus
    if not isinstance(bus, CanBus) or not bus.further_channels:
        return "bus"
    return f"bus:{station.can_channel or bus.channel}"


def _on(limit_switch: Callable[..., None], axis: str, stops: bool = False) -> None:
    limit_switch(axis, True, stops=stops)


def _late(delay: Callable[[Callable[[], float]], None], late_s: float) -> None:
    delay(lambda: late_s)


def _set(faults: Any, name: str, value: Any = True) -> None:
    """Set one field; a list stands for the set or tuple that the field is, a table for its mapping."""
    before = getattr(faults, name)
    setattr(faults, name, type(before)(value) if isinstance(before, set | tuple | dict) else value)


def _fits(value: Any, annotation: Any) -> bool:
    kinds = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    if annotation is Any or annotation is inspect.Parameter.empty:
        return True
    if isinstance(value, bool):
        return bool in kinds
    if isinstance(value, int):
        return int in kinds or float in kinds
    return any(isinstance(kind, type) and isinstance(value, kind) for kind in kinds)
