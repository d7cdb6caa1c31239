"""A CAN bus on an AF_UNIX SEQPACKET socket: what `docking sim` serves; any number of stations may join.

Each packet is one frame in the layout of `struct can_frame`. Every frame reaches every other station. A station that
does not read is thrown off the bus, as a real one would lose frames.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path

from docking.errors import PortMissing
from sim.wires.can_frames import CanFrame, pack, unpack

_BATCH = 256


def _ignore(_: object) -> None:
    """Frames that nobody listens for pass by."""


class UnixCanServer:
    """The simulated devices' end; satisfies `sim.wires.can_frames.CanEnd`."""

    def __init__(self, path: Path) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.path = path
        self.stations = 0
        self._server: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self._loop: asyncio.AbstractEventLoop

    async def open(self) -> None:
        """Serve the socket; PortMissing where the path cannot be used."""
        self._loop = asyncio.get_running_loop()
        server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self.path.unlink(missing_ok=True)
            server.bind(str(self.path))
            server.listen()
        except OSError as error:
            server.close()
            raise PortMissing("simulated CAN bus", error.strerror or str(error), value=str(self.path)) from error
        server.setblocking(False)
        self._server = server
        self._loop.add_reader(server, self._accept)

    def send(self, frames: list[CanFrame]) -> None:
        """Send to every station."""
        for record in [pack(frame) for frame in frames]:
            self._spread(record, None)

    def close(self) -> None:
        """Throw every station off and remove the socket."""
        for client in list(self._clients):
            self._drop(client)
        if self._server is not None:
            self._loop.remove_reader(self._server)
            self._server.close()
            self._server = None
            self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        if self._server is None:
            return
        client, _ = self._server.accept()
        client.setblocking(False)
        self._clients.append(client)
        self.stations = len(self._clients)
        self._loop.add_reader(client, self._readable, client)

    def _readable(self, client: socket.socket) -> None:
        frames: list[CanFrame] = []
        gone = False
        for _ in range(_BATCH):
            try:
                record = client.recv(64)
            except BlockingIOError:
                break
            except OSError:
                gone = True
                break
            if not record:
                gone = True
                break
            frame = unpack(record)
            if frame is not None:
                self._spread(record, client)
                frames.append(frame)
        if gone:
            self._drop(client)
        if frames:
            self.on_frames(frames)

    def _spread(self, record: bytes, sender: socket.socket | None) -> None:
        for client in list(self._clients):
            if client is sender:
                continue
            try:
                client.send(record)
            except OSError:
                self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self.stations = len(self._clients)
            self._loop.remove_reader(client)
            client.close()
