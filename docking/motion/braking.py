"""Closing the brakes of streamed axes: not before the axes stand, and not later than a ramp should take."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.errors import DockingError, EnableFailed, LinkError
from docking.ports import StreamedPositioners


class Braking:
    """Brakes once a time. `failed` hears why brakes are not confirmed; they then stay unconfirmed."""

    def __init__(self, bus: StreamedPositioners, failed: Callable[[DockingError], None]) -> None:
        self._bus, self._failed = bus, failed
        self._task: asyncio.Task[None] | None = None
        self._due_s = float("inf")
        self.confirmed = False

    def begin(self, due_s: float, *, standing: bool) -> None:
        """Brake as soon as the axes stand, at the latest at `due_s` (loop time)."""
        self.confirmed, self._task, self._due_s = False, None, due_s
        if standing:
            self._start()

    @property
    def waits(self) -> bool:
        """Whether brakes are to close and have not begun to."""
        return self._task is None

    def cycle(self, standing: bool) -> None:
        """One cycle on. An axis that does not come to rest by itself is what a brake is for."""
        if self.waits and (standing or not (asyncio.get_running_loop().time() < self._due_s)):
            self._start()

    async def cancel(self) -> None:
        """Do not wait for brakes any longer."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._brake())

    async def _brake(self) -> None:
        try:
            await self._bus.brake()
            self.confirmed = True
        except (EnableFailed, LinkError) as error:
            # The arbiter opens the hardware chain when the time for braking is over.
            self._failed(error)
