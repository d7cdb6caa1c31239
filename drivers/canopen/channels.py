"""Several CAN buses as one link: what belongs to a node goes to its bus, SYNC and heartbeat go to all of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from functools import partial

from docking.ports import CanFrame, CanLink

_LAST_WORD_S = 0.05
"""How long the other buses stay open after one was lost: what was sent last must leave the adapters."""


def _ignore(_: object) -> None:
    """Until a driver listens."""


class ChannelledCan:
    """`docking.ports.CanLink` over one link a bus; `channel_of` says on which bus a node is.

    Frames of one call leave on all buses before the next is looked at: the SYNCs of one cycle are as near to each other
    as the host can send. A frame that comes from a node on another bus than its own is dropped, so that a drive at the
    wrong cable is silent. When one bus is lost `on_lost` is called while the others still take frames; they are closed
    soon after.
    """

    def __init__(self, links: Mapping[str, CanLink], channel_of: Mapping[int, str]) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self.misplaced: dict[int, str] = {}
        self._links, self._channel_of = dict(links), channel_of
        self._gone: set[str] = set()
        self._open: list[str] = []
        self._whole: list[CanFrame] | None = None
        self._parts: list[tuple[str, list[CanFrame]]] = []
        self._farewell: asyncio.TimerHandle | None = None

    def wrapped(self, wrap: Callable[[str, CanLink], CanLink]) -> ChannelledCan:
        """The same buses, each behind what `wrap(channel, link)` puts before it."""
        return ChannelledCan({name: wrap(name, link) for name, link in self._links.items()}, self._channel_of)

    @property
    def is_open(self) -> bool:
        """True while any of the buses is open."""
        return bool(self._open)

    async def open(self) -> None:
        """Open all buses, or none. Raises PortMissing."""
        self._gone.clear()
        try:
            for name, link in self._links.items():
                link.on_frames, link.on_lost = partial(self._arrived, name), partial(self._lost, name)
                await link.open()
                self._open.append(name)
        except BaseException:
            self.close()
            raise

    def send(self, frames: list[CanFrame]) -> None:
        """One batch, in order on every bus."""
        if frames is not self._whole:
            # While nothing moves the same list comes again and again.
            self._parts, self._whole = self._split(frames), frames
        gone = len(self._gone)
        for name, part in self._parts:
            if name not in self._gone:
                self._links[name].send(part)
            if len(self._gone) != gone:
                # A bus was lost by this very batch: what its driver has said since is not to be overwritten.
                return

    def close(self) -> None:
        if self._farewell is not None:
            self._farewell.cancel()
            self._farewell = None
        opened, self._open = self._open, []
        for name in opened:
            self._links[name].close()

    def _split(self, frames: list[CanFrame]) -> list[tuple[str, list[CanFrame]]]:
        channels = [self._channel(frame) for frame in frames]
        parts = [
            (name, [frame for frame, at in zip(frames, channels, strict=True) if at is None or at == name])
            for name in self._links
        ]
        return [(name, part) for name, part in parts if part]

    def _channel(self, frame: CanFrame) -> str | None:
        """The bus of a frame; None for all of them."""
        cob, data = frame
        node = (data[1] if len(data) == 2 else 0) if cob == 0 else cob & 0x7F
        return self._channel_of.get(node)

    def _arrived(self, name: str, batch: list[CanFrame]) -> None:
        if all(self._channel_of.get(cob & 0x7F, name) == name for cob, _ in batch):
            self.on_frames(batch)
            return
        ours = []
        for cob, data in batch:
            if self._channel_of.get(cob & 0x7F, name) == name:
                ours.append((cob, data))
            else:
                self.misplaced[cob & 0x7F] = name
        if ours:
            self.on_frames(ours)

    def _lost(self, name: str, reason: str) -> None:
        first = not self._gone
        self._gone.add(name)
        if name in self._open:
            self._open.remove(name)
        if first:
            self.on_lost(f"{name}: {reason}")
            self._farewell = asyncio.get_running_loop().call_later(_LAST_WORD_S, self.close)
