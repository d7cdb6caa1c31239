"""The device's end of a pseudo-terminal: any serial program opens `path` as its port.

A pty takes any baud rate and ignores it, so both directions are paced here. One slave descriptor stays open:
clients may close and open again as often as they like without the master seeing an end of file. Modem lines and
breaks do not exist on a pty.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import tty
from collections.abc import Callable
from pathlib import Path

from sim.wires.pacing import BITS_PER_BYTE, PacedChannel

CHUNK = 4096


def _ignore(_: object) -> None:
    """Bytes that nobody listens for are lost, as on a line with no receiver."""


def _deaf() -> None:
    """No break ever reaches the master of a pty."""


class PtySerial:
    """A pty with the device on its master side; satisfies `sim.wires.pacing.SpeedEnd`.

    `link` is the stable name to make (a symbolic link to the slave), or None; `path` is what a client opens.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        baud: int,
        link: Path | None = None,
        bits: int = BITS_PER_BYTE,
    ) -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self.on_break: Callable[[], None] = _deaf
        self.path = ""
        self.lost_bytes = 0
        self._loop, self._link = loop, link
        self._master = self._keeper = -1
        self._to_client = PacedChannel(loop, baud, self._send, bits)
        self._to_device = PacedChannel(loop, baud, self._receive, bits)

    def open(self) -> None:
        """Create the terminal and start to listen."""
        self._master, self._keeper = pty.openpty()
        tty.setraw(self._keeper)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._keeper)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.path)
            self.path = str(self._link)
        self._loop.add_reader(self._master, self._readable)

    def write(self, data: bytes) -> None:
        """Send bytes to the client at the pace of the line; lost when the terminal is closed."""
        if self._master >= 0:
            self._to_client.send(data)

    def set_baud(self, baud: int) -> None:
        """Pace both directions anew; what the client has set cannot be known."""
        self._to_client.set_baud(baud)
        self._to_device.set_baud(baud)

    def close(self) -> None:
        """Take the terminal away; a client that has it open meets an input/output error, as with a pulled cable."""
        if self._master < 0:
            return
        self._to_client.cut()
        self._to_device.cut()
        self._loop.remove_reader(self._master)
        os.close(self._master)
        os.close(self._keeper)
        self._master = self._keeper = -1
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    def _readable(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._to_device.send(os.read(self._master, CHUNK))

    def _receive(self, data: bytes) -> None:
        self.on_bytes(data)

    def _send(self, data: bytes) -> None:
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        # A UART has no memory for a client that does not read: what does not fit is lost.
        self.lost_bytes += len(data) - sent


class SteadyPty(PtySerial):
    """A pty that stays at its speed: the host's change of speed does not reach the device on a pty, so a device that
    waits for it would stay at its first one."""

    def set_baud(self, baud: int) -> None:
        """Nothing changes."""
