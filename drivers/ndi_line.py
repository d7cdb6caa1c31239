"""The conversation with an NDI device: one command at a time, every reply under its checksum.

Replies carry no number. After a time-out the line is left alone until a late reply would be through, and drained; only
then the next command leaves, so that no reply is taken for the answer to another command.
"""

from __future__ import annotations

import asyncio

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost
from docking.ports import SpeedLink
from drivers.garbage import GarbageWatch
from drivers.ndi_codec import BAUD_CODES, ERROR_WORDS, NdiParser, encode_command, refusal

COMMAND_TIMEOUT_S = 2.0
RESET_TIMEOUT_S = 1.5
DRAIN_S = 0.5
SWITCH_S = 0.1
"""The device answers COMM at the old speed and then needs this long."""
DEFAULT_BAUD = 9600
RESET_TEXT = "RESET"


class NdiLine:
    """Commands over `link`. Error `where` is `name`. Use it from one task at a time."""

    def __init__(self, link: SpeedLink, name: str) -> None:
        self.stale_replies = 0
        self._link, self._name = link, name
        self._parser = NdiParser()
        self._garbage = GarbageWatch()
        self._reply: asyncio.Future[str] | None = None
        self._lost: str | None = "not connected"

    @property
    def bad_lines(self) -> int:
        """Replies dropped for their checksum."""
        return self._parser.bad

    async def open(self, baud: int) -> None:
        """Open the link, reset the device to its own speed and let both go over to `baud`.

        Where no break reaches the device (a converter without one) it is sought at `baud` and at its own speed.
        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply or LinkLost.
        """
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_lost
        await self._link.open()
        self._lost = None
        self._garbage.reset()
        at_baud = await self._reset() or await self._seek(baud)
        if at_baud != baud:
            await self.okay("COMM", f"{BAUD_CODES[baud]}0000")
            await asyncio.sleep(SWITCH_S)
            await self._link.set_baud(baud)
            self._parser.reset()
            await self.okay("INIT")

    def close(self) -> None:
        """Release the link."""
        self._link.close()
        self._on_lost("closed")

    async def okay(self, name: str, params: str = "", timeout_s: float = COMMAND_TIMEOUT_S) -> None:
        """A command that is answered by OKAY. Raises as `ask`."""
        text = await self.ask(name, params, timeout_s)
        if text != "OKAY":
            raise BadReply(self._name, f"{name}: OKAY expected", value=text[:40])

    async def ask(self, name: str, params: str = "", timeout_s: float = COMMAND_TIMEOUT_S) -> str:
        """The text of the reply. Raises DeviceRefused (an ERROR reply), DeviceSilent, BadReply or LinkLost."""
        text = await self._exchange(encode_command(name, params), name, timeout_s)
        code = refusal(text)
        if code is not None:
            words = ERROR_WORDS.get(code, "unknown error code")
            raise DeviceRefused(self._name, f"{name} {params}: {words}", value=f"{code:02X}")
        return text

    async def _reset(self) -> int | None:
        """By a break; the speed at which the device then is, None when no answer came."""
        await self._link.set_baud(DEFAULT_BAUD)
        self._parser.reset()
        loop = asyncio.get_running_loop()
        self._reply = loop.create_future()
        try:
            await self._link.send_break()
            await asyncio.wait({self._reply}, timeout=RESET_TIMEOUT_S)
            if not (self._reply.done() and self._reply.result() == RESET_TEXT):
                return None
        finally:
            self._reply = None
        # Somebody who gave up may have sent a break, too: its answer would pass for that of the next command.
        await asyncio.sleep(DRAIN_S)
        await self.okay("INIT")
        return DEFAULT_BAUD

    async def _seek(self, baud: int) -> int:
        for speed in dict.fromkeys((baud, DEFAULT_BAUD)):
            await self._link.set_baud(speed)
            self._parser.reset()
            # A carriage return ends whatever the device has heard at another speed.
            self._link.write(b"\r")
            await asyncio.sleep(DRAIN_S)
            try:
                await self.okay("INIT", timeout_s=RESET_TIMEOUT_S)
            except (DeviceSilent, DeviceRefused, BadReply):
                continue
            return speed
        tried = f"neither at {baud} nor at {DEFAULT_BAUD} bit/s; {self.bad_lines} bad replies"
        raise DeviceSilent(self._name, f"it answers {tried}", limit=RESET_TIMEOUT_S)

    async def _exchange(self, command: bytes, name: str, timeout_s: float) -> str:
        if self._lost is not None:
            raise LinkLost(self._name, self._lost)
        self._reply = asyncio.get_running_loop().create_future()
        try:
            self._link.write(command)
            await asyncio.wait({self._reply}, timeout=timeout_s)
            if self._reply.done():
                return self._reply.result()
        finally:
            self._reply = None
        await asyncio.sleep(DRAIN_S)
        self._parser.reset()
        raise DeviceSilent(self._name, f"no reply to {name}; {self.bad_lines} bad replies so far", limit=timeout_s)

    def _on_bytes(self, data: bytes) -> None:
        bad_before = self._parser.bad
        for text in self._parser.feed(data):
            if self._reply is None or self._reply.done():
                self.stale_replies += 1
            else:
                self._reply.set_result(text)
        distrust = self._garbage.count(self._parser.bad - bad_before, asyncio.get_running_loop().time())
        if distrust:
            self._fail(BadReply(self._name, "garbage on the line", value=distrust))

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        self._fail(LinkLost(self._name, reason))

    def _fail(self, error: LinkError) -> None:
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(error)
