"""In-memory streaming sensors without wire and bytes: what their ports mean, in a few lines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np

from docking.errors import LinkError, LinkLost
from docking.sightings import InertialSample, PointFrame
from docking.types import Identity

PERIOD_S, DELAY_S = 0.05, 0.01


class _FakeStream:
    """Reports every `PERIOD_S` what was so `DELAY_S` before, while it is started."""

    where = "sensor"

    def __init__(self) -> None:
        self.on_lost: Callable[[LinkError], None] = lambda error: None
        self._open = False
        self._number = 0
        self._timer: asyncio.TimerHandle | None = None

    async def connect(self) -> Identity:
        self._open = True
        return Identity(self.where, "tests", "fake", "1", "1")

    async def start(self) -> None:
        if not self._open:
            raise LinkLost(self.where, "not connected")
        self._schedule()

    async def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    async def close(self) -> None:
        await self.stop()
        self._open = False

    def _schedule(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(PERIOD_S, self._tick)

    def _tick(self) -> None:
        self._schedule()
        self._number += 1
        now_s = asyncio.get_running_loop().time()
        self._report(now_s - DELAY_S, now_s)

    def _report(self, t_s: float, now_s: float) -> None:
        raise NotImplementedError


class FakeCamera(_FakeStream):
    """`docking.ports.PointStream`: sees nothing, regularly."""

    where = "camera"
    on_frame: Callable[[PointFrame], Any]

    def __init__(self) -> None:
        super().__init__()
        self.on_frame = lambda frame: None

    def _report(self, t_s: float, now_s: float) -> None:
        self.on_frame(PointFrame(self._number, t_s, now_s, (), np.zeros((0, 3))))


class FakeInertial(_FakeStream):
    """`docking.ports.InertialSensor` at rest."""

    where = "inertial sensor"
    on_sample: Callable[[InertialSample], Any]

    def __init__(self) -> None:
        super().__init__()
        self.on_sample = lambda sample: None

    def _report(self, t_s: float, now_s: float) -> None:
        up = np.array([0.0, 0.0, 9.80665])
        self.on_sample(InertialSample(t_s, now_s, t_s, up, np.zeros(3), np.full(3, np.nan)))
