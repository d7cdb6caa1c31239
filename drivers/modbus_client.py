"""The only importer of pymodbus: one unit behind a strict wrapper. Registers travel as big-endian bytes.

pymodbus connects, numbers and frames the requests. It would accept replies of a wrong length or function, and a reply
with transaction 0 as an answer to anything: here each reply frame is judged as bytes and never reaches its decoder; a
stale reply is dropped. Nothing is sent twice.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Callable

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu import ModbusPDU

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


class _Request(ModbusPDU):
    """A request whose body is ready-made."""

    def __init__(self, function: int, body: bytes, unit: int) -> None:
        super().__init__(dev_id=unit)
        self.function_code = function
        self.body = body

    def encode(self) -> bytes:
        return self.body


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
        self._tapped = b""
        self._address = f"{host}:{port}"
        self._request: _Request | None = None
        self._reply: asyncio.Future[tuple[int, bytes]]
        self._body_bytes = self._skipped = 0
        self.stale_replies = 0
        self._client = AsyncModbusTcpClient(
            host,
            port=port,
            timeout=CONNECT_S,
            retries=0,
            reconnect_delay=0,
            trace_packet=self._inspect,
            trace_connect=self._connection,
        )

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
        if self._request is not None:
            raise RuntimeError(f"{self.where}: a request is already under way")
        if not self.connected:
            raise LinkLost(self.where, "not connected")
        self._request = request = _Request(function, body, self._unit)
        self._body_bytes, self._skipped = body_bytes, 0
        loop = asyncio.get_running_loop()
        self._reply = loop.create_future()
        overdue = loop.call_later(self._timeout_s, lambda: self._fail(self._overdue(function)))
        try:
            await self._client.execute(True, request)
            answered, data = await self._reply
        finally:
            overdue.cancel()
            self._request = None
        if answered != function:
            raise DeviceRefused(self.where, EXCEPTIONS.get(data[0], "unknown exception"), value=data[0])
        return data

    def _overdue(self, function: int) -> DeviceSilent | OutcomeUnknown:
        if function in READS:
            return DeviceSilent(self.where, f"{self._address} did not answer a read", limit=self._timeout_s)
        return OutcomeUnknown(self.where, f"No reply within {self._timeout_s} s.", value=f"write (function {function})")

    def _inspect(self, sending: bool, data: bytes) -> bytes:
        """Let pymodbus send, and keep what comes from it: the answer of the request is taken once it is whole."""
        request = self._request
        if self.tap is not None:
            self._tell(sending, data)
        if sending or request is None:
            return data if sending else b""
        at = 0
        while len(data) - at >= _MBAP.size:
            transaction, protocol, length, unit, function = _MBAP.unpack_from(data, at)
            if protocol != 0 or not 3 <= length <= 254:
                return self._refuse(f"no Modbus TCP frame: {data[at : at + 12].hex(' ')}")
            end: int = at + 6 + length
            if end > len(data):
                break
            if transaction == request.transaction_id:
                body = data[at + _MBAP.size : end]
                complaint = self._complaint(request, unit, function, body)
                return self._refuse(complaint) if complaint else self._take(function, body)
            # The buffer keeps what was skipped until the next request: count each stale frame once.
            if at >= self._skipped:
                self.stale_replies += 1
                self._skipped = end
            at = end
        return b""

    def _tell(self, sent: bool, data: bytes) -> None:
        """Received bytes come again together with those behind them, until a frame is whole."""
        fresh = data[len(self._tapped) :] if not sent and data.startswith(self._tapped) else data
        self._tapped = b"" if sent else data
        if self.tap is not None and fresh:
            self.tap(sent, fresh)

    def _complaint(self, request: _Request, unit: int, function: int, body: bytes) -> str:
        """Why the reply is of the wrong unit, function or length; empty when it fits."""
        if unit != self._unit:
            return f"unit {unit} answered for unit {self._unit}"
        if function == request.function_code | 0x80 and len(body) == 1:
            return ""
        if function != request.function_code:
            return f"function {function} answered for function {request.function_code}"
        counted = function != WRITE
        if len(body) - counted != self._body_bytes or (counted and body[0] != self._body_bytes):
            return f"{len(body) - counted} bytes of data instead of {self._body_bytes}"
        return ""

    def _take(self, function: int, body: bytes) -> bytes:
        if not self._reply.done():
            self._reply.set_result((function, body))
        return b""

    def _refuse(self, complaint: str) -> bytes:
        self._fail(BadReply(self.where, "The connection is not trusted any more.", value=complaint))
        return b""

    def _connection(self, up: bool) -> None:
        if not up:
            self._fail(LinkLost(self.where, f"{self._address} closed the connection"))
            self.on_lost()

    def _fail(self, error: Exception) -> None:
        """End the pending request at once."""
        if self._request is not None and not self._reply.done():
            self._reply.set_exception(error)
