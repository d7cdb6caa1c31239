"""Modbus RTU: several units on one serial line behind the strict wrapper, one request on the wire at a time.

Frame: unit u8, function u8, data, CRC-16 (polynomial A001h reflected, start FFFFh, low byte first), silence of 3.5
characters on both sides. Such frames carry no number, so a late answer of the request before would pass for the answer
to this one: after any failure the line stays silent for as long as a unit may still answer, what came in is thrown
away, and only then goes the next request out. Nothing is sent twice.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.errors import BadReply, DeviceRefused, DeviceSilent, DockingError, LinkLost, OutcomeUnknown
from docking.ports import SerialLink
from drivers.modbus_requests import EXCEPTIONS, READS, WRITE, RegisterUnit

CHARACTER_BITS = 11
"""A start bit, eight data bits, a parity or a second stop bit, a stop bit: the longest character in use."""
LONGEST_BYTES = 256
FASTEST_GAP_S = 0.00175
FASTEST_BAUD = 19200
"""Above this speed the gap stays as it is."""


def _shifted(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ 0xA001 * (byte & 1)
    return byte


_SHIFTED = tuple(map(_shifted, range(256)))


def crc16(data: bytes) -> int:
    """CRC of a frame, to be sent low byte first: "01 04 02 FF FF" gives 80B8h, sent as B8 80."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _SHIFTED[(crc ^ byte) & 0xFF]
    return crc


def gap_s(baud: int) -> float:
    """Least silence (s) between two frames."""
    return FASTEST_GAP_S if baud > FASTEST_BAUD else 3.5 * CHARACTER_BITS / baud


def exchange_s(baud: int, request_bytes: int, reply_bytes: int, turnaround_s: float) -> float:
    """Time (s) on the wire of one request with its reply: both frames, two gaps, the unit's turnaround."""
    return CHARACTER_BITS * (request_bytes + reply_bytes) / baud + 2.0 * gap_s(baud) + turnaround_s


