"""A serial line with several Modbus RTU units on it, as the far end of one wire.

Frame: unit u8, function u8, data, CRC-16 (polynomial A001h reflected, start FFFFh, low byte first). It ends where the
line is silent for 3.5 characters. A unit answers only what is whole and meant for it: a damaged frame, one for another
unit and a broadcast (unit 0) get no answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from sim.plc.modbus_tcp import ContactDevice, RegisterDevice, answer
from sim.plc.reply_faults import Answer, ReplyFaults
from sim.wires.pacing import BITS_PER_BYTE, DeviceEnd

LARGEST = 256
FASTEST_GAP_S = 0.00175
"""Above 19200 bits/s the specification keeps this gap."""


_EIGHT_BITS = []
for _remainder in range(256):
    for _ in range(8):
        _remainder = (_remainder >> 1) ^ (0xA001 if _remainder & 1 else 0)
    _EIGHT_BITS.append(_remainder)


def crc16(data: bytes) -> bytes:
    """CRC of `data` as it stands at the end of a frame: "01 03 00 00 00 01" gives "84 0A"."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _EIGHT_BITS[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


def gap_s(baud: int) -> float:
    """Silence that ends a frame: 3.5 characters."""
    return FASTEST_GAP_S if baud > 19200 else 3.5 * BITS_PER_BYTE / baud


class ModbusRtuLine:
    """All units at the end of one line. `turnaround_s` passes between the end of a request and its answer.

    `mangle` may change, drop (empty) or double the bytes of an answer (fault injection).
    """

    def __init__(
        self,
        units: Mapping[int, RegisterDevice],
        end: DeviceEnd,
        baud: int,
        loop: asyncio.AbstractEventLoop,
        turnaround_s: float = 0.001,
        faults: Mapping[int, ReplyFaults] | None = None,
    ) -> None:
        self._units, self._end, self._loop = units, end, loop
        self._faults: Mapping[int, ReplyFaults] = faults or {}
        self._gap_s, self.turnaround_s = gap_s(baud), turnaround_s
        self.mangle: Callable[[bytes], bytes] = lambda frame: frame
        self.damaged = 0
        self._buffer = b""
        self._silence: asyncio.TimerHandle | None = None
        end.on_bytes = self._hear

    def _hear(self, data: bytes) -> None:
        self._buffer += data
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self._loop.call_later(self._gap_s, self._judge)

    def _judge(self) -> None:
        frame, self._buffer = self._buffer, b""
        if not 4 <= len(frame) <= LARGEST or crc16(frame[:-2]) != frame[-2:]:
            self.damaged += 1
            return
        device = self._units.get(frame[0])
        if device is None or (isinstance(device, ContactDevice) and not device.answers):
            return
        unit, function, body = frame[0], frame[1], frame[2:-2]
        faults = self._faults.get(unit)
        if faults is None:
            self._answer(Answer(0, unit, answer(self._units, unit, function, body)))
            return
        for one in faults.answers(0, unit, function, lambda: answer(self._units, unit, function, body)):
            self._answer(one)

    def _answer(self, one: Answer) -> None:
        reply = bytes((one.unit,)) + one.pdu
        frame = bytearray(reply + crc16(reply))
        frame[-3] ^= one.flipped
        whole = self.mangle(bytes(frame[: len(frame) // 2] if one.cut else frame))
        head = len(whole) // 2 if one.apart_s else len(whole)
        after_s = self.turnaround_s + one.late_s
        self._loop.call_later(after_s, self._end.write, whole[:head])
        if one.apart_s:
            self._loop.call_later(after_s + one.apart_s, self._end.write, whole[head:])

    def close(self) -> None:
        """Hear nothing more."""
        if self._silence is not None:
            self._silence.cancel()
        self._end.on_bytes = lambda data: None
