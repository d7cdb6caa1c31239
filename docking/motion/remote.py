"""The cell's side of the channel: the `Motion` port, with the motion process at the other end."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

from docking.errors import BadArgument, DockingError, MotionProcessLost, PlanStale
from docking.motion.channel import Channel
from docking.motion.messages import WHERE, decode, encode
from docking.types import Array, Feedback, Identity, InputState, MoveResult, Plan

RENEWALS = 5
"""How often the lease is renewed in its time."""
START_S = 60.0
"""Longest time until the motion process says its first word: it loads its program on a computer that may be busy."""
LEASE = encode("lease", 0)

Tell = Callable[[str, Any], None]


@dataclass(frozen=True)
class LeaseSettings:
    """How long the lease lasts and how often read-backs come."""

    lease_s: float
    feedback_s: float


class RemoteMotion:
    """`docking.ports.Motion` over a channel; renews the lease from `connect` to `close`.

    `on_feedback` hears every read-back when it comes. `tell(what, body)` hears `hello`, `lateness` and `said` of the
    motion side. `explain(reason)` is called when it is gone: it makes sure of that and says how it ended.
    """

    def __init__(
        self,
        channel: Channel,
        axes: tuple[str, ...],
        settings: LeaseSettings,
        tell: Tell = lambda what, body: None,
        explain: Callable[[str], str] = lambda reason: reason,
    ) -> None:
        self.axes = axes
        self.speed_limit_mm_s = math.inf
        self.on_feedback: Callable[[Feedback], None] = lambda feedback: None
        self._channel, self._settings, self._tell, self._explain = channel, settings, tell, explain
        self._loop = asyncio.get_running_loop()
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._move = 0
        self._early: list[str] = []
        self._feedback: Feedback | None = None
        self._inputs = InputState()
        self._held: DockingError | None = None
        self._lost: DockingError | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._heard_s: float | None = None
        self._silence_s = max(settings.lease_s, 4.0 * settings.feedback_s)
        self._give_up_s = math.inf
        channel.on_message, channel.on_lost = self._take, self._end_of_channel

    # the port ------------------------------------------------------------------------------------------------------
    async def connect(self) -> tuple[Identity, ...]:
        if self._timer is None:
            now_s = self._loop.time()
            self._give_up_s = now_s + START_S
            self._heard_s = now_s if self._heard_s is not None else None
            self._renew()
        return cast("tuple[Identity, ...]", await self._call("connect"))

    async def enable(self) -> Array:
        self._early.clear()
        return cast(Array, await self._call("enable"))

    async def load(self, plan: Plan) -> None:
        await self._call("load", plan)

    async def start(self, plan_hash: str) -> MoveResult:
        try:
            return cast(MoveResult, await self._call("start", plan_hash))
        finally:
            self._move = 0
            self._early.clear()

    async def reset(self, role: str) -> None:
        """Forget the fault that is kept, on a person's order; then the axes have to be enabled again.

        Raises EventRefused with the reason, and what the devices answer.
        """
        await self._call("reset", role)
        self._feedback = self._held = None

    def request(self, verb: str) -> None:
        if self._move:
            self._channel.send(encode("request", self._move, verb))
        else:
            # A hold that comes before the start counts from the first set-point on.
            self._early.append(verb)

    def stop_for(self, error: DockingError) -> None:
        """Stop the running move on its path; the motion side judges and keeps the error."""
        if self._move:
            self._channel.send(encode("stop_for", self._move, error))

    def override(self, percent: float) -> None:
        """Run plans at 0 to 100 % of their speed from now on. Raises BadArgument outside, and nothing changes."""
        if not (0.0 <= percent <= 100.0):
            raise BadArgument("speed override", value=percent, limit="0 to 100 %")
        self._channel.send(encode("override", 0, float(percent)))

    def feedback(self) -> Feedback:
        """The newest read-back told, at most the lease old. Raises the fault that the motion side holds."""
        fault = self._lost or self._held
        if fault is not None:
            raise fault
        if self._feedback is None:
            raise PlanStale("motion", "the positioners are not enabled")
        return self._feedback

    def inputs(self) -> InputState:
        """What the wired inputs say, as last told; told at every change."""
        return self._inputs

    async def close(self) -> None:
        try:
            if self._lost is None:
                await self._call("close")
        finally:
            if self._timer is not None:
                self._timer.cancel()
            self._lost = self._lost or MotionProcessLost(WHERE, "it is closed")
            self._channel.close()

    # out -----------------------------------------------------------------------------------------------------------
    async def _call(self, kind: str, payload: Any = None) -> Any:
        if self._lost is not None:
            raise self._lost
        number = next(self._numbers)
        answer: asyncio.Future[Any] = self._loop.create_future()
        self._waiting[number] = answer
        self._channel.send(encode(kind, number, payload))
        if kind == "start":
            self._move = number
            for verb in self._early:
                self.request(verb)
        try:
            return await answer
        except asyncio.CancelledError:
            self._channel.send(encode("cancel", number))
            raise
        finally:
            del self._waiting[number]

    def _renew(self) -> None:
        """Renew the lease, and see whether the other side still speaks."""
        now_s = self._loop.time()
        self._timer = self._loop.call_at(now_s + self._settings.lease_s / RENEWALS, self._renew)
        self._channel.send(LEASE)
        if self._heard_s is None:
            if now_s > self._give_up_s:
                self._end(f"it has not begun to work in {START_S:.0f} s")
        elif not (now_s - self._heard_s <= self._silence_s):
            self._end(f"it has been silent for {now_s - self._heard_s:.2f} s")

    # in ------------------------------------------------------------------------------------------------------------
    def _take(self, message: bytes) -> None:
        kind, number, payload = decode(message)
        self._heard(kind)
        if kind == "still":
            if self._feedback is not None:
                self._feedback = replace(self._feedback, t_s=payload)
                self.on_feedback(self._feedback)
        elif kind == "feedback":
            self._feedback, self._held = payload, None
            self.on_feedback(payload)
        elif kind == "inputs":
            self._inputs = payload
        elif kind == "held":
            self._held = payload
        elif kind in ("reply", "failed"):
            self._answered(kind, number, payload)
        elif kind == "refused":
            self._lost = payload
            self._end("")
        elif kind != "alive":
            if kind == "lateness":
                self.speed_limit_mm_s = payload["speed_limit_mm_s"]
            self._tell(kind, payload)

    def _heard(self, kind: str) -> None:
        """After its greeting the other side reads files and is silent as long as that takes: START_S bounds it."""
        if kind != "hello":
            self._heard_s = self._loop.time()

    def _answered(self, kind: str, number: int, payload: Any) -> None:
        answer = self._waiting.get(number)
        if answer is None or answer.done():
            return
        if kind == "reply":
            answer.set_result(payload)
        else:
            answer.set_exception(payload)

    def _end_of_channel(self, reason: str) -> None:
        self._end(reason)

    def _end(self, reason: str) -> None:
        """The other side is gone: whoever waits for it, and whoever asks later, learns why.

        If it only fell silent, the end of the channel tells it to stop on the path.
        """
        if self._timer is not None:
            self._timer.cancel()
        self._channel.close()
        if self._lost is None:
            self._lost = MotionProcessLost(WHERE, self._explain(reason))
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(self._lost)
