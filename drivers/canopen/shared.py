"""One CAN bus for several drivers: each has an end of its own, opened and closed as if it were alone."""

from __future__ import annotations

from collections.abc import Callable

from docking.ports import CanFrame, CanLink


def _ignore(_: object) -> None:
    """Until a driver listens."""


class SharedCan:
    """Deals the frames of `link` out. The first end gets whole batches as they come, others what they asked for."""

    def __init__(self, link: CanLink) -> None:
        self._link = link
        self._ends: list[SharedEnd] = []
        self._open = False

    def end(self, cobs: frozenset[int] | None = None) -> SharedEnd:
        """A further end: of everything, or of the frames with these identifiers."""
        end = SharedEnd(self, cobs)
        self._ends.append(end)
        return end

    async def open(self) -> None:
        if not self._open:
            self._link.on_frames, self._link.on_lost = self._arrived, self._lost
            await self._link.open()
            self._open = True

    def send(self, frames: list[CanFrame]) -> None:
        self._link.send(frames)

    def closed(self) -> None:
        """An end was closed; the bus is released with the last one."""
        if self._open and not any(end.is_open for end in self._ends):
            self._open = False
            self._link.close()

    def _arrived(self, batch: list[CanFrame]) -> None:
        for end in self._ends:
            if not end.is_open:
                continue
            if end.cobs is None:
                end.on_frames(batch)
            else:
                wanted = [frame for frame in batch if frame[0] in end.cobs]
                if wanted:
                    end.on_frames(wanted)

    def _lost(self, reason: str) -> None:
        self._open = False
        for end in self._ends:
            if end.is_open:
                # Of several buses some may be left: a driver may say its last word to them.
                end.on_lost(reason)
                end.is_open = False


class SharedEnd:
    """`docking.ports.CanLink` on a shared bus."""

    def __init__(self, bus: SharedCan, cobs: frozenset[int] | None) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self.cobs, self.is_open = cobs, False
        self._bus = bus

    async def open(self) -> None:
        await self._bus.open()
        self.is_open = True

    def send(self, frames: list[CanFrame]) -> None:
        if self.is_open:
            self._bus.send(frames)

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            self._bus.closed()
