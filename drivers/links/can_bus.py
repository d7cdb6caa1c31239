"""A CAN bus, by any python-can interface: the one file that knows python-can (beside the interface `unix_bus`).

Where the bus has a file descriptor the loop watches it; elsewhere one thread waits and wakes the loop. Either way all
frames that are there arrive in one batch.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import threading
from collections.abc import Callable

import can

from docking.errors import PortMissing
from docking.ports import CanFrame
from drivers.links.unix_bus import UnixBus

_WAIT_S = 0.1
_BATCH = 256
_LINE_STUCK_S = 0.005
_BUS_OFF = 0x40
"""Error class of an error frame (linux/can/error.h)."""
_GONE = (can.CanError, OSError)
_NO_FRAME = (ValueError, IndexError)
"""What the adapter sent cannot be taken apart."""
_WORDS = {
    errno.ENOENT: "no such device",
    errno.ENODEV: "no such interface; `ip link` lists those that there are",
    errno.ENETDOWN: "the interface is down: ip link set NAME up type can bitrate RATE",
    errno.EAFNOSUPPORT: "this system has no SocketCAN",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EBUSY: "another program holds it",
    errno.ECONNREFUSED: "nobody serves it",
}


def _words(error: BaseException) -> str:
    """The error as a short clause: by the system's number where there is one, else what was said."""
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if number in _WORDS:
        return _WORDS[number]
    said = str(error) or type(error).__name__
    lacking = isinstance(error, NameError | AttributeError | ImportError)
    return f"{said}; is the library of the adapter's maker installed?" if lacking else said


def _ignore(_: object) -> None:
    """Default sink until the driver sets its own."""


class CanBusLink:
    """`docking.ports.CanLink` over python-can, 11-bit identifiers."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._interface, self._channel, self._bitrate = interface, channel, bitrate
        self._bus: can.BusABC | None = None
        self._loop: asyncio.AbstractEventLoop
        self._watched = -1
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()

    async def open(self) -> None:
        """Open the bus; PortMissing with the reason in words."""
        self._loop = asyncio.get_running_loop()
        try:
            bus = await asyncio.to_thread(self._open_bus)
        except Exception as error:
            # Interfaces of python-can without their maker's library fail with NameError and TypeError, too.
            raise PortMissing(f"bus {self._interface}", _words(error), value=self._channel) from error
        self._bus = bus
        self._watched = _descriptor(bus)
        if self._watched >= 0:
            self._loop.add_reader(self._watched, self._readable, bus)
            return
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=self._read, args=(bus, self._stopping), name=f"can {self._channel}", daemon=True
        )
        self._thread.start()

    def _open_bus(self) -> can.BusABC:
        if self._interface == "docking-unix":
            # Works from a source tree too, where no entry point is installed.
            return UnixBus(self._channel)
        if self._interface == "slcan":
            return _serial_line(self._channel, self._bitrate)
        return can.Bus(interface=self._interface, channel=self._channel, bitrate=self._bitrate)

    def send(self, frames: list[CanFrame]) -> None:
        """Send a batch, in order. A refused frame loses the bus: a missed set-point must not pass unnoticed."""
        bus = self._bus
        if bus is None:
            return
        try:
            for cob, data in frames:
                bus.send(can.Message(arbitration_id=cob, data=data, is_extended_id=False))
        except (can.CanError, OSError) as error:
            self._lose(f"cannot send: {error}")

    def close(self) -> None:
        """Release the bus; `on_lost` is not called."""
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self._watched >= 0:
            self._loop.remove_reader(self._watched)
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0 * _WAIT_S)
            self._thread = None
        try:
            bus.shutdown()
        except (can.CanError, OSError):
            # A dead adapter takes no farewell; its port must be released all the same.
            _release(bus)

    def _lose(self, reason: str) -> None:
        if self._bus is not None:
            self.close()
            self.on_lost(reason)

    def _readable(self, bus: can.BusABC) -> None:
        """On the loop: take everything that has arrived."""
        try:
            batch = _drain(bus)
        except (*_GONE, *_NO_FRAME) as error:
            self._lose(_why_lost(error))
            return
        self._deliver(batch)

    def _deliver(self, batch: list[can.Message]) -> None:
        if self._bus is None:
            return
        frames = [(m.arbitration_id, bytes(m.data)) for m in batch if _is_ours(m)]
        if frames:
            self.on_frames(frames)
        if any(m.is_error_frame and m.arbitration_id & _BUS_OFF for m in batch):
            self._lose("the controller went bus-off")

    def _read(self, bus: can.BusABC, stopping: threading.Event) -> None:
        """Reader thread, for buses without a descriptor."""
        while not stopping.is_set():
            try:
                message = bus.recv(_WAIT_S)
                batch = [] if message is None else [message, *_drain(bus)]
            except (*_GONE, *_NO_FRAME) as error:
                self._wake(self._lose, _why_lost(error), stopping)
                return
            if batch:
                self._wake(self._deliver, batch, stopping)

    def _wake(self, callback: Callable[..., None], argument: object, stopping: threading.Event) -> None:
        try:
            self._loop.call_soon_threadsafe(callback, argument)
        except RuntimeError:
            # The loop has closed under the thread: nobody is left to tell.
            stopping.set()


def _why_lost(error: BaseException) -> str:
    # slcan lines that are no frame: python-can keeps what it could not decode before everything that follows.
    return f"the adapter sends what is no frame: {error}" if isinstance(error, _NO_FRAME) else str(error)


def _serial_line(channel: str, bitrate: int) -> can.BusABC:
    """An slcan adapter that never holds the loop: reads return at once, a write that does not get through fails."""
    bus = can.Bus(interface="slcan", channel=channel, bitrate=bitrate, timeout=0.0)
    port = getattr(bus, "serialPortOrig", None)
    if port is not None:
        port.write_timeout = _LINE_STUCK_S
    return bus


def _release(bus: can.BusABC) -> None:
    port = getattr(bus, "serialPortOrig", None)
    if port is not None:
        with contextlib.suppress(OSError):
            port.close()


def _is_ours(message: can.Message) -> bool:
    return not (message.is_error_frame or message.is_remote_frame or message.is_extended_id)


def _drain(bus: can.BusABC) -> list[can.Message]:
    batch: list[can.Message] = []
    while len(batch) < _BATCH:
        message = bus.recv(0)
        if message is None:
            break
        batch.append(message)
    return batch


def _descriptor(bus: can.BusABC) -> int:
    """The file descriptor to watch, -1 where the interface has none."""
    try:
        return int(bus.fileno())
    except (NotImplementedError, AttributeError, can.CanError, OSError):
        return -1
