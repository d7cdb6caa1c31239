"""When queued positioners are polled: a period after the last poll, earlier when something is to be done."""

from __future__ import annotations

import asyncio

from docking.motion.lateness import Lateness

GOLDEN, SHARE = 0.618, 0.2
"""During a move polls come up to this share of their period early, spread evenly."""


class Rhythm:
    """Sleeps between the polls of one task, and lets others wait for a poll. Loop time only.

    `lateness` counts how late the polls came that nobody woke.
    """

    def __init__(self, poll_s: float) -> None:
        self._poll_s = poll_s
        self._sleeper: asyncio.Future[None] | None = None
        self._cycled = asyncio.Event()
        self._cycles, self._polled_s, self._phase = 0, 0.0, 0.0
        self.running = False
        self.lateness = Lateness()

    def begin(self) -> None:
        """The first poll is due a period from now."""
        self.running, self._polled_s = True, asyncio.get_running_loop().time()

    def end(self) -> None:
        """No poll comes any more; nobody waits for one."""
        self.running = False
        self._cycled.set()

    def wake(self) -> None:
        """Poll at once."""
        if self._sleeper is not None and not self._sleeper.done():
            self._sleeper.set_result(None)

    async def nap(self, *, moving: bool) -> None:
        """Sleep until the next poll is due, or `wake`.

        A poll that took long brings the next one forward: the controllers count the time between two heartbeats.
        """
        loop = asyncio.get_running_loop()
        self._sleeper = loop.create_future()
        if moving:
            # Never in step with the scans: the phase decides how old the path time is that a read-back shows.
            self._phase = (self._phase + GOLDEN) % 1.0
        due_s = self._polled_s + self._poll_s * (1.0 - SHARE * self._phase)
        timer = loop.call_at(due_s, self.wake)
        try:
            await self._sleeper
        finally:
            timer.cancel()
        self._polled_s = loop.time()
        if self._polled_s >= due_s:
            self.lateness.add(self._polled_s - due_s)

    def cycled(self) -> None:
        """One poll and what follows from it are over."""
        self._cycles += 1
        self._cycled.set()

    async def next_cycle(self) -> None:
        """Wait for a read-back that is asked for after this call."""
        self.wake()
        # One cycle may be under way already.
        due = self._cycles + 2
        while self.running and self._cycles < due:
            self._cycled.clear()
            await self._cycled.wait()
