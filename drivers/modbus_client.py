"""The only importer of pymodbus: one unit behind a strict wrapper. Registers travel as big-endian bytes.

pymodbus accepts replies of a wrong length or function, and a reply with transaction 0 as an answer to anything. Here
each reply frame is checked as bytes before pymodbus decodes it; a stale reply is dropped. Nothing is sent twice.
"""

from __future__ import annotations

import logging
import struct

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusIOException
from pymodbus.pdu import ExceptionResponse, ModbusPDU

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkLost, OutcomeUnknown, PortMissing

# pymodbus logs the whole frame history on each error; every error is raised by name here.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)

CONNECT_S = 2.0
MAX_READ, MAX_WRITE, MAX_EXCHANGE_WRITE = 125, 123, 121
READ, WRITE, EXCHANGE = 3, 16, 23
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
_MBAP = struct.Struct(">HHHBB")
_SPAN = struct.Struct(">HH")
_WRITE = struct.Struct(">HHB")
_EXCHANGE = struct.Struct(">HHHHB")
_NEVER = 1 << 30
"""Unanswered requests after which pymodbus may close the connection by itself."""


class _Request(ModbusPDU):
    """A request whose body is ready-made."""

    def __init__(self, function: int, body: bytes, unit: int) -> None:
        super().__init__(dev_id=unit)
        self.function_code = function
        self.body = body

    def encode(self) -> bytes:
        return self.body


class _Reply(ModbusPDU):
    """A reply whose body stays bytes."""

    body = b""

    def decode(self, data: bytes) -> None:
        self.body = bytes(data)

    def __str__(self) -> str:
        return f"function {self.function_code}: {self.body.hex(' ')}"


class _ReadReply(_Reply):
    function_code = READ


class _WriteReply(_Reply):
    function_code = WRITE


class _ExchangeReply(_Reply):
    function_code = EXCHANGE


_REPLIES = {READ: _ReadReply, WRITE: _WriteReply, EXCHANGE: _ExchangeReply}


class ModbusUnit:
    """One unit at `host`:`port`. Construct it inside the running loop; one request at a time.

    Every request ends within `timeout_s`: DeviceSilent for a read, OutcomeUnknown for anything that writes,
    DeviceRefused on an exception reply, BadReply on a reply that does not fit, LinkLost when the connection breaks.
    """

    def __init__(self, where: str, host: str, port: int, unit: int, timeout_s: float) -> None:
        self.where, self._unit, self._timeout_s = where, unit, timeout_s
        self._address = f"{host}:{port}"
        self._request: _Request | None = None
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
        for reply in _REPLIES.values():
            self._client.register(reply)

    @property
    def connected(self) -> bool:
        return bool(self._client.connected)

    async def connect(self) -> None:
        """Open the connection; PortMissing when nobody listens."""
        context = self._client.ctx
        # pymodbus has one time-out for connecting and for replies, and gives up a link after a few silent replies.
        context.comm_params.timeout_connect = CONNECT_S
        if not await self._client.connect():
            raise PortMissing(self.where, f"no Modbus TCP server answered within {CONNECT_S} s", value=self._address)
        context.comm_params.timeout_connect = self._timeout_s
        context.count_until_disconnect = context.max_until_disconnect = _NEVER

    def close(self) -> None:
        self._client.close()

    async def read(self, address: int, count: int) -> bytes:
        """Read `count` holding registers (function 3)."""
        _check(address, count, MAX_READ)
        reply = await self._ask(READ, _SPAN.pack(address, count), 2 * count)
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

    async def _ask(self, function: int, body: bytes, body_bytes: int) -> bytes:
        """Send one request; return the body of the reply, which carries `body_bytes` of data."""
        if self._request is not None:
            raise RuntimeError(f"{self.where}: a request is already under way")
        if not self.connected:
            raise LinkLost(self.where, "not connected")
        self._request = request = _Request(function, body, self._unit)
        self._body_bytes, self._skipped = body_bytes, 0
        try:
            reply = await self._client.execute(False, request)
        except ModbusIOException:
            raise self._overdue(function) from None
        finally:
            self._request = None
        if isinstance(reply, ExceptionResponse):
            words = EXCEPTIONS.get(reply.exception_code, "unknown exception")
            raise DeviceRefused(self.where, words, value=reply.exception_code)
        same = reply.transaction_id == request.transaction_id and reply.dev_id == self._unit
        if type(reply) is not _REPLIES[function] or not same:
            raise BadReply(self.where, f"it does not fit function {function}", value=str(reply))
        return reply.body

    def _overdue(self, function: int) -> DeviceSilent | OutcomeUnknown:
        if function == READ:
            return DeviceSilent(self.where, f"{self._address} did not answer a read", limit=self._timeout_s)
        return OutcomeUnknown(self.where, f"No reply within {self._timeout_s} s.", value=f"write (function {function})")

    def _inspect(self, sending: bool, data: bytes) -> bytes:
        """Pass on only the frame that answers the pending request, once it is whole and well formed."""
        request = self._request
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
                complaint = self._complaint(request, unit, function, data[at + 8 : end])
                return self._refuse(complaint) if complaint else data[at:end]
            # The buffer keeps what was skipped until the next request: count each stale frame once.
            if at >= self._skipped:
                self.stale_replies += 1
                self._skipped = end
            at = end
        return b""

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

    def _refuse(self, complaint: str) -> bytes:
        self._fail(BadReply(self.where, "The connection is not trusted any more.", value=complaint))
        return b""

    def _connection(self, up: bool) -> None:
        if not up:
            self._fail(LinkLost(self.where, f"{self._address} closed the connection"))

    def _fail(self, error: Exception) -> None:
        """End the pending request at once."""
        pending = self._client.ctx.response_future
        if self._request is not None and not pending.done():
            pending.set_exception(error)


def _check(address: int, count: int, most: int) -> None:
    if not (1 <= count <= most and 0 <= address <= 0x10000 - count):
        raise ValueError(f"{count} registers at {address}: outside what one request carries")
