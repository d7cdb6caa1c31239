"""The drives' watchdogs (1016h), seen to act: the heartbeat is withheld until each drive says that it misses it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from docking.errors import WatchdogUnproved
from drivers.canopen.cia402 import DriveState
from drivers.canopen.cyclic import CyclicImage
from drivers.canopen.watch import NodeWatch

MARGIN = 1.1
"""A drive may miss the heartbeat this much later than it was told: its own clock, its own cycle."""
_UNDER_TORQUE = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)


class WatchdogProof:
    """All nodes of `image`; `host_lost` is the emergency code of a drive that misses the controller, `timeout_s` what
    1016h was told."""

    def __init__(self, image: CyclicImage, watch: NodeWatch, host_lost: int, timeout_s: float, cycle_s: float) -> None:
        self._image, self._watch, self._host_lost = image, watch, host_lost
        self._limit_s = MARGIN * timeout_s + 2.0 * cycle_s

    def require_still(self) -> None:
        """Raises WatchdogUnproved where an axis is under torque or its brake is open: it might move."""
        for node in self._image.nodes:
            if self._image.state(node.index) in _UNDER_TORQUE:
                raise self._unproved(node.name, "the axis is enabled, so it was not tried")
            if node.powered and not self._image.brake_closed(node.index):
                raise self._unproved(node.name, "its brake is not reported closed, so it was not tried")

    async def run(self, step: Callable[[], Awaitable[None]], beat_s: Callable[[], float]) -> dict[str, float]:
        """Wait for every drive; seconds from the last heartbeat (`beat_s`, loop time) until each said that it is gone.

        Raises WatchdogUnproved for the first axis that does not, and what `step` raises.
        """
        loop, names = asyncio.get_running_loop(), {node.index: node.name for node in self._image.nodes}
        took: dict[str, float] = {}
        while len(took) < len(names):
            silent_s = loop.time() - beat_s()
            for index, code in self._watch.reported:
                if code == self._host_lost:
                    took.setdefault(names[index], silent_s)
            waiting = [name for name in names.values() if name not in took]
            if waiting and not (silent_s <= self._limit_s):
                cause = "object 1016h:01 reads right, but a pause of the heartbeat has no effect"
                raise self._unproved(waiting[0], cause)
            await step()
        return {name: took[name] for name in names.values()}

    def _unproved(self, name: str, cause: str) -> WatchdogUnproved:
        return WatchdogUnproved(name, cause, limit=self._limit_s)
