"""The requests of one Modbus unit, whatever wire carries them. Registers travel as big-endian bytes."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable

from docking.errors import BadReply

MAX_READ, MAX_WRITE, MAX_EXCHANGE_WRITE = 125, 123, 121
READ_BITS, READ, READ_INPUTS, WRITE, EXCHANGE = 2, 3, 4, 16, 23
READS = (READ_BITS, READ, READ_INPUTS)
MAX_BITS = 2000
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal register address",
    3: "illegal value",
    4: "device failure",
    5: "accepted, still busy with it",
    6: "device busy",
    7: "negative acknowledge",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "no device behind the gateway answers",
}
_SPAN = struct.Struct(">HH")
_WRITE = struct.Struct(">HHB")
_EXCHANGE = struct.Struct(">HHHHB")


class Requests(ABC):
    """Reads and writes of one unit. Errors are those of the wire's `_ask`, and BadReply where an echo does not fit."""

    where: str

    @abstractmethod
    async def _ask(self, function: int, body: bytes, body_bytes: int) -> bytes:
        """Send one request once; return the data of its reply (with its byte count, where it has one)."""

    async def read(self, address: int, count: int) -> bytes:
        """Read `count` holding registers (function 3)."""
        _check(address, count, MAX_READ)
        reply = await self._ask(READ, _SPAN.pack(address, count), 2 * count)
        return reply[1:]

    async def read_inputs(self, address: int, count: int) -> bytes:
        """Read `count` input registers (function 4)."""
        _check(address, count, MAX_READ)
        reply = await self._ask(READ_INPUTS, _SPAN.pack(address, count), 2 * count)
        return reply[1:]

    async def read_bits(self, address: int, count: int) -> bytes:
        """Read `count` discrete inputs (function 2), eight a byte, the first in the lowest bit."""
        _check(address, count, MAX_BITS)
        reply = await self._ask(READ_BITS, _SPAN.pack(address, count), (count + 7) // 8)
        return reply[1:]

    async def write(self, address: int, data: bytes) -> None:
        """Write registers as one block (function 16); the echoed span is checked."""
        count = len(data) // 2
        _check(address, count, MAX_WRITE)
        echo = await self._ask(WRITE, _WRITE.pack(address, count, len(data)) + data, 4)
        if echo != _SPAN.pack(address, count):
            raise BadReply(self.where, f"the echo names another span than {address}+{count}", value=echo.hex(" "))

    async def exchange(self, write_at: int, data: bytes, read_at: int, count: int) -> bytes:
        """Write one block, then read `count` registers of another, in one transaction (function 23)."""
        _check(read_at, count, MAX_READ)
        _check(write_at, len(data) // 2, MAX_EXCHANGE_WRITE)
        body = _EXCHANGE.pack(read_at, count, write_at, len(data) // 2, len(data)) + data
        reply = await self._ask(EXCHANGE, body, 2 * count)
        return reply[1:]


class RegisterUnit(Requests):
    """A unit with a connection: its own, or a line that it shares. `on_lost` is called when that breaks."""

    on_lost: Callable[[], None]

    @property
    @abstractmethod
    def connected(self) -> bool: ...

    @abstractmethod
    async def connect(self) -> None:
        """Open the connection; PortMissing."""

    @abstractmethod
    def close(self) -> None:
        """Never waits, never raises; `on_lost` is not called."""


def _check(address: int, count: int, most: int) -> None:
    if not (1 <= count <= most and 0 <= address <= 0x10000 - count):
        raise ValueError(f"{count} registers at {address}: outside what one request carries")
