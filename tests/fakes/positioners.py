"""In-memory axes without wire and bytes that keep what their ports promise: streamed ones and queued ones."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray

from docking.errors import (
    AxisLimitExceeded,
    BadArgument,
    DeviceSilent,
    EnableFailed,
    LinkLost,
    SegmentRejected,
)
from docking.types import Array, AxisState, Feedback, Identity, Plan
from tests.support.motion_fakes import QueuedFake, StreamedFake

BRING_UP_S = 0.02
VERBS = ("run", "hold", "resume", "stop", "quick-stop", "reset")
START_MM = 0.01


class FakeDrives(StreamedFake):
    """`docking.ports.StreamedPositioners` in memory. `mute` cuts an axis off."""

    def __init__(self, axes: tuple[str, ...], start_mm: Array, driven: NDArray[np.bool_]) -> None:
        super().__init__(axes, start_mm)
        self.driven = driven
        self._muted: set[str] = set()
        self._age = np.zeros(len(axes))
        self._up = self._enabled = False

    async def bring_up(self) -> tuple[Identity, ...]:
        await asyncio.sleep(BRING_UP_S)
        if self._muted:
            raise DeviceSilent(min(self._muted), "it does not answer", limit=BRING_UP_S)
        self._up = True
        return tuple(Identity(f"axis {name}", "tests", "fake", "1", "1") for name in self.axes)

    async def enable(self) -> Feedback:
        if self.silent or not self._up:
            raise EnableFailed(self.axes[0], "not brought up", value="closed")
        await super().enable()
        self._pipe.extend([self._pipe[0]] * 2)
        self._enabled = True
        return self.latest()

    def latest(self) -> Feedback:
        on = AxisState.ENABLED if self._enabled else AxisState.DISABLED
        states = tuple(on if driven else AxisState.DISABLED for driven in self.driven)
        self.changes = {"states": states, "age_cycles": self._age.copy()}
        return super().latest()

    def send(self, setpoint_mm: Array) -> None:
        if not self._up:
            raise LinkLost(self.axes[0], "not open")
        if not np.isfinite(setpoint_mm).all():
            raise AxisLimitExceeded(self.axes[int(np.argmin(np.isfinite(setpoint_mm)))], "no position")
        muted = np.array([axis in self._muted for axis in self.axes])
        self._age = np.where(muted, self._age + 1.0, 0.0)
        super().send(np.where(self.driven, setpoint_mm, self._pipe[-1]) if self._enabled else self._pipe[-1])

    async def arm_stops(self, peak_mm_s: Array, t_stop_s: float) -> None:
        if not self._up:
            raise LinkLost(self.axes[0], "not open")
        if not np.isfinite(peak_mm_s).all():
            raise AxisLimitExceeded(self.axes[0], "no speed")
        await super().arm_stops(peak_mm_s, t_stop_s)

    def quick_stop(self) -> None:
        super().quick_stop()
        self._enabled = False

    def mute(self, axis: str, muted: bool) -> None:
        """The axis says nothing any more."""
        (self._muted.add if muted else self._muted.discard)(axis)

    async def close(self) -> None:
        self._up = self._enabled = False
        await super().close()


class FakeControllers(QueuedFake):
    """`docking.ports.QueuedPositioners` in memory. `mute` cuts a controller off, `cut` its connection."""

    def __init__(self, axes: tuple[str, ...], start_mm: Array) -> None:
        super().__init__(axes, start_mm)
        self._muted: set[str] = set()
        self._age, self._up, self._on = np.zeros(len(axes)), False, False

    def _require(self) -> None:
        if not self._up or self.silent:
            raise LinkLost("positioner A", "not connected")

    async def bring_up(self) -> tuple[Identity, ...]:
        await asyncio.sleep(BRING_UP_S)
        if self._muted:
            raise DeviceSilent(f"positioner {min(self._muted)}", "it does not answer", limit=BRING_UP_S)
        self._up = True
        names = dict.fromkeys(axis.partition(".")[0] for axis in self.axes)
        return tuple(Identity(f"positioner {name}", "tests", "fake", "1", "1") for name in names)

    async def enable(self) -> Feedback:
        self._require()
        self._on = True
        return await super().enable()

    async def load(self, plan: Plan) -> None:
        self._require()
        if not np.isfinite(plan.q_mm).all():
            raise BadArgument("plan", "a position is no number")
        if not np.abs(plan.q_mm[0] - self.position_mm()).max() <= START_MM:
            raise SegmentRejected(self.axes[0], "the plan begins elsewhere")
        await super().load(plan)

    async def command(self, verb: str) -> None:
        if verb not in VERBS:
            raise BadArgument("verb", "unknown", value=verb)
        self._require()
        await super().command(verb)

    async def override(self, rate: float) -> None:
        if not 0.0 < rate <= 1.0:
            raise BadArgument("rate", "over 0, at most 1", value=rate)
        self._require()
        await super().override(rate)

    async def poll(self, *, surviving: bool = False) -> Feedback:
        self._require()
        muted = np.array([axis.partition(".")[0] in self._muted for axis in self.axes])
        self._age = np.where(muted, self._age + 1.0, 0.0)
        if self._age.max() >= 2.0 and not surviving:
            raise DeviceSilent(f"positioner {min(self._muted)}", "2 replies lost in a row")
        self.changes = {"age_cycles": self._age.copy()}
        if not self._on:
            self.changes["states"] = (AxisState.DISABLED,) * len(self.axes)
        return await super().poll(surviving=surviving)

    def mute(self, positioner: str, muted: bool) -> None:
        """The controller answers no more."""
        (self._muted.add if muted else self._muted.discard)(positioner)

    def cut(self, positioner: str) -> None:
        """Its connection breaks."""
        self.on_lost()

    async def close(self) -> None:
        self._up = self._on = False
        await super().close()
