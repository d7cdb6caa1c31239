"""What the messages of the motion process cross: a queue inside one loop, or a socket between two processes."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Protocol

from docking.errors import BadReply
from docking.motion.messages import HEADER, body_length


def _ignore(_: object) -> None:
    """Nobody listens yet, or any more."""


class Channel(Protocol):
    """One end. Whole messages go out and come in; `on_lost` is called once, with a reason, when the other end is gone.

    `send` never waits and never raises: what cannot be delivered any more is dropped, and `on_lost` tells.
    """

    on_message: Callable[[bytes], None]
    on_lost: Callable[[str], None]

    def send(self, message: bytes) -> None: ...

    def close(self) -> None: ...


class QueueChannel:
    """Both ends on one loop: a message is delivered in the next round of the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.on_message: Callable[[bytes], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._loop = loop
        self._peer: QueueChannel = self
        self._open = True

    @staticmethod
    def pair(loop: asyncio.AbstractEventLoop) -> tuple[QueueChannel, QueueChannel]:
        """Two joined ends."""
        one, other = QueueChannel(loop), QueueChannel(loop)
        one._peer, other._peer = other, one
        return one, other

    def send(self, message: bytes) -> None:
        if self._open:
            self._loop.call_soon(self._peer._take, message)

    def close(self) -> None:
        if self._open:
            self._open = False
            self._loop.call_soon(self._peer._end)

    def _take(self, message: bytes) -> None:
        if self._open:
            self.on_message(message)

    def _end(self) -> None:
        if self._open:
            self._open = False
            self.on_lost("the other end closed the channel")


class SocketChannel(asyncio.Protocol):
    """One end of a connected stream socket. What comes before anybody listens waits; `closed` is set at the end."""

    def __init__(self) -> None:
        self.on_lost: Callable[[str], None] = _ignore
        self.closed = asyncio.Event()
        self._listener: Callable[[bytes], None] = _ignore
        self._transport: asyncio.Transport | None = None
        self._come = bytearray()

    @property
    def on_message(self) -> Callable[[bytes], None]:
        return self._listener

    @on_message.setter
    def on_message(self, listener: Callable[[bytes], None]) -> None:
        self._listener = listener
        if self._transport is not None:
            self._transport.resume_reading()

    @classmethod
    async def open(cls, end: socket.socket) -> SocketChannel:
        """Take over a connected socket on the running loop."""
        channel = cls()
        await asyncio.get_running_loop().create_connection(lambda: channel, sock=end)
        return channel

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.pause_reading()

    def data_received(self, data: bytes) -> None:
        self._come += data
        try:
            while len(self._come) >= HEADER.size:
                end = HEADER.size + body_length(self._come)
                if len(self._come) < end:
                    return
                message = bytes(self._come[:end])
                del self._come[:end]
                self.on_message(message)
        except BadReply as error:
            self._lose(error.text())

    def connection_lost(self, exc: Exception | None) -> None:
        self.closed.set()
        self._lose(str(exc) if exc else "the other end closed the channel")

    def _lose(self, reason: str) -> None:
        if self._transport is None:
            return
        self.close()
        self.on_lost(reason)

    def send(self, message: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(message)

    def close(self) -> None:
        """Send what is still waiting, then end."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
