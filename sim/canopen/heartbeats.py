"""Heartbeats of the simulated nodes: they send their own (1017h) and watch the controller's (1016h)."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from sim.canopen.node import Node
from sim.wires.can_frames import CanFrame

_ROUNDING_S = 1e-9


class Heartbeats:
    """One timer for all nodes. `lost(node)` and `returned(node)` tell of the controller's heartbeat.

    `heard_s` is when the controller's heartbeat came last, NaN before the first.
    """

    def __init__(
        self,
        nodes: list[Node],
        loop: asyncio.AbstractEventLoop,
        transmit: Callable[[list[CanFrame]], None],
        lost: Callable[[Node], None],
        returned: Callable[[Node], None],
    ) -> None:
        self._nodes, self._loop, self._transmit = nodes, loop, transmit
        self._lost, self._returned = lost, returned
        self._deadlines: dict[int, float] = {}
        self._gone: set[int] = set()
        self.heard_s = math.nan
        self._timer: asyncio.TimerHandle | None = None

    def produce(self, node: Node, interval_s: float) -> None:
        """A node's own heartbeat was set; 0 stops it."""
        # Nodes with the same interval beat together: one batch on the bus instead of one a node.
        beats = math.floor(self._loop.time() / interval_s) + 1 if interval_s > 0.0 else 0
        node.beat_s, node.next_beat_s = interval_s, beats * interval_s if beats else None
        self._schedule()

    def forget(self, index: int) -> None:
        """A node was reset: it watches nobody."""
        self._deadlines.pop(index, None)
        self._gone.discard(index)

    def heard(self, host: int, listeners: list[Node]) -> None:
        """The controller's heartbeat: monitoring begins with the first one (CiA 301) and is renewed by each."""
        now_s = self.heard_s = self._loop.time()
        begins = False
        for node in listeners:
            if node.host != host:
                continue
            begins = begins or node.index not in self._deadlines
            self._deadlines[node.index] = now_s + node.host_timeout_s
            if node.index in self._gone:
                self._gone.discard(node.index)
                self._returned(node)
        if begins:
            self._schedule()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _schedule(self) -> None:
        self.close()
        due = [node.next_beat_s for node in self._nodes if node.next_beat_s is not None]
        due += list(self._deadlines.values())
        if due:
            self._timer = self._loop.call_at(min(due), self._beat)

    def _beat(self) -> None:
        self._timer = None
        now_s = self._loop.time()
        beats = [node.heartbeat(now_s) for node in self._nodes if node.beat_due(now_s)]
        if beats:
            self._transmit(beats)
        for index, deadline_s in list(self._deadlines.items()):
            if not now_s < deadline_s - _ROUNDING_S:
                del self._deadlines[index]
                self._gone.add(index)
                self._lost(self._nodes[index])
        self._schedule()
