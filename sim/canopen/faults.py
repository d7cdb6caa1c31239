"""Faults of the drives of a cell, switched on by scenarios while it runs. Mechanical ones are the plant's."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

import numpy as np

from docking.types import Array
from sim.canopen.drives import SYNC_LOST
from sim.canopen.faulty_wire import FaultyWire

if TYPE_CHECKING:
    from sim.canopen.group import DriveGroup

PRE_OPERATIONAL_COMMAND = 0x80
_SET_POINT = struct.Struct("<Hib")


class DriveFaults:
    """Everything by axis name; unknown names raise ValueError. `wire` is the fault layer between drives and bus."""

    def __init__(self, group: DriveGroup, wire: FaultyWire, axes: tuple[str, ...], counts_per_mm: float) -> None:
        self._group, self.wire, self._axes, self._counts_per_mm = group, wire, axes, counts_per_mm
        self._offset_mm: Array = np.zeros(len(axes))
        self._sign: Array = np.ones(len(axes))
        self._misread = False

    def shown_mm(self, encoder_mm: Array) -> Array:
        """What the drives report of the encoders' positions (m,)."""
        encoder_mm = self._group.drives.homing.shown_mm(encoder_mm)
        return self._sign * encoder_mm + self._offset_mm if self._misread else encoder_mm

    # the network ---------------------------------------------------------------------------------------------------
    def lose_read_back(self, axis: str, cycles: float = math.inf) -> None:
        """The read-backs of one axis do not arrive."""
        self.wire.lose(0x180 + self._number(axis), cycles)

    def lose_set_points(self, axis: str, cycles: float = math.inf) -> None:
        """The set-points and the controlword of one axis do not arrive."""
        self.wire.lose(0x200 + self._number(axis), cycles)

    def lose_forces(self, axis: str, frames: float = math.inf) -> None:
        """The load-cell frames of one axis do not arrive."""
        self.wire.lose(0x280 + self._number(axis), frames)

    def lose_heartbeat(self, axis: str, beats: float = math.inf) -> None:
        """The node's own heartbeats do not arrive; everything else does."""
        self.wire.lose(0x700 + self._number(axis), beats)

    def lose_sync(self, cycles: float = math.inf) -> None:
        """SYNC does not arrive at any drive; set-points do."""
        self.wire.lose(0x080, cycles)

    def twin(self, axis: str) -> None:
        """A second device with the same node number answers every SDO request, too."""
        self.wire.double(0x580 + self._number(axis))

    def swap(self, axis: str, other: str) -> None:
        """Two drives have each other's node number, as after a wrong replacement."""
        first, second = (self._group.nodes[self._axes.index(name)] for name in (axis, other))
        first.number, second.number = second.number, first.number
        self._group.renumber()

    def leave_operational(self, axis: str) -> None:
        """A node becomes pre-operational: it takes no set-points and sends no read-backs, its heartbeat says so."""
        self._group.nodes[self._axes.index(axis)].command(PRE_OPERATIONAL_COMMAND)
        self._group.remap()

    def forge_set_point(self, axis: str, position_mm: float, controlword: int = 0x0F) -> None:
        """Somebody else sends this axis a set-point on the identifier that belongs to the controller."""
        counts = round(position_mm * self._counts_per_mm)
        self.wire.forge(0x200 + self._number(axis), _SET_POINT.pack(controlword, counts, 8))

    # the drives ----------------------------------------------------------------------------------------------------
    def warn(self, axis: str, code: int) -> None:
        """A drive sends an emergency message and goes on."""
        self._group.emergency(self._axes.index(axis), code)

    def stop_alone(self, axis: str, code: int = SYNC_LOST) -> None:
        """One drive stops by itself on its quick-stop ramp and says why: its own SYNC watch, its own limit."""
        index = self._axes.index(axis)
        self._group.emergency(index, code)
        self._group.drives.stop_by_itself(index, self._group.now_s())

    def limit_switch(self, axis: str, on: bool = True, *, stops: bool = False) -> None:
        """A limit switch trips; with `stops` the drive stops its own axis."""
        index = self._axes.index(axis)
        self._group.drives.limit_switch(index, on)
        if stops:
            self._group.drives.stop_by_itself(index, self._group.now_s())

    def disable_voltage(self, axis: str) -> None:
        """One power stage goes off without a word: no torque, no emergency message."""
        self._group.drives.disable_voltage(self._axes.index(axis), self._group.now_s())

    def seize_brake(self, axis: str, closed: bool | None) -> None:
        """The brake ends up closed or open whatever it is told, from its next order on; None heals it."""
        self._group.drives.seize_brake(self._axes.index(axis), closed)

    def misread(self, axis: str, offset_mm: float = 0.0, sign: float = 1.0) -> None:
        """The drive reports sign * position + offset; its own servo goes on with the true position."""
        index = self._axes.index(axis)
        self._offset_mm[index], self._sign[index] = offset_mm, sign
        self._misread = bool(self._offset_mm.any() or (self._sign != 1.0).any())
        self._group.forget_read_backs()

    def refuse_write(self, axis: str, obj: int, sub: int = 0, abort_code: int = 0x0609_0030) -> None:
        """The drive aborts every write of one object."""
        self._group.nodes[self._axes.index(axis)].dictionary.refused[obj, sub] = abort_code

    def ignore_write(self, axis: str, obj: int, sub: int = 0) -> None:
        """The drive accepts every write of one object and keeps its value: the read-back differs."""
        self._group.nodes[self._axes.index(axis)].dictionary.deaf.add((obj, sub))

    def lie(self, axis: str, obj: int, value: int, sub: int = 0) -> None:
        """The drive answers reads of one object with this value, whatever it holds."""
        self._group.nodes[self._axes.index(axis)].dictionary.lies[obj, sub] = value

    def _number(self, axis: str) -> int:
        return self._group.nodes[self._axes.index(axis)].number
