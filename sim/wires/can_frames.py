"""CAN frames on simulated wires: the device's end of a bus, time on the wire, the 16-byte record of Linux."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, Protocol

CanFrame = tuple[int, bytes]
"""(11-bit identifier, up to 8 data bytes)."""

WIRE_BITS: Final = tuple(47 + 8 * n + (33 + 8 * n) // 4 for n in range(9))
"""Longest frame of n data bytes, 11-bit identifier: stuffing at its worst, the gap of 3 bits included."""

_RECORD: Final = struct.Struct("=IB3x8s")
RECORD_BYTES: Final = _RECORD.size


class CanEnd(Protocol):
    """One end of a bus as a simulated device sees it."""

    on_frames: Callable[[list[CanFrame]], None]

    def send(self, frames: list[CanFrame]) -> None: ...


def wire_time_s(frames: list[CanFrame], bitrate: int) -> float:
    """Longest time these frames take one after the other."""
    return sum([WIRE_BITS[len(data)] for _, data in frames]) / bitrate


def pack(frame: CanFrame) -> bytes:
    """`struct can_frame`: identifier, length, data."""
    cob, data = frame
    return _RECORD.pack(cob, len(data), data)


def unpack(record: bytes) -> CanFrame | None:
    """A data frame with an 11-bit identifier; None for anything else."""
    if len(record) != RECORD_BYTES:
        return None
    cob, length, data = _RECORD.unpack(record)
    if cob > 0x7FF or length > 8:
        return None
    return cob, data[:length]
