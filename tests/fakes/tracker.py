"""An in-memory tracker without wire and bytes: what the port means, in a few lines."""

from __future__ import annotations

import asyncio

import numpy as np

from docking.errors import LinkLost, TargetLost
from docking.types import Array, Identity, Reading
from tests.fakes.tracker_optics import POINTS


class FakeTracker:
    """`docking.ports.Tracker` that measures the reflectors of `tests.fakes.tracker_optics`."""

    def __init__(self, measure_s: float = 0.1) -> None:
        self.two_face = True
        self._measure_s, self._open = measure_s, False
        self._turn = asyncio.Lock()

    async def connect(self) -> Identity:
        self._open = True
        return Identity("tracker", "tests", "fake", "1", "")

    async def measure(self, target: str, near_T_mm: Array, face: int = 1) -> Reading:
        if not self._open:
            raise LinkLost("tracker", "closed")
        async with self._turn:
            await asyncio.sleep(self._measure_s)
        if target not in POINTS:
            raise TargetLost(target, "no reflector")
        return Reading(target, np.array(POINTS[target]), 0.01 * np.eye(3), asyncio.get_running_loop().time(), face)

    async def close(self) -> None:
        self._open = False
