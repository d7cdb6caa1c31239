"""DriveGroup: all CANopen nodes of one bus as one station on it, around the one plant."""

from __future__ import annotations

import asyncio
import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from docking.config.cell import CanBus, CellFile
from docking.errors import ConfigInvalid
from docking.types import Array
from sim.canopen.access import ObjectAccess
from sim.canopen.dictionary import INVALID, NEWTON_PER_PER_MILLE
from sim.canopen.drives import HOST_LOST, Drives
from sim.canopen.faults import DriveFaults
from sim.canopen.faulty_wire import FaultyWire
from sim.canopen.heartbeats import Heartbeats
from sim.canopen.node import PRE_OPERATIONAL, Node
from sim.canopen.parameters import BoolArray
from sim.canopen.plant_axes import PlantAxes
from sim.canopen.read_backs import ReadBacks, force_frames
from sim.canopen.settings import DriveSettings
from sim.wires.can_frames import CanEnd, CanFrame

_SYNC = 0x80
_RPDO: Final = np.dtype([("controlword", "<u2"), ("target", "<i4"), ("mode", "i1")])
_FORCE_RPDO: Final = np.dtype([("controlword", "<u2"), ("target", "<i2"), ("mode", "i1")])
_LONG_S: Final = 0.05
_SHORTEST_CYCLES: Final = 0.9
"""With `shared_cpu` no SYNC counts as less than this much of a cycle after the one before."""


