"""Motion over positioners that play a queue of segments after one common start."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque

import numpy as np

from docking.errors import Defect, DockingError, PlanStale
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.recorder import Recorder
from docking.ports import QueuedPositioners
from docking.types import Array, AxisState, Feedback, Identity, MoveResult, Plan

START_TOLERANCE_MM = 0.02
STANDSTILL_MM = 0.002
END_POLLS = 3
END_S = 1e-6
TRACE_PERIOD_S = 0.1


class QueuedMotion:
    """The `Motion` port over `QueuedPositioners`: polls, watches, and asks all controllers to ramp on any trip."""

    def __init__(self, positioners: QueuedPositioners, watch: Watch, poll_s: float) -> None:
        self._bus, self._watch, self._poll_s = positioners, watch, poll_s
        self.axes = positioners.axes
        self._commanded: Array = np.zeros(len(self.axes))
        self._feedback: Feedback | None = None
        self._playback: Playback | None = None
        self._verbs: deque[str] = deque()
        self._idle: asyncio.Task[None] | None = None
        self._cause: DockingError | None = None
        self._moving = self._slowing = False
        self._still = self._unasked = 0

    async def connect(self) -> tuple[Identity, ...]:
        return await self._bus.bring_up()

    async def enable(self) -> Array:
        if self._moving:
            raise PlanStale("motion", "a move is running")
        await self._end_idle()
        self._feedback = await self._bus.enable()
        self._commanded = np.array(self._feedback.position_mm)
        self._commanded.setflags(write=False)
        self._cause = self._playback = None
        self._verbs.clear()
        self._watch.watch_about(self._commanded)
        self._idle = asyncio.get_running_loop().create_task(self._keep_alive())
        return self._commanded

    async def load(self, plan: Plan) -> None:
        if self._cause is not None:
            raise self._cause
        if self._moving:
            raise PlanStale(plan.stage, "a move is running")
        gap = float(np.max(np.abs(plan.q_mm[0] - self._commanded)[self._watch.driven]))
        if not (gap <= START_TOLERANCE_MM):
            raise PlanStale(plan.stage, f"it starts {gap:.4f} mm from where the axes are commanded")
        self._watch.watch_about(plan.q_mm[0])
        await self._bus.load(plan)
        self._playback = Playback(plan)
        self._require_enabled(await self._read(self._playback))

    def _require_enabled(self, feedback: Feedback) -> None:
        off = self._watch.power(feedback)
        if off is not None:
            raise off

    async def start(self, plan_hash: str) -> MoveResult:
        if self._cause is not None:
            raise self._cause
        if self._moving:
            raise PlanStale("motion", "a move is running")
        playback, self._playback = self._playback, None
        if playback is None or playback.plan.plan_hash != plan_hash:
            raise PlanStale("motion", "this plan is not loaded")
        self._require_enabled(self.feedback())
        recorder = Recorder(self._watch, max(1, round(TRACE_PERIOD_S / self._poll_s)))
        self._moving, self._slowing = True, False
        try:
            outcome = await self._play(playback, recorder)
        except DockingError as error:
            self._cause = self._cause or error
            outcome = "fault"
            await self._stop_all()
        except BaseException as error:
            # A defect, or nobody waits for this move any more: so nobody watches it.
            if isinstance(error, Exception):
                self._cause = self._cause or _defect(error)
            await self._stop_all()
            raise
        finally:
            self._moving = False
            self._verbs.clear()
        return self._result(outcome, playback, recorder)

    async def _play(self, playback: Playback, recorder: Recorder) -> str:
        if not await self._set_off():
            return "stopped"
        stop_asked, self._still = False, 0
        before = await self._read(playback)
        while True:
            await asyncio.sleep(self._poll_s)
            feedback = await self._read(playback)
            recorder.add(feedback, feedback.path_time_s)
            self._count_still(before, feedback)
            before = feedback
            ended = feedback.path_time_s >= playback.plan.duration_s - END_S
            stop_asked = await self._obey(feedback, stop_asked, ended)
            if self._still < END_POLLS:
                continue
            if self._cause is not None:
                return "fault"
            if ended or stop_asked:
                return "done" if ended else "stopped"

    async def _set_off(self) -> bool:
        """Give the common start, after a hold that came before it is over; False when a stop came before it."""
        held = False
        while self._verbs or held:
            while self._verbs:
                verb = self._verbs.popleft()
                if verb == "stop":
                    return False
                held = verb == "hold"
            if held:
                await asyncio.sleep(self._poll_s)
                await self._read(None)
                if self._cause is not None:
                    raise self._cause
        await self._command("run")
        return True

    def _count_still(self, before: Feedback, now: Feedback) -> None:
        moved = np.abs(now.position_mm - before.position_mm)
        resting = AxisState.STOPPING not in now.states and np.max(moved) <= STANDSTILL_MM
        self._still = self._still + 1 if resting else 0

    async def _read(self, playback: Playback | None) -> Feedback:
        feedback = await self._bus.poll()
        self._feedback = feedback
        may_stop = self._may_stop(feedback)
        if playback is None:
            finding = self._watch.evaluate(feedback, self._commanded, 0.0, moving=False, may_stop=may_stop)
        else:
            at = feedback.path_time_s
            chord, speed = playback.chord_at(at), playback.speed_at(at)
            finding = self._watch.evaluate(feedback, chord, speed, moving=self._moving, may_stop=may_stop)
        if finding is not None and self._cause is None:
            self._cause = finding.error
            if self._moving:
                await self._command("stop")
        return feedback

    def _may_stop(self, feedback: Feedback) -> bool:
        """Whether an axis may be ramping down now: after a hold or a stop, and for one poll without.

        A controller that faults takes the others along over the common line; the next poll tells which it was.
        """
        unasked = AxisState.STOPPING in feedback.states and not self._slowing
        self._unasked = self._unasked + 1 if unasked else 0
        return self._moving and self._unasked <= 1

    async def _obey(self, feedback: Feedback, stop_asked: bool, ended: bool) -> bool:
        """Pass on one verb, so that the next is judged by a read-back that shows its effect."""
        if not self._verbs:
            return stop_asked
        if self._verbs[0] == "resume":
            if AxisState.STOPPING in feedback.states:
                return stop_asked
            self._verbs.popleft()
            if not (stop_asked or ended or self._cause is not None):
                await self._command("resume")
            return stop_asked
        verb = self._verbs.popleft()
        await self._command(verb)
        return stop_asked or verb == "stop"

    async def _command(self, verb: str) -> None:
        self._still = 0
        self._slowing = verb in ("hold", "stop")
        await self._bus.command(verb)

    async def _stop_all(self) -> None:
        """Have those controllers that still listen ramp down; the others follow the common line or their watchdogs."""
        with contextlib.suppress(DockingError):
            await self._command("stop")

    def _result(self, outcome: str, playback: Playback, recorder: Recorder) -> MoveResult:
        path_time = self._feedback.path_time_s if self._feedback is not None else float("nan")
        self._commanded = playback.chord_at(path_time) if path_time >= 0.0 else self._commanded
        return recorder.result(outcome, path_time, self._commanded, self._cause)

    async def _keep_alive(self) -> None:
        while True:
            await asyncio.sleep(self._poll_s)
            if self._moving:
                continue
            try:
                await self._read(None)
            except DockingError as error:
                self._cause = self._cause or error
                return
            except Exception as error:
                self._cause = self._cause or _defect(error)
                await self._stop_all()
                raise

    def request(self, verb: str) -> None:
        if verb != "resume":
            # A hold or a stop overtakes a resume that still waits for the end of a ramp.
            self._verbs.clear()
        self._verbs.append(verb)

    def feedback(self) -> Feedback:
        if self._cause is not None:
            raise self._cause
        if self._feedback is None:
            raise PlanStale("motion", "the positioners are not enabled")
        return self._feedback

    async def close(self) -> None:
        await self._end_idle()
        await self._bus.close()

    async def _end_idle(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
            await asyncio.gather(self._idle, return_exceptions=True)
            self._idle = None


def _defect(error: Exception) -> Defect:
    """An error of the program itself, as the cause that is kept."""
    defect = Defect("motion", f"{type(error).__name__}: {error}")
    defect.__cause__ = error
    return defect
