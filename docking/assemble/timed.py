"""Links that keep how long answers took, for `docking devices`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.ports import ByteSink, CanFrame, CanLink, SerialLink
from drivers.canopen import codec


def _ignore(_: object) -> None:
    """Until the driver sets its own."""


class TimedSerial:
    """A serial link that keeps how long the first byte of each answer took."""

    def __init__(self, link: SerialLink) -> None:
        self._link = link
        self.taken_s: list[float] = []
        self._asked_s: float | None = None
        self.on_bytes: ByteSink = _ignore
        self.on_lost: Callable[[str], None] = _ignore

    async def open(self) -> None:
        self._link.on_bytes, self._link.on_lost = self._arrived, self._lost
        await self._link.open()

    def write(self, data: bytes) -> None:
        self._asked_s = asyncio.get_running_loop().time()
        self._link.write(data)

    def close(self) -> None:
        self._link.close()

    def _arrived(self, data: bytes) -> None:
        if self._asked_s is not None:
            self.taken_s.append(asyncio.get_running_loop().time() - self._asked_s)
            self._asked_s = None
        self.on_bytes(data)

    def _lost(self, reason: str) -> None:
        self.on_lost(reason)


class TimedCan:
    """A CAN link that keeps how long after each SYNC every read-back came."""

    def __init__(self, link: CanLink, cobs: frozenset[int]) -> None:
        self._link, self._cobs = link, cobs
        self.late_s: dict[int, list[float]] = {}
        self._sync_s: float | None = None
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore

    async def open(self) -> None:
        self._link.on_frames, self._link.on_lost = self._arrived, self._lost
        await self._link.open()

    def send(self, frames: list[CanFrame]) -> None:
        if codec.SYNC in frames:
            self._sync_s = asyncio.get_running_loop().time()
        self._link.send(frames)

    def close(self) -> None:
        self._link.close()

    def _arrived(self, batch: list[CanFrame]) -> None:
        now_s = asyncio.get_running_loop().time()
        for cob, _ in batch:
            if cob in self._cobs and self._sync_s is not None:
                self.late_s.setdefault(cob, []).append(now_s - self._sync_s)
        self.on_frames(batch)

    def _lost(self, reason: str) -> None:
        self.on_lost(reason)