class DriveGroup:
    """m drives in the cell's axis order. `start` powers them up; everything else happens by frames and timers.

    A read-back sampled at a SYNC carries the state before the set-points of that SYNC are applied.
    """

    def __init__(
        self, plant: PlantAxes, cell: CellFile, settings: DriveSettings, link: CanEnd, loop: asyncio.AbstractEventLoop
    ) -> None:
        if not isinstance(cell.bus, CanBus):
            raise ConfigInvalid(cell.name, (f"bus.kind is {cell.bus.kind!r}: no CAN drives to simulate",))
        self._plant, self._loop, self._settings = plant, loop, settings
        self._link = FaultyWire(link, loop)
        self._counts_per_mm = cell.bus.counts_per_mm
        self.axes = cell.axis_names
        self.faults = DriveFaults(self, self._link, self.axes, self._counts_per_mm)
        self.drives = Drives(plant.encoder_mm(), cell.bus.cycle_s, settings, self.emergency)
        self.drives.homing.on_zero = self.forget_read_backs
        numbers = [axis.node or 0 for p in cell.positioners for axis in p.axes]
        self.nodes = [Node(i, number, settings, self) for i, number in enumerate(numbers)]
        self._handlers: dict[int, tuple[Node, str]] = {}
        self._access = ObjectAccess(self.drives, plant, self._counts_per_mm, loop.time, self.faults.shown_mm)
        self._heartbeats = Heartbeats(self.nodes, loop, self._transmit, self._host_lost, self._host_returned)
        self.muted: set[int] = set()
        self._sync_s: float | None = None
        self._step_s = 0.0
        self._waiting = 0
        self._syncs = 0
        self._sync_timer: asyncio.TimerHandle | None = None
        self._coasting = False
        self._start_images()

    def _start_images(self) -> None:
        self._read_backs = ReadBacks(len(self.nodes), self._counts_per_mm, self.faults.shown_mm)
        self._error: Array = self._plant.following_error_mm()
        self._cached: list[CanFrame] | None = None
        self._pending, self._pending_forces = dict[int, bytes](), dict[int, bytes]()
        self._last_batch: list[CanFrame] | None = None
        self._last_joined = self._batch_joined = b""
        self._last_words = self._last_modes = b""
        self._relatch = False
        self.renumber()

    # life --------------------------------------------------------------------------------------------------------
    def start(self) -> None:
        """Power up: every node sends its boot-up message and is pre-operational."""
        self._link.on_frames = self._on_frames
        self._link.open()
        self._transmit([node.boot_up() for node in self.nodes])

    def heard_s(self) -> float:
        """When the controller's heartbeat came last; NaN before the first."""
        return self._heartbeats.heard_s

    def close(self) -> None:
        """Stop all timers."""
        self._heartbeats.close()
        if self._sync_timer is not None:
            self._sync_timer.cancel()
            self._sync_timer = None

    # faults that scenarios switch on -------------------------------------------------------------------------------
    def mute(self, axis: str, muted: bool = True) -> None:
        """Cut one node off: it neither hears nor speaks."""
        index = self.axes.index(axis)
        (self.muted.add if muted else self.muted.discard)(index)
        self.remap()

    def trip(self, axis: str, code: int, torque_lost: bool = False) -> None:
        """Let one drive fault with an emergency code."""
        self.drives.trip(self.axes.index(axis), code, self._loop.time(), torque_lost)
        self._cached = None

    def restart(self, axis: str) -> None:
        """Let one node reset by itself: torque off, boot-up, pre-operational, factory settings."""
        self.reset_node(self.nodes[self.axes.index(axis)])

    def now_s(self) -> float:
        """The drives' own clock."""
        return self._loop.time()

    def renumber(self) -> None:
        """Take the nodes' numbers over: who hears which identifier."""
        self._handlers = {cob: (node, kind) for node in self.nodes for cob, kind in node.listens()}
        self.remap()

    def forget_read_backs(self) -> None:
        """What the drives report has changed although nothing has moved."""
        self._cached = None
        self._read_backs.forget()

    # frames ------------------------------------------------------------------------------------------------------
    def _on_frames(self, batch: list[CanFrame]) -> None:
        # A simulated wire passes the sender's own list on: the very same one says what it said before.
        if batch is self._last_batch:
            self._sync(self._batch_joined)
            return
        cobs = self._fast_cobs
        if self._settings.shared_cpu and len(batch) > len(cobs):
            self._waiting = max(0, [frame[0] for frame in batch].count(_SYNC) - 1)
        if [frame[0] for frame in batch[: len(cobs)]] == cobs:
            joined = b"".join([frame[1] for frame in batch[: len(cobs)]])
            if len(joined) == len(self._fast_rows) * _RPDO.itemsize + len(self._force_rows) * _FORCE_RPDO.itemsize:
                self._last_batch, self._batch_joined = batch if len(batch) == len(cobs) else None, joined
                self._sync(joined)
                batch = batch[len(cobs) :]
        for cob, data in batch:
            if cob == _SYNC:
                self._sync(None)
            elif cob == 0:
                self._network_management(data)
            elif cob in self._watched:
                self._heartbeats.heard(cob - 0x700, self._able)
            else:
                self._to_node(cob, data)

    def _to_node(self, cob: int, data: bytes) -> None:
        found = self._handlers.get(cob)
        if found is None or found[0].index in self.muted:
            return
        node, kind = found
        if kind == "sdo":
            answer = node.server.answer(data) if node.answers_sdo else None
            if answer is not None:
                self._transmit([(0x580 + node.number, answer)])
        elif node.takes_set_points and len(data) == _RPDO.itemsize:
            self._pending[node.index] = data
        elif node.takes_forces and len(data) == _FORCE_RPDO.itemsize:
            self._pending_forces[node.index] = data

    def _network_management(self, data: bytes) -> None:
        if len(data) != 2:
            return
        command, number = data
        for node in self.nodes:
            if number in (0, node.number) and node.index not in self.muted:
                node.command(command)
        self.remap()

    def reset_node(self, node: Node) -> None:
        """NMT reset: torque off at once, everything back to the factory's values, boot-up."""
        self.drives.disable_voltage(node.index, self._loop.time())
        self._heartbeats.forget(node.index)
        self.drives.modes[node.index] = 0
        node.forget()
        self.remap()
        self._transmit([node.boot_up()])

    def _transmit(self, frames: list[CanFrame]) -> None:
        if self.muted:
            silent = {self.nodes[i].number for i in self.muted}
            frames = [frame for frame in frames if frame[0] & 0x7F not in silent]
        if frames:
            self._link.send(frames)

    def remap(self) -> None:
        """Work out who takes set-points and who reports, after NMT or PDO set-up has changed it."""
        able = self._able = [node for node in self.nodes if node.index not in self.muted]
        for node in self.nodes:
            node.refresh_host()
        takers = [node for node in able if node.takes_set_points]
        pressers = [node for node in able if node.takes_forces]
        self._fast_cobs = [*(0x200 + node.number for node in takers + pressers), _SYNC]
        self._force_rows = [node.index for node in pressers]
        self._fast_rows: NDArray[np.intp] = np.array([node.index for node in takers], dtype=np.intp)
        self._reporting = [(0x180 + node.number, node.index) for node in able if node.reports]
        weighing = [node for node in able if node.reports_force]
        self._force_cobs = [0x280 + node.number for node in weighing]
        self._force_index: NDArray[np.intp] = np.array([node.index for node in weighing], dtype=np.intp)
        self._watched = {0x700 + node.host for node in self.nodes if node.host}
        self._cached, self._relatch, self._last_joined, self._last_batch = None, True, b"", None

    # SYNC --------------------------------------------------------------------------------------------------------
    def _sync(self, joined: bytes | None) -> None:
        """One SYNC: bring the plant to now, report what is, then take the new set-points."""
        now_s = self._sync_time_s()
        self._advance(now_s)
        self._report()
        if self.drives.busy:
            self._relatch = True
        if joined is not None:
            self._latch_all(joined, now_s)
        elif self._pending or self._pending_forces:
            self._latch_each(now_s)
        else:
            self.drives.stay()
        self._sync_s = self._step_s = now_s
        if self._sync_timer is None or self._coasting:
            self._coasting = False
            self._arm_sync_monitor(now_s)

    def _sync_time_s(self) -> float:
        """When this SYNC came; several that waited until this process got the CPU came a cycle apart."""
        now_s = self._loop.time()
        if not self._settings.shared_cpu or self._sync_s is None:
            return now_s
        cycle_s = self.drives.cycle_s
        came_s = now_s - self._waiting * cycle_s
        self._waiting = max(0, self._waiting - 1)
        return max(came_s, self._sync_s + _SHORTEST_CYCLES * cycle_s, self._step_s)

    def at(self, t_s: float) -> tuple[Array, BoolArray, BoolArray]:
        """Set-points, torque and brakes (m,) at `t_s`: for a plant that drives on another bus bring on."""
        drives, t_s = self.drives, max(t_s, self._step_s)
        set_point = drives.advance(t_s, t_s - (self._sync_s or 0.0), t_s - self._step_s, self._plant.encoder_mm)
        self._step_s, self._cached = t_s, None
        return set_point, drives.powered, drives.braked

    def _advance(self, now_s: float) -> None:
        plant, drives = self._plant, self.drives
        since_s = now_s - (self._sync_s or 0.0)
        set_point = drives.advance(now_s, since_s, now_s - self._step_s, plant.encoder_mm)
        self._press()
        plant.step(now_s, set_point, drives.powered, drives.braked)
        if not plant.at_rest():
            self._error = plant.following_error_mm()
            drives.monitor(now_s, self._error)
            self._cached = None

    def _press(self) -> None:
        """Pass on what the axes exert that hold a force."""
        if self.drives.forces.changed:
            self._plant.press(self.drives.forces.exerted_n(), self.drives.parameters.max_speed_mm_s)

    def _report(self) -> None:
        """Send the read-backs; the same bytes again while nothing moves."""
        frames = self._cached
        if frames is None or self.drives.changed:
            words, encoder = self.drives.statuswords, self._plant.encoder_mm()
            frames = self._cached = self._read_backs.frames(self._reporting, encoder, self._error, words)
            self.drives.changed = False
        if self._syncs % 10 == 0 and self._force_cobs:
            frames = frames + force_frames(self._force_cobs, self._plant.force_n()[self._force_index])
        self._syncs += 1
        if frames:
            self._link.send(frames)

    def _latch_all(self, joined: bytes, now_s: float) -> None:
        """The set-points of all drives at once."""
        if joined == self._last_joined and not self._relatch:
            self.drives.stay()
            return
        count = len(self._fast_rows)
        image = np.frombuffer(joined, _RPDO, count)
        if self._force_rows:
            forces = np.frombuffer(joined, _FORCE_RPDO, offset=count * _RPDO.itemsize)
            self._latch_forces(self._force_rows, forces, now_s)
        words, modes = image["controlword"].tobytes(), image["mode"].tobytes()
        target_mm = image["target"] / self._counts_per_mm
        self.drives.note_targets(self._fast_rows, target_mm)
        if words != self._last_words or modes != self._last_modes or self._relatch:
            self._obey(self._fast_rows.tolist(), image, now_s)
            self._last_words, self._last_modes = words, modes
        self.drives.latch(self._fast_rows, target_mm)
        self._last_joined, self._relatch = joined, self.drives.busy
        self._pending.clear()
        self._pending_forces.clear()

    def _latch_forces(self, rows: list[int], image: NDArray[np.void], now_s: float) -> None:
        for index, target in zip(rows, image["target"].tolist(), strict=True):
            self.drives.forces.aim(index, target * NEWTON_PER_PER_MILLE)
        self._obey(rows, image, now_s)

    def _obey(self, rows: list[int], image: NDArray[np.void], now_s: float) -> None:
        """Modes and controlwords of the axes `rows`."""
        for index, word, mode in zip(rows, image["controlword"].tolist(), image["mode"].tolist(), strict=True):
            self.drives.select(index, mode)
            self.drives.control(index, word, now_s)

    def _latch_each(self, now_s: float) -> None:
        """The set-points of those drives that got one since the last SYNC."""
        if self._pending_forces:
            forces = np.frombuffer(b"".join(self._pending_forces.values()), _FORCE_RPDO)
            self._latch_forces(list(self._pending_forces), forces, now_s)
            self._pending_forces.clear()
        if not self._pending:
            self.drives.stay()
            return
        rows = np.array(list(self._pending), dtype=np.intp)
        image = np.frombuffer(b"".join(self._pending.values()), _RPDO)
        target_mm = image["target"] / self._counts_per_mm
        self.drives.note_targets(rows, target_mm)
        self._obey(rows.tolist(), image, now_s)
        self.drives.latch(rows, target_mm)
        self._pending.clear()
        self._last_joined = b""

    # without SYNC ------------------------------------------------------------------------------------------------
    def _arm_sync_monitor(self, base_s: float) -> None:
        if self._sync_timer is not None:
            self._sync_timer.cancel()
        due_s = base_s + self._settings.sync_loss_cycles * self.drives.cycle_s
        self._sync_timer = self._loop.call_at(due_s, self._check_sync)

    def _check_sync(self) -> None:
        """Runs a few cycles after some SYNC: either newer ones came meanwhile, or the drives are on their own."""
        self._sync_timer = None
        now_s, last_s = self._loop.time(), self._sync_s or 0.0
        if now_s - last_s < (self._settings.sync_loss_cycles - 0.5) * self.drives.cycle_s:
            self._arm_sync_monitor(last_s)
            return
        if not self._coasting:
            self._coasting = True
            reached_s = max(self._step_s, last_s + self.drives.cycle_s)
            self._advance(reached_s)
            self._step_s = reached_s
            self.drives.lose_sync(now_s)
        self._coast(now_s)

    def _coast(self, now_s: float) -> None:
        """One step of the drives on their own; again every cycle while something moves, seldom otherwise."""
        plant, drives = self._plant, self.drives
        now_s = max(now_s, self._step_s)
        set_point = drives.coast(now_s, now_s - self._step_s, plant.encoder_mm)
        self._press()
        plant.step(now_s, set_point, drives.powered, drives.braked)
        self._step_s = now_s
        self._cached, self._error = None, plant.following_error_mm()
        if not plant.at_rest():
            drives.monitor(now_s, self._error)
        quiet = plant.at_rest() and not drives.busy
        self._sync_timer = self._loop.call_at(now_s + (_LONG_S if quiet else drives.cycle_s), self._check_sync)

    # the controller's heartbeat ------------------------------------------------------------------------------------
    def _host_lost(self, node: Node) -> None:
        """React as 6007h and 1029h say."""
        now_s = self._loop.time()
        self.emergency(node.index, HOST_LOST)
        option = node.number_of(0x6007)
        if option == 1:
            self.drives.trip(node.index, HOST_LOST, now_s)
        elif option == 2:
            self.drives.disable_voltage(node.index, now_s)
        elif option == 3:
            self.drives.quick_stop(node.index, now_s)
        if node.number_of(0x1029, 1) == 0:
            node.state = PRE_OPERATIONAL
            self.remap()

    def _host_returned(self, node: Node) -> None:
        self.emergency(node.index, 0)

    def emergency(self, index: int, code: int) -> None:
        """Send an emergency message of one node; code 0 tells that its errors are gone."""
        node = self.nodes[index]
        if not node.number_of(0x1014) & INVALID:
            register = 0 if code == 0 else 0x11 if code >> 12 == 8 else 0x01
            self._transmit([(node.number_of(0x1014) & 0x7FF, struct.pack("<HB5x", code, register))])

    # object dictionary -------------------------------------------------------------------------------------------
    def live(self, index: int, obj: int, sub: int) -> int | None:
        """Present value of an object that changes by itself, None for a stored one."""
        return self._access.live(index, obj, sub)

    def changed(self, index: int, obj: int, sub: int, value: int) -> None:
        """A master has written an object: pass it on to the power stage or the heartbeats."""
        if obj == 0x1017:
            self._heartbeats.produce(self.nodes[index], value * 1e-3)
        elif obj == 0x1016:
            self.remap()
        else:
            self._access.changed(index, obj, sub, value)
