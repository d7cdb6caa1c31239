"""ProfilePositioners: drives that can only go to a target by their own ramps, kept in step by proportion.

A plan is cut into straight pieces from rest to rest (`docking.planning.profile`). For each, speed, acceleration and
deceleration of every axis are written in the proportion of the ways and read back; then one SYNC carries the starting
edge to all of them. Where the axes are on the path is taken from their read-backs.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from docking.config.cell import CellFile
from docking.errors import AxisStuck, EnableFailed, OutcomeUnknown, ReadBackMismatch
from docking.planning.profile import ProfileLimits, ProfilePiece, profile_pieces
from docking.ports import CanLink
from docking.types import Array, Feedback, Plan
from drivers.canopen import cia402
from drivers.canopen.bring_up import NodeBringUp
from drivers.canopen.cia402 import DriveState
from drivers.canopen.positioners import CanopenPositioners

NEW_SET_POINT, HALT = 1 << 4, 1 << 8
_ACKNOWLEDGED, _REACHED = 1 << 12, 1 << 10
HANDSHAKE_S = 0.1
THERE_MM = 0.005
LATE_S = 1.0
"""By which a piece may outlast its profile."""
ROUNDING = 0.05
"""Part by which a drive may round what it is told, where that is more than a count."""
BRAKE_AFTER = 5
"""Read-backs at rest after a quick stop before the brakes close."""


class ProfilePositioners(CanopenPositioners):
    """The `QueuedPositioners` port over CiA 402 drives in profile position."""

    def __init__(self, cell: CellFile, link: CanLink) -> None:
        super().__init__(cell, link)
        self.on_lost: Callable[[], None] = lambda: None
        self.segment_s: float = self.cycle_s
        self.ramp_s: float = self._bus.ramp_s
        self._rows = self._image.driven
        self._driven_setups = [setup for setup in self._setups if setup.node.driven]
        self._profile = ProfileLimits(
            chord_mm=0.5 * cell.limits.chord_error_mm,
            ramp_s=self._bus.ramp_s,
            skew_s=self._bus.start_skew_s,
            counts_per_mm=self._bus.counts_per_mm,
            residual_mm=cell.limits.ball_residual_mm,
        )
        self._quick_s, self._rate = 0.1, 1.0
        self._plan: Plan | None = None
        self._pieces: tuple[ProfilePiece, ...] = ()
        self._at = 0
        self._going = self._told_quick_stop = False
        self._due_s = self._path_time_s = 0.0
        self._standing = 0
        self._last_mm: Array | None = None

    # the port ----------------------------------------------------------------------------------------------------
    @property
    def quick_ramp_s(self) -> float:
        return self._quick_s

    @property
    def braked(self) -> bool:
        return all(self._image.brake_closed(int(i)) for i in self._rows)

    async def enable(self) -> Feedback:
        feedback = await super().enable()
        self._live, self._plan, self._path_time_s = False, None, 0.0
        self._told_quick_stop, self._going = False, False
        return feedback

    async def load(self, plan: Plan) -> None:
        """Cut the plan into pieces and set the quick-stop ramps for it. Nothing moves. Raises StrainForeseen, as
        `arm_stops`."""
        peak = plan.bounds.peak_mm_s if plan.bounds is not None else np.abs(np.diff(plan.q_mm, axis=0)).max(0)
        rows = plan.q_mm[:, self._rows]
        self._pieces = profile_pieces(rows, np.maximum(np.abs(peak)[self._rows], 1e-6), self._profile)
        fastest = np.zeros(len(self.axes))
        for piece in self._pieces:
            fastest[self._rows] = np.maximum(fastest[self._rows], piece.speed_mm_s)
        full = self.a_quick_mm_s2
        self._quick_s = max(float(np.max(fastest / full)), self.cycle_s)
        await self.arm_stops(fastest, self._quick_s)
        self._plan, self._at, self._going, self._path_time_s = plan, 0, False, 0.0

    async def command(self, verb: str) -> None:
        """`run`, `hold`, `resume`, `stop`, `quick-stop` or `reset`, to all axes at one SYNC."""
        if verb in ("run", "resume"):
            await self._go()
        elif verb in ("hold", "stop"):
            self._going = False
            self._command_driven(cia402.ENABLE_OPERATION | HALT)
        elif verb == "quick-stop":
            self._going, self._told_quick_stop, self._standing = False, True, 0
            self.quick_stop()
        else:
            await self.reset_faults()

    async def override(self, rate: float) -> None:
        """At standstill: the share of the speeds from the next run or resume on."""
        self._rate = rate

    async def poll(self, *, surviving: bool = False) -> Feedback:
        """The newest read-back with the path time that it belongs to; starts the next piece when one has ended.

        Raises LinkLost, AxisStuck where a piece takes too long, OutcomeUnknown where a drive does not take its target.
        """
        if not surviving:
            self._require_link()
        feedback = self.latest()
        if self._going:
            await self._lead(feedback)
        elif self._told_quick_stop and not surviving:
            await self._brake_at_rest(feedback)
        return replace(feedback, path_time_s=self._path_of(feedback))

    def _on_lost(self, reason: str) -> None:
        super()._on_lost(reason)
        self.on_lost()

    # one piece ---------------------------------------------------------------------------------------------------
    async def _go(self) -> None:
        """Write the profile of the present piece, let every drive take its target at one SYNC."""
        if self._at >= len(self._pieces):
            return
        piece, rate = self._pieces[self._at], self._rate
        profiles = zip(self._driven_setups, piece.speed_mm_s * rate, piece.acceleration_mm_s2 * rate**2, strict=True)
        results = await asyncio.gather(*(self._write(*one) for one in profiles), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result
        target = np.zeros(len(self.axes))
        target[self._rows] = piece.end_mm
        self._image.aim_mm(target)
        self._command_driven(cia402.ENABLE_OPERATION)
        await self._handshake(0)
        self._command_driven(cia402.ENABLE_OPERATION | NEW_SET_POINT)
        await self._handshake(_ACKNOWLEDGED)
        self._going = True
        self._due_s = self._loop.time() + piece.duration_s / rate + LATE_S

    async def _write(self, setup: NodeBringUp, speed_mm_s: float, acceleration_mm_s2: float) -> None:
        counts = {"profile_speed": speed_mm_s, "profile_acceleration": acceleration_mm_s2}
        counts["profile_deceleration"] = acceleration_mm_s2
        for name, value in counts.items():
            entry, number = self._map.objects[name], max(1, round(value * self._bus.counts_per_mm))
            await setup.sdo.write(entry, number)
            found = await setup.sdo.read(entry)
            if not (abs(found - number) <= max(1.0, ROUNDING * number)):
                raise ReadBackMismatch(setup.node.name, f"object {entry.label}", value=found, limit=number)

    async def _handshake(self, wanted: int) -> None:
        """Until every driven axis shows bit 12 as wanted. Raises OutcomeUnknown after halting all."""
        deadline = self._loop.time() + HANDSHAKE_S
        while waiting := [int(i) for i in self._rows if self._image.word(int(i)) & _ACKNOWLEDGED != wanted]:
            if not (self._loop.time() < deadline):
                self._command_driven(cia402.ENABLE_OPERATION | HALT)
                name = self._nodes[waiting[0]].name
                raise OutcomeUnknown(name, "the drive does not acknowledge its target (6041h bit 12)")
            await self._step()

    async def _lead(self, feedback: Feedback) -> None:
        piece = self._pieces[self._at]
        left = np.abs(feedback.position_mm[self._rows] - piece.end_mm)
        reached = all(self._image.word(int(i)) & _REACHED for i in self._rows)
        if reached and left.max() <= THERE_MM:
            self._at += 1
            self._going = False
            if self._at < len(self._pieces):
                await self._go()
        elif not (self._loop.time() < self._due_s):
            worst = int(np.argmax(left))
            self._command_driven(cia402.ENABLE_OPERATION | HALT)
            name = self._nodes[int(self._rows[worst])].name
            raise AxisStuck(name, "its profile should have ended", value=float(left[worst]), limit=THERE_MM)

    async def _brake_at_rest(self, feedback: Feedback) -> None:
        """After a quick stop: brakes, once the axes stand."""
        now = feedback.position_mm
        moved = self._last_mm is None or float(np.abs(now - self._last_mm).max()) > THERE_MM
        self._standing, self._last_mm = 0 if moved else self._standing + 1, now
        if self._standing >= BRAKE_AFTER and not self.braked:
            try:
                await self.brake()
            except EnableFailed:
                # The monitors meet the axis that keeps its torque; it is tried again.
                self._standing = 0

    def _path_of(self, feedback: Feedback) -> float:
        """The path time at which the axes are as far along their piece as they are, by least squares."""
        if self._plan is None:
            return float("nan")
        if self._at >= len(self._pieces):
            return self._plan.duration_s
        piece = self._pieces[self._at]
        way = piece.end_mm - piece.start_mm
        length = float(way @ way)
        done = float((feedback.position_mm[self._rows] - piece.start_mm) @ way) / length if length else 0.0
        row = np.interp(min(max(done, 0.0), 1.0), piece.fraction, np.arange(piece.first, piece.last + 1.0))
        self._path_time_s = max(self._path_time_s, float(row) * self._plan.period_s)
        return min(self._path_time_s, self._plan.duration_s - 0.5 * self._plan.period_s)

    def _command_driven(self, word: int) -> None:
        for index in self._rows:
            if self._image.state(int(index)) is DriveState.OPERATION_ENABLED:
                self._image.command(int(index), word)
