"""The conversation with a GeoCOM instrument: one call at a time, answered under its own transaction number.

After a time-out the line is reset (a line feed empties the instrument's receive buffer) and drained; a reply that comes
later carries an old number and is dropped. A motorised function that is given up is aborted on the instrument, too.
"""

from __future__ import annotations

import asyncio
import math

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, TargetLost
from docking.ports import SerialLink
from drivers.garbage import GarbageWatch
from drivers.geocom_codec import (
    ABORT_LINE,
    BUSY_CODES,
    COM_NULL_PROC,
    DEGRADED_CODES,
    MEASUREMENTS,
    MOTOR_PROCEDURES,
    REFUSAL_WORDS,
    RPC_NAMES,
    TARGET_CODES,
    TRID_MODULUS,
    GeocomParser,
    GeocomReply,
    encode_request,
)

STATUS_TIMEOUT_S = 1.0
BUSY_PAUSE_S = 0.2
DRAIN_S = 0.05
AWAKE_ATTEMPTS = 3


class GeocomLine:
    """Calls over `link`; `deadline_s` (loop time) bounds every call. Error `where` is the target's name or "tracker".

    `checksum` uses the CRC form of the lines. Use it from one task at a time.
    """

    def __init__(self, link: SerialLink, checksum: bool) -> None:
        self.stale_replies = 0
        self.deadline_s = math.inf
        self._link, self._checksum = link, checksum
        self._parser = GeocomParser(checksum)
        self._garbage = GarbageWatch()
        self._trid = 0
        self._reply: asyncio.Future[GeocomReply] | None = None
        self._lost: str | None = "not connected"

    @property
    def bad_lines(self) -> int:
        """Replies dropped for framing, checksum or grammar."""
        return self._parser.bad

    @property
    def noise_bytes(self) -> int:
        """Bytes received that belong to no reply."""
        return self._parser.noise

    async def open(self) -> None:
        """Open the link and wake the instrument. Raises PortMissing, DeviceSilent or DeviceRefused."""
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_lost
        await self._link.open()
        self._lost, self.deadline_s = None, math.inf
        self._parser.reset()
        self._garbage.reset()
        # Replies of an earlier session must not fit: the numbering starts where the clock happens to stand.
        self._trid = int(asyncio.get_running_loop().time() * 1000.0) % TRID_MODULUS
        await self._wake()

    def close(self) -> None:
        """Release the link."""
        self._link.close()
        self._on_lost("closed")

    async def ask(
        self, rpc: int, *params: int | float, target: str = "", timeout_s: float = STATUS_TIMEOUT_S
    ) -> GeocomReply:
        """One procedure call, repeated while the instrument is busy and there is time; refusals become errors.

        Raises TargetLost, DeviceRefused, DeviceSilent, BadReply (garbage) or LinkLost.
        """
        give_up_s = asyncio.get_running_loop().time() + min(timeout_s, self.left_s())
        while True:
            reply = await self._exchange(rpc, params, give_up_s)
            busy = reply.com in BUSY_CODES or reply.rc in BUSY_CODES
            if not busy or asyncio.get_running_loop().time() + BUSY_PAUSE_S >= give_up_s:
                break
            await asyncio.sleep(BUSY_PAUSE_S)
        _raise_refusal(rpc, reply, target)
        return reply

    def left_s(self) -> float:
        """Time until the deadline."""
        return self.deadline_s - asyncio.get_running_loop().time()

    async def _wake(self) -> None:
        """The first request after a change of port may meet an instrument asleep or bytes in its buffer."""
        for attempt in range(AWAKE_ATTEMPTS):
            self._link.write(b"\n")
            try:
                await self.ask(COM_NULL_PROC)
                return
            except DeviceSilent:
                if attempt == AWAKE_ATTEMPTS - 1:
                    raise

    async def _exchange(self, rpc: int, params: tuple[int | float, ...], give_up_s: float) -> GeocomReply:
        if self._lost is not None:
            raise LinkLost("tracker", self._lost)
        loop = asyncio.get_running_loop()
        wait_s = max(0.0, give_up_s - loop.time())
        self._trid = (self._trid + 1) % TRID_MODULUS
        self._reply = loop.create_future()
        try:
            self._link.write(encode_request(rpc, self._trid, params, self._checksum))
            await asyncio.wait({self._reply}, timeout=wait_s)
            if self._reply.done():
                return self._reply.result()
            self._reset_line(rpc)
            await asyncio.sleep(DRAIN_S)
        except asyncio.CancelledError:
            if self._lost is None:
                self._reset_line(rpc)
            raise
        finally:
            self._reply = None
        self._parser.reset()
        heard = f"{self.bad_lines} bad lines and {self.noise_bytes} bytes of noise so far"
        cause = f"no reply to {RPC_NAMES.get(rpc, str(rpc))}; {heard}, {self.stale_replies} under another number"
        raise DeviceSilent("tracker", cause, limit=round(wait_s, 3))

    def _reset_line(self, rpc: int) -> None:
        """Empty the instrument's receive buffer; stop its motors when they are what it was asked for."""
        self._link.write(b"\n" + (ABORT_LINE if rpc in MOTOR_PROCEDURES else b""))

    def _on_bytes(self, data: bytes) -> None:
        bad_before = self._parser.bad
        for reply in self._parser.feed(data):
            if self._reply is None or self._reply.done() or reply.trid != self._trid:
                self.stale_replies += 1
            else:
                self._reply.set_result(reply)
        distrust = self._garbage.count(self._parser.bad - bad_before, asyncio.get_running_loop().time())
        if distrust:
            self._fail(BadReply("tracker", "garbage on the line", value=distrust))

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        self._fail(LinkLost("tracker", reason))

    def _fail(self, error: LinkError) -> None:
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(error)


def _raise_refusal(rpc: int, reply: GeocomReply, target: str) -> None:
    """Turn return codes into errors; OK and the accuracy warnings of a measurement pass."""
    name = RPC_NAMES.get(rpc, str(rpc))
    if reply.com != 0:
        cause = REFUSAL_WORDS.get(reply.com, "communication error")
        raise DeviceRefused("tracker", f"{name}: {cause}", value=reply.com)
    if reply.rc == 0 or (rpc in MEASUREMENTS and reply.rc in DEGRADED_CODES):
        return
    if target and reply.rc in TARGET_CODES:
        raise TargetLost(target, f"{TARGET_CODES[reply.rc]} (code {reply.rc})", value=reply.rc)
    raise DeviceRefused("tracker", f"{name}: {REFUSAL_WORDS.get(reply.rc, 'unknown return code')}", value=reply.rc)
