"""A Modbus TCP server as a PLC has it: pipelined requests, exceptions, unit ids.

Frame: transaction u16, protocol u16 = 0, length u16, unit u8, function u8, data; all big-endian.
Functions 3, 4 (read), 6, 16 (write), 23 (write, then read) on one table of registers a unit; function 2 (read bits)
where the unit has discrete inputs.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Mapping
from typing import Protocol, cast, runtime_checkable

from sim.plc.reply_faults import Answer, ReplyFaults

_HEADER = struct.Struct(">HHHBB")
_SPAN = struct.Struct(">HH")
_WRITE = struct.Struct(">HHB")
_READ_WRITE = struct.Struct(">HHHHB")

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, NO_SUCH_UNIT = 1, 2, 3, 11
MAX_READ, MAX_WRITE, MAX_READ_WRITE, MAX_BITS = 125, 123, 121, 2000


class ModbusRefusal(Exception):
    """The request is answered with exception `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class RegisterDevice(Protocol):
    """Holding registers of one unit; both methods may raise ModbusRefusal."""

    def read(self, address: int, count: int) -> bytes:
        """Return `count` registers from `address`, 2 bytes each, big-endian."""
        ...

    def write(self, address: int, data: bytes) -> None:
        """Write the registers in `data` (2 bytes each, big-endian) from `address` on, as one act."""
        ...


@runtime_checkable
class ContactDevice(Protocol):
    """A unit with discrete inputs; it may be cut off, so that nothing answers for it."""

    @property
    def answers(self) -> bool: ...

    def bits(self, address: int, count: int) -> bytes:
        """`count` discrete inputs from `address`, eight a byte, the first in the lowest bit."""
        ...


def _checked(count: int, most: int) -> int:
    if not 1 <= count <= most:
        raise ModbusRefusal(ILLEGAL_VALUE)
    return count


def _payload(body: bytes, start: int, count: int, declared: int) -> bytes:
    data = body[start:]
    if not len(data) == declared == 2 * count:
        raise ModbusRefusal(ILLEGAL_VALUE)
    return data


def _read(device: RegisterDevice, body: bytes) -> bytes:
    address, count = _SPAN.unpack(body)
    data = device.read(address, _checked(count, MAX_READ))
    return bytes((len(data),)) + data


def _read_bits(device: RegisterDevice, body: bytes) -> bytes:
    if not isinstance(device, ContactDevice):
        raise ModbusRefusal(ILLEGAL_FUNCTION)
    address, count = _SPAN.unpack(body)
    data = device.bits(address, _checked(count, MAX_BITS))
    return bytes((len(data),)) + data


def _write_one(device: RegisterDevice, body: bytes) -> bytes:
    address, _value = _SPAN.unpack(body)
    device.write(address, body[2:4])
    return body


def _write(device: RegisterDevice, body: bytes) -> bytes:
    address, count, declared = _WRITE.unpack_from(body)
    device.write(address, _payload(body, 5, _checked(count, MAX_WRITE), declared))
    return body[:4]


def _read_write(device: RegisterDevice, body: bytes) -> bytes:
    read_at, read_count, write_at, write_count, declared = _READ_WRITE.unpack_from(body)
    _checked(read_count, MAX_READ)
    device.write(write_at, _payload(body, 9, _checked(write_count, MAX_READ_WRITE), declared))
    data = device.read(read_at, read_count)
    return bytes((len(data),)) + data


_FUNCTIONS = {2: _read_bits, 3: _read, 4: _read, 6: _write_one, 16: _write, 23: _read_write}


def answer(units: Mapping[int, RegisterDevice], unit: int, function: int, body: bytes) -> bytes:
    """Return the reply (function code and data) to one request."""
    try:
        device = units.get(unit)
        if device is None:
            raise ModbusRefusal(NO_SUCH_UNIT)
        handler = _FUNCTIONS.get(function)
        if handler is None:
            raise ModbusRefusal(ILLEGAL_FUNCTION)
        return bytes((function,)) + handler(device, body)
    except ModbusRefusal as refusal:
        return bytes((function | 0x80, refusal.code))
    except struct.error:
        return bytes((function | 0x80, ILLEGAL_VALUE))


@runtime_checkable
class Forgetful(Protocol):
    """A unit that hears of every connection that is opened."""

    def opened(self) -> None: ...


class ModbusTcpConnection(asyncio.Protocol):
    """One client connection to a host that holds `units` (unit id -> registers); `tap(by client, bytes)` hears it.

    `faults` are those of units that may have some.
    """

    def __init__(
        self,
        units: Mapping[int, RegisterDevice],
        connections: set[ModbusTcpConnection],
        tap: Callable[[bool, bytes], None] = lambda sent, data: None,
        faults: Mapping[int, ReplyFaults] | None = None,
    ) -> None:
        self._units, self._connections, self._tap = units, connections, tap
        self._faults: Mapping[int, ReplyFaults] = faults or {}
        self._buffer = b""
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._connections.add(self)
        for device in self._units.values():
            if isinstance(device, Forgetful):
                device.opened()

    def connection_lost(self, exc: Exception | None) -> None:
        self._connections.discard(self)

    def close(self) -> None:
        self._transport.close()

    def serves(self, device: RegisterDevice) -> bool:
        return device in self._units.values()

    def data_received(self, data: bytes) -> None:
        self._tap(True, data)
        buffer = self._buffer + data
        replies: list[bytes] = []
        at = 0
        while len(buffer) - at >= 8:
            transaction, protocol, length, unit, function = _HEADER.unpack_from(buffer, at)
            if protocol != 0 or not 2 <= length <= 254:
                self._transport.close()
                return
            end = at + 6 + length
            if end > len(buffer):
                break
            device = self._units.get(unit)
            if getattr(device, "answers", True):
                replies += self._replies(transaction, unit, function, buffer[at + 8 : end])
            at = end
        self._buffer = buffer[at:]
        if replies:
            self._send(b"".join(replies))

    def _replies(self, transaction: int, unit: int, function: int, body: bytes) -> list[bytes]:
        """What goes back at once; what a fault delays goes later."""
        faults = self._faults.get(unit)
        if faults is None:
            return [_framed(Answer(transaction, unit, answer(self._units, unit, function, body)))]
        frames = []
        loop = asyncio.get_running_loop()
        for one in faults.answers(transaction, unit, function, lambda: answer(self._units, unit, function, body)):
            frame = _framed(one)
            head = len(frame) // 2 if one.apart_s else len(frame)
            if one.late_s:
                loop.call_later(one.late_s, self._send, frame[:head])
            else:
                frames.append(frame[:head])
            if one.apart_s:
                loop.call_later(one.late_s + one.apart_s, self._send, frame[head:])
        return frames

    def _send(self, data: bytes) -> None:
        if not self._transport.is_closing():
            self._tap(False, data)
            self._transport.write(data)


def _framed(one: Answer) -> bytes:
    frame = struct.pack(">HHHB", one.transaction, 0, len(one.pdu) + 1, one.unit) + one.pdu
    return frame[: len(frame) // 2] if one.cut else frame
