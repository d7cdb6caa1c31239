"""Motion over positioners that play a queue of segments after one common start."""

from __future__ import annotations

import asyncio

import numpy as np

from docking.errors import DockingError, PlanStale
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.recorder import Recorder
from docking.ports import QueuedPositioners
from docking.types import Array, Feedback, Identity, MoveResult, Plan

START_TOLERANCE_MM = 0.02
STANDSTILL_MM = 0.002
END_POLLS = 3


class QueuedMotion:
    """The `Motion` port over `QueuedPositioners`: polls, watches, and asks all controllers to ramp on any trip."""

    def __init__(self, positioners: QueuedPositioners, watch: Watch, poll_s: float) -> None:
        self._bus, self._watch, self._poll_s = positioners, watch, poll_s
        self.axes = positioners.axes
        self._commanded: Array = np.zeros(len(self.axes))
        self._feedback: Feedback | None = None
        self._playback: Playback | None = None
        self._verbs: asyncio.Queue[str] = asyncio.Queue()
        self._idle: asyncio.Task[None] | None = None
        self._cause: DockingError | None = None
        self._moving = False

    async def connect(self) -> tuple[Identity, ...]:
        return await self._bus.bring_up()

    async def enable(self) -> Array:
        self._feedback = await self._bus.enable()
        self._commanded = np.array(self._feedback.position_mm)
        self._commanded.setflags(write=False)
        self._cause = None
        self._watch.watch_about(self._commanded)
        self._idle = asyncio.get_running_loop().create_task(self._keep_alive())
        return self._commanded

    async def load(self, plan: Plan) -> None:
        if self._cause is not None:
            raise PlanStale(plan.stage, f"the motion side holds a fault: {self._cause}")
        gap = float(np.max(np.abs(plan.q_mm[0] - self._commanded)[self._watch.driven]))
        if not (gap <= START_TOLERANCE_MM):
            raise PlanStale(plan.stage, f"it starts {gap:.4f} mm from where the axes are commanded")
        self._watch.watch_about(plan.q_mm[0])
        await self._bus.load(plan)
        self._playback = Playback(plan)

    async def start(self, plan_hash: str) -> MoveResult:
        playback = self._playback
        if playback is None or playback.plan.plan_hash != plan_hash:
            raise PlanStale("motion", "another plan is loaded")
        recorder = Recorder(self._watch, max(1, round(0.1 / self._poll_s)))
        while not self._verbs.empty():
            self._verbs.get_nowait()
        self._moving = True
        try:
            await self._bus.command("run")
            outcome = await self._play(playback, recorder)
        except DockingError as error:
            self._cause = self._cause or error
            outcome = "fault"
        finally:
            self._moving, self._playback = False, None
        return self._result(outcome, playback, recorder)

    async def _play(self, playback: Playback, recorder: Recorder) -> str:
        stop_asked, still = False, 0
        before = self.feedback().position_mm
        while True:
            await asyncio.sleep(self._poll_s)
            feedback = await self._read(playback)
            recorder.add(feedback, feedback.path_time_s)
            stop_asked = await self._obey(stop_asked)
            still = still + 1 if np.max(np.abs(feedback.position_mm - before)) <= STANDSTILL_MM else 0
            before = feedback.position_mm
            if still >= END_POLLS:
                if self._cause is not None:
                    return "fault"
                if feedback.path_time_s >= playback.plan.duration_s - 1e-6:
                    return "done"
                if stop_asked:
                    return "stopped"

    async def _read(self, playback: Playback | None) -> Feedback:
        feedback = await self._bus.poll()
        self._feedback = feedback
        if playback is None:
            cause = self._watch.evaluate(feedback, self._commanded, 0.0)
        else:
            at = feedback.path_time_s
            cause = self._watch.evaluate(feedback, playback.chord_at(at), playback.speed_at(at))
        if cause is not None and self._cause is None:
            self._cause = cause
            if self._moving:
                await self._bus.command("stop")
        return feedback

    async def _obey(self, stop_asked: bool) -> bool:
        while not self._verbs.empty():
            verb = self._verbs.get_nowait()
            if verb == "resume" and (stop_asked or self._cause is not None):
                continue
            await self._bus.command(verb)
            stop_asked = stop_asked or verb == "stop"
        return stop_asked

    def _result(self, outcome: str, playback: Playback, recorder: Recorder) -> MoveResult:
        path_time = self.feedback().path_time_s
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

    def request(self, verb: str) -> None:
        self._verbs.put_nowait(verb)

    def feedback(self) -> Feedback:
        if self._feedback is None:
            raise PlanStale("motion", "the positioners are not enabled")
        return self._feedback

    async def close(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
            await asyncio.gather(self._idle, return_exceptions=True)
            self._idle = None
        await self._bus.close()