class RtuLine:
    """One serial line at `baud`. Construct it inside the running loop.

    A request waits for its turn, then `timeout_s` plus the time that both frames take at this speed for its answer.
    """

    def __init__(self, link: SerialLink, where: str, baud: int, timeout_s: float) -> None:
        self._link, self.where, self._baud, self._timeout_s = link, where, baud, timeout_s
        self._turn = asyncio.Lock()
        self._buffer = b""
        self._whole_bytes = 0
        self._waiting: asyncio.Future[bytes] | None = None
        self._free_s = float("-inf")
        self._users: list[RtuUnit] = []
        self.is_open = False
        self.flushed_bytes = 0
        link.on_bytes, link.on_lost = self._hear, self._lost

    def unit(self, where: str, number: int) -> RtuUnit:
        """The unit `number` (1..247) of this line."""
        return RtuUnit(self, where, number)

    async def join(self, user: RtuUnit) -> None:
        """Open the port once for all units; PortMissing."""
        if user not in self._users:
            self._users.append(user)
        async with self._turn:
            if not self.is_open:
                await self._link.open()
                self.is_open = True
                # Whoever used the line before may have left a request behind that is still to be answered.
                self._free_s = asyncio.get_running_loop().time() + self._longest_s()

    def leave(self, user: RtuUnit) -> None:
        """`user` is done with the line; the last one closes it."""
        self._users = [other for other in self._users if other is not user]
        if not self._users:
            self._end(LinkLost(self.where, "closed"))
            self.is_open = False
            self._link.close()

    def distrust(self) -> None:
        """What answered was not who was asked: let everything run out before the next request."""
        self._free_s = asyncio.get_running_loop().time() + self._longest_s()

    def _longest_s(self) -> float:
        """How long a unit may still be answering."""
        return self._timeout_s + CHARACTER_BITS * LONGEST_BYTES / self._baud

    async def ask(self, frame: bytes, reply_bytes: int) -> bytes:
        """Send `frame` (unit to data), return the reply of as many bytes, or an exception reply, without its CRC.

        Raises DeviceSilent when nothing came or it came damaged, LinkLost.
        """
        async with self._turn:
            if not self.is_open:
                raise LinkLost(self.where, "not open")
            await self._silence()
            self.flushed_bytes += len(self._buffer)
            self._buffer, self._whole_bytes = b"", reply_bytes + 2
            loop = asyncio.get_running_loop()
            self._waiting = loop.create_future()
            patience_s = round(self._timeout_s + exchange_s(self._baud, len(frame) + 2, reply_bytes + 2, 0.0), 4)
            failed = True
            try:
                self._link.write(frame + crc16(frame).to_bytes(2, "little"))
                reply = await asyncio.wait_for(self._waiting, patience_s)
                failed = crc16(reply[:-2]) != int.from_bytes(reply[-2:], "little")
                if failed:
                    raise DeviceSilent(self.where, f"the answer of unit {frame[0]} was damaged", limit=patience_s)
                return reply[:-2]
            except TimeoutError:
                raise DeviceSilent(self.where, f"unit {frame[0]} did not answer", limit=patience_s) from None
            finally:
                self._waiting = None
                # A unit that has not answered in time may still do so: as long again nobody speaks.
                self._free_s = loop.time() + (patience_s if failed else gap_s(self._baud))

    async def _silence(self) -> None:
        left_s = self._free_s - asyncio.get_running_loop().time()
        if left_s > 0.0:
            await asyncio.sleep(left_s)

    def _hear(self, data: bytes) -> None:
        self._buffer += data
        waiting = self._waiting
        if waiting is None or waiting.done() or len(self._buffer) < 2:
            return
        whole = 5 if self._buffer[1] & 0x80 else self._whole_bytes
        if len(self._buffer) >= whole:
            waiting.set_result(self._buffer)
            self._buffer = b""

    def _lost(self, reason: str) -> None:
        self.is_open = False
        self._end(LinkLost(self.where, reason))
        for user in self._users:
            user.on_lost()

    def _end(self, error: DockingError) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(error)


class RtuUnit(RegisterUnit):
    """One unit of a line, with the requests and errors of `drivers.modbus_client.ModbusUnit`."""

    def __init__(self, line: RtuLine, where: str, number: int) -> None:
        self.where, self._line, self._number = where, line, number
        self.on_lost: Callable[[], None] = lambda: None

    @property
    def connected(self) -> bool:
        return self._line.is_open

    async def connect(self) -> None:
        """Open the line if nobody has; PortMissing."""
        await self._line.join(self)

    def close(self) -> None:
        """Leave the line; the last unit closes it."""
        self.on_lost = lambda: None
        self._line.leave(self)

    async def _ask(self, function: int, body: bytes, body_bytes: int) -> bytes:
        counted = function != WRITE
        frame = bytes((self._number, function)) + body
        try:
            reply = await self._line.ask(frame, 2 + counted + body_bytes)
        except DeviceSilent as silence:
            if function in READS:
                raise DeviceSilent(self.where, str(silence.cause), limit=silence.limit) from None
            cause = f"No good reply within {silence.limit} s."
            raise OutcomeUnknown(self.where, cause, value=f"write (function {function})") from None
        unit, answered, data = reply[0], reply[1], reply[2:]
        complaint = ""
        if unit != self._number:
            complaint = f"unit {unit} answered for unit {self._number}"
        elif answered & 0x7F != function:
            complaint = f"function {answered} answered for function {function}"
        elif answered == function and (len(data) != counted + body_bytes or (counted and data[0] != body_bytes)):
            complaint = f"{len(data) - counted} bytes of data instead of {body_bytes}"
        if complaint:
            self._line.distrust()
            raise BadReply(self.where, "The answer is not taken.", value=complaint)
        if answered != function:
            raise DeviceRefused(self.where, EXCEPTIONS.get(data[0], "unknown exception"), value=data[0])
        return data
