"""Replays a transcript to a driver: what a device answered then comes again after what the driver sends now."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from docking.ports import ByteSink, CanFrame
from docking.transcript import Line


def _ignore(_: object) -> None:
    """Until the driver sets its own."""


class _Recorded:
    """The lines of one wire. What came after the n-th sent line comes again, as late as it came, after the n-th send.

    `differences` lists (number, recorded, sent) where the driver sends something else than it did then.
    """

    def __init__(self, lines: Sequence[Line], wire: str, deliver: Callable[[Line], None]) -> None:
        self._lines = [line for line in lines if line.wire == wire]
        self._deliver = deliver
        self._at = self._sends = 0
        self.differences: list[tuple[int, bytes, bytes]] = []

    def begin(self) -> None:
        """The wire is open: what came before anything was sent."""
        self._follow(self._lines[0].t_s if self._lines else 0.0)

    def sent(self, cob: int | None, data: bytes) -> None:
        """The driver sends; skips to the next recorded send, then plays what followed it."""
        while self._at < len(self._lines) and not self._lines[self._at].sent:
            self._at += 1
        if self._at >= len(self._lines):
            return
        then = self._lines[self._at]
        if (then.cob, then.data) != (cob, data):
            self.differences.append((self._sends, then.data, data))
        self._at, self._sends = self._at + 1, self._sends + 1
        self._follow(then.t_s)

    def _follow(self, from_s: float) -> None:
        loop = asyncio.get_running_loop()
        while self._at < len(self._lines) and not self._lines[self._at].sent:
            line = self._lines[self._at]
            loop.call_at(loop.time() + line.t_s - from_s, self._deliver, line)
            self._at += 1


class ReplayedSerial:
    """`docking.ports.SerialLink` that a transcript stands behind."""

    def __init__(self, lines: Sequence[Line], wire: str) -> None:
        self.on_bytes: ByteSink = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._recorded = _Recorded(lines, wire, lambda line: self.on_bytes(line.data))

    @property
    def differences(self) -> list[tuple[int, bytes, bytes]]:
        """Where the driver sent something else than it did then."""
        return self._recorded.differences

    async def open(self) -> None:
        self._recorded.begin()

    def write(self, data: bytes) -> None:
        self._recorded.sent(None, data)

    def close(self) -> None:
        """Nothing is held."""


class ReplayedCan:
    """`docking.ports.CanLink` that a transcript stands behind."""

    def __init__(self, lines: Sequence[Line], wire: str = "can") -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._recorded = _Recorded(lines, wire, lambda line: self.on_frames([(line.cob or 0, line.data)]))

    @property
    def differences(self) -> list[tuple[int, bytes, bytes]]:
        """Where the driver sent something else than it did then."""
        return self._recorded.differences

    async def open(self) -> None:
        self._recorded.begin()

    def send(self, frames: list[CanFrame]) -> None:
        for cob, data in frames:
            self._recorded.sent(cob, data)

    def close(self) -> None:
        """Nothing is held."""
