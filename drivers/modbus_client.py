"""The only importer of pymodbus: one unit behind a strict wrapper. Registers travel as big-endian bytes.

pymodbus connects and carries bytes. It would take replies of a wrong length or function, and a reply with transaction 0
for the answer to anything: here each request is numbered and framed, each reply frame judged as bytes, and none reaches
its decoder; a stale reply is dropped. Nothing is sent twice.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Callable
from typing import cast

from pymodbus.client import AsyncModbusTcpClient

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkLost, OutcomeUnknown, PortMissing
from drivers.modbus_requests import EXCEPTIONS, READS, WRITE, RegisterUnit

# pymodbus logs the whole frame history on each error; every error is raised by name here.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)

CONNECT_S = 2.0
_MBAP = struct.Struct(">HHHBB")

Tap = Callable[[str, bool, bytes], None]
"""Hears (name of the device, whether it was sent, bytes)."""


def tapped(tap: Tap | None, name: str) -> Callable[[bool, bytes], None] | None:
    """`tap` for the device `name`."""
    if tap is None:
        return None
    hear = tap
    return lambda sent, data: hear(name, sent, data)


class ModbusUnit(RegisterUnit):
    """One unit at `host`:`port`. Construct it inside the running loop; one request at a time.

    Every request ends within `timeout_s`: DeviceSilent for a read, OutcomeUnknown for anything that writes,
    DeviceRefused on an exception reply, BadReply on a reply that does not fit, LinkLost when the connection breaks.
    `on_lost` is called when the connection breaks, whether a request waits or not; `tap(sent, data)`, where it is set,
    hears all bytes.
    """

    def __init__(self, where: str, host: str, port: int, unit: int, timeout_s: float) -> None:
        self.where, self._unit, self._timeout_s = where, unit, timeout_s
        self.on_lost: Callable[[], None] = lambda: None
        self.tap: Callable[[bool, bytes], None] | None = None
        self._address = f"{host}:{port}"
        self._asked = self._number = 0
        self._reply: asyncio.Future[tuple[int, bytes]]
        self._body_bytes = 0
        self._buffer = b""
        self.stale_replies = 0
        self._client = AsyncModbusTcpClient(
            host,
            port=port,
            timeout=CONNECT_S,
            retries=0,
            reconnect_delay=0,
            trace_connect=self._connection,
        )
        # Bytes go past its own parsing and its log, which cost as much as the rest of an exchange.
        self._wire = self._client.ctx
        self._wire.data_received = self._received  # type: ignore[method-assign]

    @property
    def connected(self) -> bool:
        return bool(self._client.connected)

    async def connect(self) -> None:
        """Open the connection; PortMissing when nobody listens."""
        if not await self._client.connect():
            raise PortMissing(self.where, f"no Modbus TCP server answered within {CONNECT_S} s", value=self._address)

    def close(self) -> None:
        self.on_lost = lambda: None
        self._client.close()

    async def _ask(self, function: int, body: bytes, body_bytes: int) -> bytes:
        """Send one request; return the body of its reply, which carries `body_bytes` of data."""
        if self._asked:
            raise RuntimeError(f"{self.where}: a request is already under way")
        if not self.connected:
            raise LinkLost(self.where, "not connected")
        self._asked, self._body_bytes, self._buffer = function, body_bytes, b""
        self._number = self._number % 0xFFFF + 1
        loop = asyncio.get_running_loop()
        self._reply = loop.create_future()
        overdue = loop.call_later(self._timeout_s, self._fail_overdue)
        frame = _MBAP.pack(self._number, 0, len(body) + 2, self._unit, function) + body
        try:
            if self.tap is not None:
                self.tap(True, frame)
            cast(asyncio.WriteTransport, self._wire.transport).write(frame)
            answered, data = await self._reply
        finally:
            overdue.cancel()
            self._asked = 0
        if answered != function:
            raise DeviceRefused(self.where, EXCEPTIONS.get(data[0], "unknown exception"), value=data[0])
        return data

    def _fail_overdue(self) -> None:
        self._fail(self._overdue(self._asked))

    def _overdue(self, function: int) -> DeviceSilent | OutcomeUnknown:
        if function in READS:
            return DeviceSilent(self.where, f"{self._address} did not answer a read", limit=self._timeout_s)
        return OutcomeUnknown(self.where, f"No reply within {self._timeout_s} s.", value=f"write (function {function})")

    def _received(self, data: bytes) -> None:
        """Take what has arrived; what is no whole frame yet waits for the rest, nobody waits for what was not asked."""
        if self.tap is not None:
            self.tap(False, data)
        if self._asked:
            buffer = self._buffer + data
            self._buffer = buffer[self._judge(buffer) :]

    def _judge(self, data: bytes) -> int:
        """Look for the answer among whole frames; frames of other numbers are stale. Returns the bytes judged."""
        at = 0
        while len(data) - at >= _MBAP.size:
            transaction, protocol, length, unit, function = _MBAP.unpack_from(data, at)
            if protocol != 0 or not 3 <= length <= 254:
                self._refuse(f"no Modbus TCP frame: {data[at : at + 12].hex(' ')}")
                return len(data)
            end: int = at + 6 + length
            if end > len(data):
                break
            if transaction == self._number:
                body = data[at + _MBAP.size : end]
                complaint = self._complaint(unit, function, body)
                if complaint:
                    self._refuse(complaint)
                elif not self._reply.done():
                    self._reply.set_result((function, body))
                return len(data)
            self.stale_replies += 1
            at = end
        return at

    def _complaint(self, unit: int, function: int, body: bytes) -> str:
        """Why the reply is of the wrong unit, function or length; empty when it fits."""
        if unit != self._unit:
            return f"unit {unit} answered for unit {self._unit}"
        if function == self._asked | 0x80 and len(body) == 1:
            return ""
        if function != self._asked:
            return f"function {function} answered for function {self._asked}"
        counted = function != WRITE
        if len(body) - counted != self._body_bytes or (counted and body[0] != self._body_bytes):
            return f"{len(body) - counted} bytes of data instead of {self._body_bytes}"
        return ""

    def _refuse(self, complaint: str) -> None:
        self._fail(BadReply(self.where, "The connection is not trusted any more.", value=complaint))

    def _connection(self, up: bool) -> None:
        if not up:
            self._fail(LinkLost(self.where, f"{self._address} closed the connection"))
            self.on_lost()

    def _fail(self, error: Exception) -> None:
        """End the pending request at once."""
        if self._asked and not self._reply.done():
            self._reply.set_exception(error)
