"""The motion side of the channel: takes the cell's messages, drives the axes, tells how they stand.

The cell process holds a lease that it has to renew. When it does not, or when the channel ends, the axes stop on the
path; at the end of the channel they are then braked and the wires released.
"""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

from docking.errors import BadReply, DockingError, LeaseLost, LiveDeviation, PoseUncertain
from docking.motion.arbiter import Arbiter
from docking.motion.channel import Channel
from docking.motion.lateness import Lateness, speed_limit_mm_s
from docking.motion.messages import WHERE, decode, encode
from docking.motion.triggers import Finding, Trigger
from docking.types import Array, Feedback, Identity, InputState, MoveResult, Plan

STOP_S = 30.0
"""Longest wait for a move to stop on its path before the wires are released without it."""
FOUND_OUTSIDE: dict[type[DockingError], Trigger] = {
    LiveDeviation: Trigger.LIVE_DEVIATION,
    PoseUncertain: Trigger.POSE_UNCERTAIN,
}
"""What the cell process may ask a stop for."""
CALLS = ("connect", "enable", "load", "start", "reset", "close")


class LocalMotion(Protocol):
    """What is served: a motion side that drives the positioners in this process, as `docking.ports.Motion` says."""

    axes: tuple[str, ...]

    @property
    def arbiter(self) -> Arbiter:
        """Decides and keeps what stops the axes."""
        ...

    @property
    def lateness(self) -> Lateness:
        """How late its cycles have come so far."""
        ...

    async def connect(self) -> tuple[Identity, ...]: ...

    async def enable(self) -> Array: ...

    async def load(self, plan: Plan) -> None: ...

    async def start(self, plan_hash: str) -> MoveResult: ...

    async def reset(self, role: str) -> None: ...

    def request(self, verb: str) -> None: ...

    def override(self, percent: float) -> None: ...

    def report(self, finding: Finding) -> None:
        """Something outside the axes asks for a reaction: judged and latched as what the monitors find."""
        ...

    def feedback(self) -> Feedback: ...

    async def close(self) -> None: ...


@runtime_checkable
class WithInputs(Protocol):
    """A motion side that tells what its wired inputs say."""

    on_inputs: Callable[[InputState], None]


@dataclass(frozen=True)
class ServiceSettings:
    """How long the lease lasts, how often read-backs are told, and what lateness does to the speed.

    One cycle in a thousand may be late by `sync_error_mm` of travel (infinite where devices keep the time), and by
    `late_limit_s` at all.
    """

    lease_s: float
    feedback_s: float
    sync_error_mm: float
    late_limit_s: float


