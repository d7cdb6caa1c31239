"""Who else leads the axes of a bus: listened for before the first frame is sent."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Final

from docking.errors import LinkLost
from docking.ports import CanFrame, CanLink
from drivers.canopen import codec
from drivers.canopen.nodes import AxisNode

_SET_POINTS: Final = (0x200, 0x300, 0x400, 0x500)
"""Identifiers of the set-points to a node, without its number (CiA 301, predefined connection set)."""
SETTLE_BEATS, BEATS = 0.5, 2.0
"""Heartbeats for which nothing counts yet, a controller that has just ended may have left frames on the wire; and for
which it is listened then: one may be on the way."""


class Company:
    """What another controller of the axes `nodes` would send: network commands, the heartbeat of `host_node`,
    set-points. SYNC alone is none: a drive may be set to send it until the bring-up tells it not to."""

    def __init__(self, nodes: Sequence[AxisNode], host_node: int) -> None:
        self._signs = {0x000: "network commands", codec.COB_HEARTBEAT + host_node: f"the heartbeat of node {host_node}"}
        self._signs |= {base + node.node: f"set-points to {node.name}" for base in _SET_POINTS for node in nodes}
        self._heard: str | None = None

    async def require_none(self, link: CanLink, heartbeat_s: float, where: str) -> None:
        """Listen on the open `link`; its `on_frames` is as before afterwards. Raises LinkLost."""
        before, link.on_frames = link.on_frames, lambda batch: None
        try:
            await asyncio.sleep(SETTLE_BEATS * heartbeat_s)
            link.on_frames = self._take
            await asyncio.sleep(BEATS * heartbeat_s)
        finally:
            link.on_frames = before
        if self._heard is not None:
            raise LinkLost(where, f"Another controller runs it, nothing was sent: {self._heard} heard.")

    def _take(self, batch: list[CanFrame]) -> None:
        for cob, _ in batch:
            self._heard = self._heard or self._signs.get(cob)
