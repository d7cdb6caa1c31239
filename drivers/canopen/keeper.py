"""Sends the cycles that nobody else sends: while a bus is brought up, enabled, homed or closed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


class Keeper:
    """Calls `cycle` once a cycle unless one was sent meanwhile; ends when `lost` says so.

    `sent_s` tells when the last was sent (loop time), NaN before the first.
    """

    def __init__(
        self, cycle_s: float, cycle: Callable[[], None], sent_s: Callable[[], float], lost: Callable[[], bool]
    ) -> None:
        self._cycle_s, self._cycle, self._sent_s, self._lost = cycle_s, cycle, sent_s, lost
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = 0.0

    def begin(self) -> None:
        """From now on; the first cycle goes at once."""
        if self._timer is None:
            self._due_s = asyncio.get_running_loop().time()
            self._tick()

    def end(self) -> None:
        """Somebody else sends the cycles."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if self._lost():
            self._timer = None
            return
        if not (now_s - self._sent_s() < 0.9 * self._cycle_s):
            self._cycle()
        self._due_s = max(self._due_s + self._cycle_s, now_s)
        self._timer = loop.call_at(self._due_s, self._tick)
