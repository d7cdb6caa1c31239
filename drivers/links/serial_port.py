"""A serial port, by any pyserial URL: the one file that knows pyserial.

One thread waits for bytes, keeps them in its own buffer and wakes the loop; the driver above sees `on_bytes` and
`on_lost` on the loop and never waits. When a device vanishes pyserial fails in four ways according to the call:
`SerialException` from read and from write, a bare `OSError` from `in_waiting`, `termios.error` from a buffer reset;
a reader that meets any of them reports the port as lost, once, in words.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import termios
import threading
from collections.abc import Callable

import serial

from docking.errors import LinkLost, PortMissing

READ_WAIT_S = 0.1
WRITE_WAIT_S = 0.5
BREAK_S = 0.3
INBOX_LIMIT = 65536

GONE = (serial.SerialException, OSError, termios.error)
"""SerialException and OSError are related by inheritance, termios.error to neither; named apart to be read."""

_WORDS = {
    errno.ENOENT: "no such device",
    errno.ENODEV: "no such device",
    errno.ENXIO: "no such device",
    errno.EACCES: "permission denied; the user needs access to serial ports (group dialout)",
    errno.EPERM: "permission denied; the user needs access to serial ports (group dialout)",
    errno.EBUSY: "another program holds it",
    errno.EAGAIN: "another program holds it",
    errno.EIO: "input/output error; the device was unplugged or switched off",
    errno.ENOTTY: "this is not a serial port",
    errno.ECONNREFUSED: "the connection was refused; nothing listens at this address",
}


def _words(error: BaseException) -> str:
    """The error as a short clause: by the system's error number where one is behind it, else what pyserial says."""
    cause: BaseException | None = error
    while cause is not None:
        number = cause.args[0] if cause.args else None
        if isinstance(number, int) and number in _WORDS:
            return _WORDS[number]
        cause = cause.__context__
    if "readiness to read but returned no data" in str(error):
        return "the device was unplugged or another program reads the same port"
    return str(error) or type(error).__name__


def _ignore(_: object) -> None:
    """Default sink until the driver sets its own."""


class SerialPort:
    """`docking.ports.SpeedLink` over pyserial: no flow control; `framing` is data bits, parity, stop bits.

    Error `where` is `name`, the device at the far end.
    """

    def __init__(self, url: str, baud: int, name: str = "tracker", framing: str = "8N1") -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self.dropped_bytes = 0
        self._url, self._baud, self._name = url, baud, name
        self._bits, self._parity, self._stop_bits = int(framing[0]), framing[1], int(framing[2])
        self._port: serial.Serial | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop
        self._stopping = threading.Event()
        self._inbox = bytearray()
        self._inbox_lock = threading.Lock()

    async def open(self) -> None:
        """Open the port, alone; PortMissing with the reason in words."""
        self._loop = asyncio.get_running_loop()
        opening = asyncio.ensure_future(asyncio.to_thread(self._open_port))
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            # The thread cannot be told to leave off: what it opens is held by nobody, and nobody else could open it.
            (opened,) = await asyncio.gather(opening, return_exceptions=True)
            if not isinstance(opened, BaseException):
                opened.close()
            raise
        except (*GONE, ValueError) as error:
            raise PortMissing(self._name, _words(error), value=self._url) from error
        self._stopping = threading.Event()
        self._port = port
        self._thread = threading.Thread(
            target=self._read, args=(port, self._stopping), name=f"serial {self._url}", daemon=True
        )
        self._thread.start()

    def _open_port(self) -> serial.Serial:
        # pyserial's RFC 2217 client refuses a write time-out; its writes go to a socket that buffers.
        write_wait_s = None if self._url.lower().startswith("rfc2217:") else WRITE_WAIT_S
        return serial.serial_for_url(
            self._url,
            baudrate=self._baud,
            bytesize=self._bits,
            parity=self._parity,
            stopbits=self._stop_bits,
            timeout=READ_WAIT_S,
            write_timeout=write_wait_s,
            exclusive=True,
        )

    def write(self, data: bytes) -> None:
        """Hand bytes to the port; LinkLost when it is closed, gone or takes no bytes."""
        if self._port is None:
            raise LinkLost(self._name, f"{self._url} is not open")
        try:
            self._port.write(data)
        except GONE as error:
            raise LinkLost(self._name, f"{self._url}: {_words(error)}") from error

    async def set_baud(self, baud: int) -> None:
        """Change the speed; a network port negotiates it. Raises LinkLost."""
        if self._port is None:
            raise LinkLost(self._name, f"{self._url} is not open")
        try:
            await asyncio.to_thread(setattr, self._port, "baudrate", baud)
        except (*GONE, ValueError) as error:
            raise LinkLost(self._name, f"{self._url}: {_words(error)}") from error

    async def send_break(self) -> None:
        """Hold the line low; ports that cannot (a raw socket, a pseudo-terminal) let it pass."""
        if self._port is not None:
            with contextlib.suppress(*GONE):
                await asyncio.to_thread(self._port.send_break, BREAK_S)

    def close(self) -> None:
        """Stop the reader and release the port; `on_lost` is not called."""
        thread, port = self._thread, self._port
        self._thread = self._port = None
        if thread is None or port is None:
            return
        self._stopping.set()
        if hasattr(port, "cancel_read"):
            # A reader whose wait ends just now has closed the port already.
            with contextlib.suppress(*GONE):
                port.cancel_read()
        thread.join(timeout=5.0 * READ_WAIT_S)

    def _read(self, port: serial.Serial, stopping: threading.Event) -> None:
        """Reader thread: bytes to the inbox until told to stop or the port is gone. It alone closes the port."""
        try:
            while not stopping.is_set():
                data = port.read(max(1, port.in_waiting))
                if data:
                    self._keep(data)
        except GONE as error:
            if not stopping.is_set():
                self._wake(self._lost, _words(error), stopping)
        finally:
            try:
                port.close()
            except GONE:
                stopping.set()

    def _keep(self, data: bytes) -> None:
        with self._inbox_lock:
            idle = not self._inbox
            self._inbox += data
            surplus = len(self._inbox) - INBOX_LIMIT
            if surplus > 0:
                # The newest bytes matter: a stalled loop finds the latest lines, not a backlog without end.
                del self._inbox[:surplus]
                self.dropped_bytes += surplus
        if idle:
            self._wake(self._drain)

    def _wake(self, callback: Callable[..., None], *args: object) -> None:
        try:
            self._loop.call_soon_threadsafe(callback, *args)
        except RuntimeError:
            # The loop has closed under the thread: nobody is left to tell.
            self._stopping.set()

    def _drain(self) -> None:
        with self._inbox_lock:
            data = bytes(self._inbox)
            self._inbox.clear()
        if data and self._port is not None:
            self.on_bytes(data)

    def _lost(self, reason: str, stopping: threading.Event) -> None:
        if not stopping.is_set() and self._stopping is stopping and self._port is not None:
            self._port = None
            self._thread = None
            self.on_lost(f"{self._url}: {reason}")
