"""SDO client of one node: object dictionary reads and writes, expedited and segmented, each with one deadline."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable

from docking.errors import BadReply, DeviceRefused, DeviceSilent
from docking.ports import CanFrame
from drivers.canopen import codec
from drivers.canopen.codec import SdoReply
from drivers.maps.objects import ObjectEntry

_ABORT_TIMEOUT = 0x0504_0000
_ABORT_TOGGLE = 0x0503_0000
_LONGEST_TEXT = 4096


class SdoClient:
    """One transfer at a time with one node; nothing is repeated.

    `where` names the axis in errors; `stray` counts answers that nobody asked for: a second device with the same
    node id, or an answer after its deadline.
    """

    def __init__(
        self,
        where: str,
        node: int,
        send: Callable[[list[CanFrame]], None],
        abort_text: Callable[[int], str],
        deadline_s: float = 0.5,
    ) -> None:
        self.where, self.node, self.deadline_s = where, node, deadline_s
        self.stray = 0
        self._late: asyncio.Event | None = None
        self._send, self._abort_text = send, abort_text
        self._busy = asyncio.Lock()
        self._answer: asyncio.Future[SdoReply] | None = None
        self._expected: tuple[int, int] | None = None

    def on_reply(self, data: bytes) -> None:
        """Take a frame of the node's SDO answer channel."""
        reply = codec.parse_sdo(data)
        wanted = self._answer
        if wanted is not None and wanted.cancelled() and self._late is None:
            # Given up in this very turn of the loop: the answer is here before whoever asked has heard.
            self._late = asyncio.Event()
            self._late.set()
            return
        if wanted is None or wanted.done() or (reply.address is not None and reply.address != self._expected):
            if self._late is not None and not self._late.is_set():
                # The answer to a request that was given up: no second device.
                self._late.set()
            else:
                self.stray += 1
            return
        wanted.set_result(reply)

    async def read(self, entry: ObjectEntry) -> int:
        """Read an integer object. Raises DeviceSilent, DeviceRefused, BadReply."""
        data = await self.read_bytes(entry)
        try:
            return codec.unpack_value(entry.type, data)
        except struct.error as error:
            raise BadReply(self.where, f"{entry.label}: length does not match its type", value=data.hex()) from error

    async def read_text(self, entry: ObjectEntry) -> str:
        """What the device says of itself; "" where it refuses: CiA 301 leaves names and versions to the maker.

        Raises DeviceSilent, BadReply.
        """
        try:
            data = await self.read_bytes(entry)
        except DeviceRefused:
            return ""
        return data.rstrip(b"\0").decode("ascii", "replace")

    async def read_bytes(self, entry: ObjectEntry) -> bytes:
        """Read an object as bytes, segmented where the device wants it so."""
        async with self._busy:
            first = await self._ask(entry, codec.sdo_read(entry.index, entry.sub))
            if first.kind == "upload":
                return first.data
            if first.kind != "upload-segmented":
                raise self._unexpected(entry, first)
            data, toggle, last = b"", 0, False
            while not last:
                segment = await self._ask(entry, codec.sdo_read_segment(toggle))
                self._check_segment(entry, segment, "upload-segment", toggle)
                data, last, toggle = data + segment.data, segment.last, toggle ^ 1
                if len(data) > _LONGEST_TEXT:
                    raise BadReply(self.where, f"{entry.label}: transfer does not end", value=len(data))
            if first.code and len(data) != first.code:
                raise BadReply(self.where, f"{entry.label}: {first.code} bytes announced", value=len(data))
            return data

    async def write(self, entry: ObjectEntry, value: int) -> None:
        """Write an integer object. Raises DeviceSilent, DeviceRefused, BadReply."""
        await self.write_bytes(entry, codec.pack_value(entry.type, value))

    async def write_bytes(self, entry: ObjectEntry, data: bytes) -> None:
        """Write an object: expedited up to 4 bytes, else segmented."""
        async with self._busy:
            reply = await self._ask(entry, codec.sdo_write(entry.index, entry.sub, data))
            if reply.kind != "download":
                raise self._unexpected(entry, reply)
            if 1 <= len(data) <= 4:
                return
            for number, start in enumerate(range(0, max(len(data), 1), 7)):
                chunk, toggle = data[start : start + 7], number & 1
                frame = codec.sdo_write_segment(chunk, toggle, start + 7 >= len(data))
                self._check_segment(entry, await self._ask(entry, frame), "download-segment", toggle)

    async def _ask(self, entry: ObjectEntry, request: bytes) -> SdoReply:
        """Send one request frame and wait for its answer."""
        if self._late is not None:
            await self._let_come(self._late)
        self._answer = asyncio.get_running_loop().create_future()
        self._expected = (entry.index, entry.sub)
        try:
            self._send([(codec.COB_SDO_REQUEST + self.node, request)])
            async with asyncio.timeout(self.deadline_s):
                reply = await self._answer
        except TimeoutError as error:
            self._abort(entry, _ABORT_TIMEOUT)
            raise DeviceSilent(self.where, f"node {self.node}, object {entry.label}", limit=self.deadline_s) from error
        except asyncio.CancelledError:
            self._late = self._late or asyncio.Event()
            raise
        finally:
            self._answer = None
        if reply.kind == "abort":
            cause = f"object {entry.label}: {self._abort_text(reply.code)}"
            raise DeviceRefused(self.where, cause, value=f"{reply.code:08X}h")
        return reply

    async def _let_come(self, late: asyncio.Event) -> None:
        """Let the answer to a request that was given up come first: a segment does not say what it belongs to."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.deadline_s):
                await late.wait()
        self._late = None

    def _check_segment(self, entry: ObjectEntry, reply: SdoReply, kind: str, toggle: int) -> None:
        if reply.kind != kind:
            raise self._unexpected(entry, reply)
        if reply.toggle != toggle:
            self._abort(entry, _ABORT_TOGGLE)
            raise BadReply(self.where, f"{entry.label}: toggle bit not alternated", value=reply.toggle)

    def _abort(self, entry: ObjectEntry, code: int) -> None:
        self._send([(codec.COB_SDO_REQUEST + self.node, codec.sdo_abort(entry.index, entry.sub, code))])

    def _unexpected(self, entry: ObjectEntry, reply: SdoReply) -> BadReply:
        return BadReply(self.where, f"object {entry.label}: unexpected SDO answer", value=reply.kind)
