"""Motion over a bus that takes one set-point a cycle: the tick, at a fixed rate on absolute deadlines."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from docking.errors import AxisNotEnabled, Defect, DockingError, DriveFault, FeedbackMissing, PlanStale, TickLate
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.recorder import Recorder
from docking.motion.triggers import Finding
from docking.ports import StreamedPositioners
from docking.types import Array, Feedback, Identity, MoveResult, Plan, readonly

START_TOLERANCE_MM = 0.01
SHORTEST_CYCLE = 0.9
TRACE_PERIOD_S = 0.1


@dataclass
class _Move:
    """A running move."""

    playback: Playback
    recorder: Recorder
    done: asyncio.Future[MoveResult]
    over: asyncio.Event
    stop_asked: bool = False


class StreamedMotion:
    """The `Motion` port over `StreamedPositioners`. Owns the tick from `enable` to `close`.

    A tick that comes more than `late_cycles` late stops the axes.
    """

    def __init__(self, positioners: StreamedPositioners, watch: Watch, late_cycles: float) -> None:
        self._bus, self._watch = positioners, watch
        self.axes = positioners.axes
        self._cycle_s = positioners.cycle_s
        self._late_limit_s = late_cycles * self._cycle_s
        self._setpoint: Array = np.zeros(len(self.axes))
        self._history: deque[Array] = deque(maxlen=3)
        self._feedback: Feedback | None = None
        self._loaded: Playback | None = None
        self._move: _Move | None = None
        self._cause: DockingError | None = None
        self._early: list[str] = []
        self._left_alone = False
        self._timer: asyncio.Handle | None = None
        self._deadline_s = 0.0
        self._judged: Feedback | None = None

    async def connect(self) -> tuple[Identity, ...]:
        return await self._bus.bring_up()

    async def enable(self) -> Array:
        if self._move is not None:
            raise PlanStale("motion", "a move is running")
        self._end_ticks()
        feedback = await self._bus.enable()
        self._setpoint = readonly(feedback.position_mm)
        self._history.extend([self._setpoint] * 3)
        self._feedback, self._judged, self._loaded, self._cause = feedback, None, None, None
        self._early.clear()
        self._left_alone = False
        self._watch.watch_about(self._setpoint)
        loop = asyncio.get_running_loop()
        self._deadline_s = loop.time()
        self._timer = loop.call_soon(self._tick)
        return self._setpoint

    async def load(self, plan: Plan) -> None:
        if self._cause is not None:
            raise self._cause
        if self._move is not None:
            raise PlanStale(plan.stage, "a move is running")
        gap = float(np.max(np.abs(plan.q_mm[0] - self._setpoint)[self._watch.driven]))
        if not (gap <= START_TOLERANCE_MM):
            raise PlanStale(plan.stage, f"it starts {gap:.4f} mm from where the axes are commanded")
        self._require_enabled()
        self._watch.watch_about(plan.q_mm[0])
        self._loaded = Playback(plan)

    def _require_enabled(self) -> None:
        off = self._watch.power(self.feedback())
        if off is not None:
            raise off

    async def start(self, plan_hash: str) -> MoveResult:
        if self._cause is not None:
            raise self._cause
        if self._move is not None:
            raise PlanStale("motion", "a move is running")
        playback, self._loaded = self._loaded, None
        if playback is None or playback.plan.plan_hash != plan_hash:
            raise PlanStale("motion", "this plan is not loaded")
        self._require_enabled()
        recorder = Recorder(self._watch, max(1, round(TRACE_PERIOD_S / self._cycle_s)))
        done: asyncio.Future[MoveResult] = asyncio.get_running_loop().create_future()
        self._move = _Move(playback, recorder, done, asyncio.Event())
        if self._early:
            playback.wait()
        for verb in self._early:
            self._obey(self._move, verb)
        try:
            return await done
        except asyncio.CancelledError:
            # Nobody waits for this move any more, so nobody watches it.
            self.request("stop")
            raise
        finally:
            self._early.clear()

    def request(self, verb: str) -> None:
        if self._move is None:
            # A hold that comes before the first set-point counts from the first set-point on.
            self._early.append(verb)
        else:
            self._obey(self._move, verb)

    def _obey(self, move: _Move, verb: str) -> None:
        if verb == "resume":
            if not move.stop_asked and self._cause is None:
                move.playback.turn_to(1.0)
            return
        move.stop_asked = move.stop_asked or verb == "stop"
        if self._cause is None:
            move.playback.turn_to(0.0)

    def feedback(self) -> Feedback:
        if self._cause is not None:
            raise self._cause
        if self._feedback is None:
            raise PlanStale("motion", "the positioners are not enabled")
        return self._feedback

    async def close(self) -> None:
        if self._move is not None:
            over = self._move.over
            self.request("stop")
            await over.wait()
        self._end_ticks()
        await self._bus.close()

    def _end_ticks(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        self._timer = None
        move = self._move
        try:
            self._cycle(move)
        except DockingError as error:
            self._give_up(error, move)
        except Exception as error:
            # A defect: no more set-points. Whoever waits for the move learns why, and so does everyone who asks later.
            self._cause = self._cause or Defect("motion", f"{type(error).__name__}: {error}")
            if move is not None:
                self._end(move)
                if not move.done.done():
                    move.done.set_exception(error)
            self._bus.quick_stop()
            raise

    def _cycle(self, move: _Move | None) -> None:
        loop = asyncio.get_running_loop()
        now = loop.time()
        if move is not None:
            self._setpoint = move.playback.advance(self._cycle_s)
        self._history.append(self._setpoint)
        feedback = self._bus.exchange(self._setpoint)
        self._feedback = feedback
        cause = self._judge(feedback, move) or self._lateness(now - self._deadline_s)
        if cause is not None:
            self._trip(cause, move)
        if move is not None:
            self._follow(move, feedback)
        # Missed deadlines are skipped, never made up for in a burst; the next is at least half a cycle away.
        missed = max(0, math.floor((now - self._deadline_s) / self._cycle_s + 0.5))
        self._deadline_s += (1 + missed) * self._cycle_s
        self._timer = loop.call_at(self._deadline_s, self._tick)

    def _give_up(self, error: DockingError, move: _Move | None) -> None:
        """The bus takes no set-points any more: the drives stop by themselves, the ticks end."""
        self._cause = self._cause or error
        self._bus.quick_stop()
        if move is not None:
            self._finish(move, "fault")

    def _judge(self, feedback: Feedback, move: _Move | None) -> DockingError | None:
        if move is None:
            before, self._judged = self._judged, feedback
            if before is not None and _same(before, feedback) and self._history[0] is self._setpoint:
                return None
            return _error_of(self._watch.evaluate(feedback, self._history[0], 0.0, moving=False))
        # A read-back belongs to the set-point of two cycles ago: one cycle on the bus, one until the drive applies it.
        speed = move.playback.speed_at(move.playback.path_time_s)
        return _error_of(self._watch.evaluate(feedback, self._history[0], speed, moving=True))

    def _lateness(self, late_s: float) -> DockingError | None:
        limit = self._late_limit_s
        return TickLate("motion", value=late_s, limit=limit) if not (late_s <= limit) else None

    def _trip(self, cause: DockingError, move: _Move | None) -> None:
        """Keep the first cause and stop on the path; axes that cannot be led there stop by themselves, now or later."""
        if isinstance(cause, DriveFault | FeedbackMissing | AxisNotEnabled) and not self._left_alone:
            self._left_alone = True
            self._bus.quick_stop()
        if self._cause is not None:
            return
        self._cause = cause
        if move is not None:
            move.playback.turn_to(0.0, self._watch.quick_slew_per_s(move.playback.plan))

    def _follow(self, move: _Move, feedback: Feedback) -> None:
        playback = move.playback
        move.recorder.add(feedback, playback.path_time_s)
        stopped = playback.standing and (move.stop_asked or self._cause is not None)
        if not (playback.at_end or stopped):
            return
        self._finish(move, "fault" if self._cause else "stopped" if stopped else "done")

    def _finish(self, move: _Move, outcome: str) -> None:
        result = move.recorder.result(outcome, move.playback.path_time_s, self._setpoint, self._cause)
        self._end(move)
        if not move.done.done():
            move.done.set_result(result)

    def _end(self, move: _Move) -> None:
        self._move = None
        move.over.set()


def _error_of(finding: Finding | None) -> DockingError | None:
    return None if finding is None else finding.error


def _same(before: Feedback, now: Feedback) -> bool:
    """True when a driver passed the same values on: at rest, what was judged a cycle ago needs no second judgement."""
    return (
        now.position_mm is before.position_mm
        and now.following_error_mm is before.following_error_mm
        and now.force_n is before.force_n
        and now.states is before.states
        and now.age_cycles is before.age_cycles
        and now.fault is before.fault
    )
