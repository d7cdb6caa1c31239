"""The motion side of a cell: drivers on their wires, monitors, the tick. All that the motion process has to load."""

from __future__ import annotations

import asyncio
import math

from docking.assemble.wires import Addresses
from docking.config import CellFile, JobFile
from docking.config.cell import ModbusBus
from docking.motion import QueuedMotion, StreamedMotion
from docking.motion.channel import QueueChannel
from docking.motion.monitors import watch_from
from docking.motion.remote import LeaseSettings, RemoteMotion
from docking.motion.served import LocalMotion, ServedMotion, ServiceSettings
from docking.ports import CanLink
from drivers.canopen.positioners import CanopenPositioners
from drivers.modbus_positioners import ModbusPositioners


def local_motion(cell: CellFile, job: JobFile, can: CanLink | None, modbus: Addresses | None) -> LocalMotion:
    """What drives the axes, in the process that calls."""
    watch = watch_from(cell, job)
    if isinstance(cell.bus, ModbusBus):
        return QueuedMotion(ModbusPositioners(cell, modbus), watch, cell.bus.poll_s)
    if can is None:
        raise ValueError("a CANopen cell needs the near end of its bus")
    return StreamedMotion(CanopenPositioners(cell, can), watch, cell.limits.tick_late_cycles)


def service_settings(cell: CellFile) -> ServiceSettings:
    """What the motion side does for its cell. PLCs keep the time of a move themselves, but live on the heartbeat."""
    bus, limits, motion = cell.bus, cell.limits, cell.motion
    queued = isinstance(bus, ModbusBus)
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
