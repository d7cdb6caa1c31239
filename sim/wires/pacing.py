"""The speed of a serial line: bytes arrive when their last bit has, at 10 bits a byte (8N1) where nothing is said."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

BITS_PER_BYTE = 10


def character_bits(framing: str) -> int:
    """Bits of one character with its start bit: "8N1" has 10, "8E1" 11."""
    return 1 + int(framing[0]) + (framing[1] != "N") + int(framing[2])


class DeviceEnd(Protocol):
    """What a simulated serial device holds of its wire: bytes out by `write`, bytes in by `on_bytes`."""

    on_bytes: Callable[[bytes], None]

    def write(self, data: bytes) -> None: ...


class SpeedEnd(DeviceEnd, Protocol):
    """The device's end of a line whose speed the device can change; `on_break` is called when the host sends one."""

    on_break: Callable[[], None]

    def set_baud(self, baud: int) -> None: ...


class PacedChannel:
    """One direction of a line: chunks queue behind each other, each delivered whole when its last byte is through."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        baud: int,
        deliver: Callable[[bytes], None],
        bits: int = BITS_PER_BYTE,
    ) -> None:
        self._loop, self._deliver, self._bits = loop, deliver, bits
        self._byte_s = bits / baud
        self._free_at_s = 0.0
        self._epoch = 0

    def send(self, data: bytes) -> None:
        """Put `data` on the line; the loop delivers it after the bytes ahead of it and its own."""
        if data:
            self._free_at_s = max(self._loop.time(), self._free_at_s) + len(data) * self._byte_s
            self._loop.call_at(self._free_at_s, self._arrive, data, self._epoch)

    def set_baud(self, baud: int) -> None:
        """Change the speed for what is sent from now on."""
        self._byte_s = self._bits / baud

    def cut(self) -> None:
        """Lose every byte that is still under way."""
        self._epoch += 1
        self._free_at_s = 0.0

    def _arrive(self, data: bytes, epoch: int) -> None:
        if epoch == self._epoch:
            self._deliver(data)