class ServedMotion:
    """Serves one cell process; `ended` is set when it has gone and the axes are released.

    `measure` finds out how late the ticks come before anything is connected; None where time is virtual.
    """

    def __init__(
        self,
        motion: LocalMotion,
        channel: Channel,
        settings: ServiceSettings,
        measure: Callable[[], Awaitable[Lateness]] | None = None,
    ) -> None:
        self._motion, self._channel, self._settings, self._measure = motion, channel, settings, measure
        self._loop = asyncio.get_running_loop()
        self._calls: dict[int, asyncio.Task[None]] = {}
        self._leaving: asyncio.Task[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._renewed_s = self._loop.time()
        self._live = self._lapsed = False
        self._shown: Feedback | None = None
        self._told: DockingError | None = None
        self.ended = asyncio.Event()
        channel.on_message, channel.on_lost = self._take, self._lost
        motion.arbiter.on_latched = self._latched
        if isinstance(motion, WithInputs):
            motion.on_inputs = lambda state: self._send("inputs", 0, state)

    # what comes in -------------------------------------------------------------------------------------------------
    def _take(self, message: bytes) -> None:
        kind, number, payload = decode(message)
        self._renewed_s = self._loop.time()
        if kind in CALLS:
            self._calls[number] = self._loop.create_task(self._answer(kind, number, payload))
        elif kind == "request":
            # A verb for a move that has ended meanwhile would hold or stop the next one.
            if number in self._calls:
                self._motion.request(payload)
        elif kind == "stop_for":
            if number in self._calls:
                self._motion.report(Finding(FOUND_OUTSIDE[type(payload)], payload))
        elif kind == "override":
            self._motion.override(payload)
        elif kind == "cancel":
            if number in self._calls:
                self._calls[number].cancel()
        elif kind != "lease":
            raise BadReply(WHERE, f"no message is called {kind}")

    async def _answer(self, kind: str, number: int, payload: Any) -> None:
        try:
            result = await self._perform(kind, payload)
        except DockingError as error:
            self._publish()
            self._send("failed", number, error)
        except Exception as error:  # noqa: BLE001 - whatever went wrong is told to the cell, with the whole story
            self._send("said", 0, traceback.format_exc())
            self._send("failed", number, error)
        else:
            self._publish()
            self._send("reply", number, result)
        finally:
            self._calls.pop(number, None)
        if kind == "close":
            self.ended.set()

    async def _perform(self, kind: str, payload: Any) -> Any:
        motion = self._motion
        if kind == "connect":
            return await self._connect()
        if kind == "enable":
            q_mm = await motion.enable()
            self._live, self._lapsed, self._shown = True, False, None
            return q_mm
        if kind == "load":
            return await motion.load(payload)
        if kind == "start":
            return await motion.start(payload)
        if kind == "reset":
            await motion.reset(payload)
            self._live = False
            return None
        await self._release()
        self._tell_lateness()
        return None

    async def _connect(self) -> tuple[Identity, ...]:
        self._look()
        if self._measure is not None:
            self._judge_lateness(await self._measure())
        return await self._motion.connect()

    def _judge_lateness(self, lateness: Lateness) -> None:
        limit_mm_s = 0.0
        try:
            limit_mm_s = speed_limit_mm_s(lateness, self._settings.sync_error_mm, self._settings.late_limit_s)
        finally:
            self._send("lateness", 0, {**lateness.as_record(), "speed_limit_mm_s": limit_mm_s})

    def _tell_lateness(self) -> None:
        """How late the cycles of the whole run came; in virtual time none does."""
        if self._measure is not None and self._motion.lateness.samples > 0:
            self._send("run_lateness", 0, self._motion.lateness.as_record())

    # what goes out -------------------------------------------------------------------------------------------------
    def _send(self, kind: str, number: int, payload: Any) -> None:
        self._channel.send(encode(kind, number, payload))

    def _look(self) -> None:
        """Tell how the axes stand, and see to the lease."""
        now_s = self._loop.time()
        self._timer = self._loop.call_at(now_s + self._settings.feedback_s, self._look)
        silent_s = now_s - self._renewed_s
        if self._live and not (silent_s <= self._settings.lease_s):
            self._lapse(silent_s, "")
        self._publish()

    def _latched(self) -> None:
        """A fault is told at once, but not from within the tick that found it."""
        self._loop.call_soon(self._publish)

    def _publish(self) -> None:
        """The newest read-back, or the fault that is kept."""
        if not self._live:
            self._send("alive", 0, None)
            return
        try:
            feedback = self._motion.feedback()
        except DockingError as error:
            self._send(*(("alive", 0, None) if error is self._told else ("held", 0, error)))
            self._told, self._shown = error, None
            return
        shown, self._told = self._shown, None
        if shown is not None and _unchanged(shown, feedback):
            self._send("still", 0, feedback.t_s)
            return
        self._shown = feedback
        self._send("feedback", 0, feedback)

    # the end -------------------------------------------------------------------------------------------------------
    def _lapse(self, silent_s: float, cause: str) -> None:
        """Nobody looks after the axes: they stop on the path."""
        if self._lapsed:
            return
        self._lapsed = True
        error = LeaseLost("cell process", cause, value=silent_s, limit=self._settings.lease_s)
        self._motion.report(Finding(Trigger.LEASE_LOST, error))

    def _lost(self, reason: str) -> None:
        self.leave(f"Its end of the channel is closed: {reason}.")

    def leave(self, cause: str) -> None:
        """Stop on the path, brake, release the wires, and be done."""
        if self._leaving is None and not self.ended.is_set():
            if self._live:
                self._lapse(self._loop.time() - self._renewed_s, cause)
            self._leaving = self._loop.create_task(self._leave())

    async def _leave(self) -> None:
        try:
            await self._release()
        finally:
            self.ended.set()

    async def _release(self) -> None:
        """End what is going on, then release the axes: a move ends at its standstill, anything else at once."""
        me = asyncio.current_task()
        self._motion.request("stop")
        others = [task for task in self._calls.values() if task is not me]
        if others:
            _, late = await asyncio.wait(others, timeout=STOP_S)
            for task in late:
                task.cancel()
        try:
            await self._motion.close()
        finally:
            self._live = False
            if self._timer is not None:
                self._timer.cancel()


_COMPARED = tuple(f.name for f in fields(Feedback) if f.name != "t_s")


def _unchanged(before: Feedback, now: Feedback) -> bool:
    """True when the driver has passed the same values on: only the time is new."""
    return all(
        a is b or (isinstance(a, float) and a == b)
        for a, b in ((getattr(before, name), getattr(now, name)) for name in _COMPARED)
    )
