"""The cyclic image: set-points and the one controlword image out, read-backs in, a whole batch at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from docking.errors import AxisLimitExceeded
from docking.ports import CanFrame
from docking.types import Array, AxisState, FaultKind, Feedback, readonly
from drivers.canopen import cia402, codec
from drivers.canopen.cia402 import DriveState, Goal
from drivers.canopen.followers import ForceImage
from drivers.canopen.nodes import AxisNode
from drivers.canopen.watch import NodeWatch
from drivers.maps.objects import ObjectMap, PositionMode

_INT32_MAX = 2147483647.0
_FRAME = codec.SET_POINT.itemsize
_NEVER = -1_000_000
FORCE_PERIODS = 3
"""Periods of the load-cell frames after which a force that was not repeated is forgotten."""
NO_FORCE = -32768
"""The most negative count: the load cell's amplifier cannot measure."""
_NAN = float("nan")


class CyclicImage:
    """What is sent each cycle and what came back; the only owner of the controlwords.

    Driven axes have a set-point frame, those that hold a force a frame of their own (`forces`), passive axes only
    report. `driven` are the axes that hold a position, `powered` these and those that hold a force. Arrays are in the
    cell's axis order, (m,). `cycles` counts the SYNCs sent.
    """

    def __init__(self, nodes: tuple[AxisNode, ...], omap: ObjectMap, counts_per_mm: float, cycle_s: float) -> None:
        self.nodes = nodes
        self.forces = ForceImage(nodes, omap, cycle_s)
        self.driven: NDArray[np.intp] = np.array([n.index for n in nodes if n.driven], dtype=np.intp)
        self.powered = [*self.driven.tolist(), *self.forces.indices]
        self.cycles = 0
        self._map, self._counts_per_mm = omap, counts_per_mm
        self._follows = 1 << omap.status_bits["follows"]
        self._brake = 1 << omap.status_bits["brake_closed"]
        self._limit = 1 << omap.status_bits["at_limit"]
        self._start_output(omap)
        self._start_input()

    def _start_output(self, omap: ObjectMap) -> None:
        self._slots = {int(index): row for row, index in enumerate(self.driven)}
        self._image = np.zeros(len(self.driven), codec.SET_POINT)
        self._image["mode"] = omap.position_modes[0].mode
        self._enable_bits: NDArray[np.uint16] = np.zeros(len(self.driven), np.uint16)
        self._switching = False
        self._resting: set[int] = set()
        self._target = self._image["target"]
        cob = omap.pdos["set_points"].cob
        self.set_point_cobs = [*(cob + self.nodes[int(i)].node for i in self.driven), *self.forces.cobs]
        self._frames: list[CanFrame] = []
        self._force_frames: list[CanFrame] = []
        self._setpoint_bytes = b""
        self._dirty = True

    def _start_input(self) -> None:
        count = len(self.nodes)
        self._cobs = [self._map.pdos["read_back"].cob + node.node for node in self.nodes]
        self._index = {cob: index for index, cob in enumerate(self._cobs)}
        self._force_index = {self._map.pdos["force"].cob + n.node: n.index for n in self.nodes if n.load_cell}
        self._raw: list[bytes] = [bytes(codec.READ_BACK.itemsize)] * count
        self._gathered: dict[int, bytes] = {}
        self._gathered_cycle = _NEVER
        self._gathered_cobs = dict.fromkeys((node.channel for node in self.nodes), 0)
        self._joined: bytes | None = None
        self._head: list[CanFrame] | None = None
        self._decoded = b""
        self._seen = [_NEVER] * count
        self._force = np.full(count, np.nan)
        self._force_cycle = _NEVER
        self._force_seen = dict.fromkeys(self._force_index.values(), 0)
        self._force_lasts = FORCE_PERIODS * self._map.pdos["force"].transmission
        self._force_due = self._force_lasts
        self._words: list[int] = [0] * count
        self._states: tuple[DriveState, ...] = (DriveState.UNKNOWN,) * count
        self._axis_states: tuple[AxisState, ...] = (AxisState.UNKNOWN,) * count
        self._in_fault: tuple[int, ...] = ()
        self._at_limit: NDArray[np.bool_] | None = None
        self._enabled = np.zeros(len(self.driven), np.bool_)
        self._position = self._error = self._ages = self._fresh = readonly(np.zeros(count))
        self._counts: NDArray[np.int32] = np.zeros(count, np.int32)

    # what is sent ------------------------------------------------------------------------------------------------
    def command(self, index: int, controlword: int) -> None:
        """Set the controlword of one powered axis."""
        row = self._slots.get(index)
        if row is None:
            self.forces.command(index, controlword)
        elif int(self._image["controlword"][row]) != controlword:
            self._image["controlword"][row] = controlword
            self._dirty = True

    def choose(self, index: int, mode: PositionMode) -> None:
        """Set how one axis takes its set-points; nothing for one that holds no position."""
        row = self._slots.get(index)
        if row is not None:
            self._image["mode"][row], self._enable_bits[row] = mode.mode, mode.enable_bits
            (self._resting.add if mode.rests else self._resting.discard)(index)
            self._switching, self._dirty = bool(self._enable_bits.any()), True

    def command_all(self, controlword: int) -> None:
        """Set the controlword of every powered axis."""
        self._image["controlword"] = controlword
        self.forces.command_all(controlword)
        self._dirty = True

    def aim_mm(self, setpoint_mm: Array) -> None:
        """Take set-points (m,); passive entries are ignored.

        Raises AxisLimitExceeded where one is not finite or does not fit the drives' 32-bit counts.
        """
        given = setpoint_mm.tobytes()
        if given == self._setpoint_bytes:
            return
        counts = np.rint(setpoint_mm[self.driven] * self._counts_per_mm)
        if not (np.abs(counts).max() <= _INT32_MAX):
            bad = int(self.driven[int(np.argmax(~(np.abs(counts) <= _INT32_MAX)))])
            raise AxisLimitExceeded(
                self.nodes[bad].name,
                "the set-point is not a position that the drive can take",
                value=float(setpoint_mm[bad]),
                limit=_INT32_MAX / self._counts_per_mm,
            )
        self._target[:] = counts
        self._setpoint_bytes, self._dirty = given, True

    def aim_at_read_back(self) -> None:
        """Set the target of every axis that is not enabled to where it stands, to the count; the others keep theirs."""
        self._decode()
        counts = np.where(self._enabled, self._target, self._counts[self.driven])
        if (self._target != counts).any():
            self._target[:] = counts
            self._dirty = True
        self._setpoint_bytes = b""

    def first_step_mm(self) -> Array:
        """Distance (d,) from each driven axis' read-back to the set-point it is sent."""
        self._decode()
        result: Array = (self._target - self._counts[self.driven].astype(np.int64)) / self._counts_per_mm
        return result

    def frames(self) -> list[CanFrame]:
        """The frames of this cycle, SYNC last; the list is the caller's to extend only by copying."""
        if self.forces.indices:
            self._lead_forces()
        if self._dirty or self._switching:
            raw = (self._switched() if self._switching else self._image).tobytes()
            cobs = self.set_point_cobs[: len(self.driven)]
            cuts = range(0, len(raw), _FRAME)
            self._frames = [(cob, raw[i : i + _FRAME]) for cob, i in zip(cobs, cuts, strict=True)]
            self._frames += [*self._force_frames, codec.SYNC]
            self._dirty = False
        return self._frames

    def _switched(self) -> NDArray[np.void]:
        """The image with the bits that a mode wants of an axis once its drive is enabled: an edge that it can see."""
        self._decode()
        image = self._image.copy()
        on = self._enabled & (image["controlword"] == cia402.ENABLE_OPERATION)
        image["controlword"] |= np.where(on, self._enable_bits, 0).astype(np.uint16)
        return image

    def _lead_forces(self) -> None:
        """One cycle on for the axes that hold a force."""
        for index in self.forces.indices:
            self.forces.lead(index, self.force_n(index), self.follows(index))
        frames = self.forces.frames()
        if frames != self._force_frames:
            self._force_frames, self._dirty = frames, True

    def force_n(self, index: int) -> float:
        """What the load cell of one axis reads, N; NaN where that is not known."""
        self._forget_old_forces()
        return float(self._force[index])

    # what came back ----------------------------------------------------------------------------------------------
    def take_batch(self, batch: list[CanFrame]) -> Sequence[CanFrame]:
        """Take the read-backs out of a batch; return the frames that are something else."""
        count = len(self._cobs)
        head = batch[:count]
        # At rest all nodes say what they said a cycle ago: the same frames need not be taken apart again.
        if head == self._head or self._take_all(head):
            self._seen = [self.cycles] * count
            self._gathered.clear()
            if len(batch) == count:
                return ()
            batch = batch[count:]
        return [frame for frame in batch if not self._take(frame)]

    def _take_all(self, head: list[CanFrame]) -> bool:
        """Take one whole set of read-backs in the order of the axes; False when `head` is something else."""
        if [frame[0] for frame in head] != self._cobs:
            return False
        raw = [frame[1] for frame in head]
        if any(len(data) != codec.READ_BACK.itemsize for data in raw):
            return False
        self._raw, self._joined, self._head = raw, b"".join(raw), head
        return True

    def _take(self, frame: CanFrame) -> bool:
        cob, data = frame
        index = self._index.get(cob)
        if index is not None and len(data) == codec.READ_BACK.itemsize:
            self._gather(cob, data)
            return True
        index = self._force_index.get(cob)
        if index is not None and len(data) == 2:
            if self._force_cycle != self.cycles:
                # A new array a cycle: an earlier feedback keeps the one it was given.
                self._force, self._force_cycle = self._force.copy(), self.cycles
            counts = int.from_bytes(data, "little", signed=True)
            self._force[index] = _NAN if counts == NO_FORCE else counts * self._map.newton_per_count
            self._force_seen[index] = self.cycles
            return True
        return False

    def _gather(self, cob: int, data: bytes) -> None:
        """Keep a read-back until those of the same SYNC are here, or the next SYNC's begin.

        Positions of different instants would make a moving figure look strained. A set is as old as its first frame.
        What the host hears of a set only after the next SYNC comes in the order of its bus, lowest identifier first: a
        lower one than the last begins the next set, or sets that lost frames would stay mixed for ever.
        """
        index = self._index[cob]
        last, channel = self._gathered_cobs, self.nodes[index].channel
        syncs = self.cycles - self._gathered_cycle
        if self._gathered and (index in self._gathered or syncs > 1 or (syncs and cob < last[channel])):
            self._pass_on()
        if not self._gathered:
            self._gathered_cycle = self.cycles
            for each in last:
                last[each] = 0
        self._gathered[index], last[channel] = data, cob
        if len(self._gathered) == len(self._cobs):
            self._pass_on()

    def _pass_on(self) -> None:
        raw = list(self._raw)
        for index, data in self._gathered.items():
            raw[index] = data
            self._seen[index] = self._gathered_cycle
        self._raw, self._joined, self._head = raw, None, None
        self._gathered.clear()

    def seed(self, index: int, statusword: int, position_counts: int) -> None:
        """Start from values read by SDO, before the first read-back frame: the axis is to stay where it stands."""
        data = np.array([(statusword, position_counts, 0)], codec.READ_BACK).tobytes()
        self._raw = [*self._raw[:index], data, *self._raw[index + 1 :]]
        self._joined = self._head = None
        if index in self._slots:
            self._target[self._slots[index]] = position_counts
        if index in self.powered:
            # A dead controller may have left the axis under torque: the first controlword must not take it away.
            state, closed = cia402.decode(statusword), bool(statusword & self._brake)
            self.command(index, cia402.next_controlword(state, Goal.DISABLED, closed))
            self._dirty = True

    def state(self, index: int) -> DriveState:
        self._decode()
        return self._states[index]

    def word(self, index: int) -> int:
        """The statusword."""
        self._decode()
        return self._words[index]

    def position_mm(self, index: int) -> float:
        """Where the drive says that the axis stands."""
        self._decode()
        return float(self._position[index])

    def brake_closed(self, index: int) -> bool:
        self._decode()
        return bool(self._words[index] & self._brake)

    def follows(self, index: int) -> bool:
        """Enabled, brake open, and following its set-points; one that rests until an edge has nothing to follow."""
        enabled = self.state(index) is DriveState.OPERATION_ENABLED
        leads = index in self._resting or bool(self._words[index] & self._follows)
        return enabled and leads and not self._words[index] & self._brake

    def age_cycles(self, index: int) -> int:
        return self.cycles - self._seen[index]

    def lacks_force(self, index: int) -> bool:
        """True for an axis with a load cell whose force is not known, or was last heard too long ago."""
        self._forget_old_forces()
        return index in self._force_seen and bool(np.isnan(self._force[index]))

    def _forget_old_forces(self) -> None:
        """A force that nobody has repeated is no force: NaN."""
        if not (self.cycles > self._force_due):
            return
        old = [i for i, seen in self._force_seen.items() if self.cycles - seen > self._force_lasts]
        if not np.isnan(self._force[old]).all():
            self._force = self._force.copy()
            self._force[old] = np.nan
        fresh = [seen for i, seen in self._force_seen.items() if i not in old]
        self._force_due = min(fresh, default=self.cycles) + self._force_lasts

    def _decode(self) -> None:
        raw = self._joined if self._joined is not None else b"".join(self._raw)
        self._joined = raw
        if raw == self._decoded:
            return
        table = np.frombuffer(raw, codec.READ_BACK)
        self._counts = table["position"]
        self._position = self._counts / self._counts_per_mm
        self._error = table["following_error"] / self._counts_per_mm
        self._decoded = raw
        words: list[int] = table["statusword"].tolist()
        if words != self._words:
            self._words = words
            self._states = tuple(cia402.decode(word) for word in words)
            self._axis_states = tuple(cia402.AXIS_STATES[state] for state in self._states)
            self._in_fault = tuple(i for i, state in enumerate(self._axis_states) if state is AxisState.FAULT)
            limited = [bool(word & self._limit) for word in words]
            self._at_limit = np.array(limited) if any(limited) else None
            self._enabled = np.array([self._axis_states[i] is AxisState.ENABLED for i in self.driven])

    def feedback(self, t_s: float, watch: NodeWatch) -> Feedback:
        """The newest read-back; `t_s` is the time of the last SYNC, of which an axis of age 0 has answered."""
        self._decode()
        self._forget_old_forces()
        ages = self._fresh
        if min(self._seen) != self.cycles:
            ages = self.cycles - np.array(self._seen, dtype=np.float64)
        if watch.worst is None and not self._in_fault:
            fault, kind = None, FaultKind.DRIVE_FAULT
        else:
            fault, kind = watch.verdict(self._in_fault)
        return Feedback(
            t_s, self._position, self._error, self._force, self._axis_states, ages, _NAN, fault, self._at_limit, kind
        )
