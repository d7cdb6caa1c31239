"""A serial line inside the process: `near` is the host's `docking.ports.SerialLink`, `far` belongs to the device.

Both directions are paced at the baud rate with one timer a chunk, so an exchange takes the wire time of its bytes on
the loop's clock. `unplug` makes the port vanish as a pulled cable does; `missing` lets `open` fail. Each end has its
own speed; while the two differ, both receive garbage.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

from docking.errors import LinkLost, PortMissing
from sim.wires.pacing import BITS_PER_BYTE, PacedChannel


def _ignore(_: object) -> None:
    """Bytes that nobody listens for are lost, as on a line with no receiver."""


def _deaf() -> None:
    """A break that no device listens for."""


class HostEnd:
    """The host's end of the line; satisfies `docking.ports.SerialLink`."""

    def __init__(self, wire: VirtualSerial) -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._wire = wire
        self._is_open = False

    async def open(self) -> None:
        """Attach to the line; PortMissing while it is unplugged."""
        if self._wire.missing:
            raise PortMissing(self._wire.name, "no such device", value=self._wire.name)
        self._is_open = True

    def write(self, data: bytes) -> None:
        """Send bytes to the device; LinkLost when the port is closed or gone."""
        if not self._is_open:
            raise LinkLost(self._wire.name, "the port is not open")
        self._wire.to_device.send(data)

    async def set_baud(self, baud: int) -> None:
        """Change the host's speed; LinkLost when the port is closed or gone."""
        if not self._is_open:
            raise LinkLost(self._wire.name, "the port is not open")
        self._wire.set_host_baud(baud)

    async def send_break(self) -> None:
        """Hold the line low."""
        if self._is_open:
            self._wire.far.on_break()

    def close(self) -> None:
        self._is_open = False

    def deliver(self, data: bytes) -> None:
        """Bytes have reached the host."""
        if self._is_open:
            self.on_bytes(data)

    def drop(self, reason: str) -> None:
        """The port has vanished; the host hears it once."""
        if self._is_open:
            self._is_open = False
            self.on_lost(reason)


class FarEnd:
    """The device's end of the line; satisfies `sim.wires.pacing.DeviceEnd`."""

    def __init__(self, wire: VirtualSerial) -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self.on_break: Callable[[], None] = _deaf
        self._wire = wire

    def write(self, data: bytes) -> None:
        self._wire.to_host.send(data)

    def set_baud(self, baud: int) -> None:
        """Change the device's speed."""
        self._wire.set_device_baud(baud)

    def deliver(self, data: bytes) -> None:
        """Bytes have reached the device."""
        self.on_bytes(data)


class VirtualSerial:
    """One line of `baud` bits/s and so many `bits` a character, with its two ends, on the time of `loop`."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        baud: int,
        name: str = "virtual serial line",
        bits: int = BITS_PER_BYTE,
    ) -> None:
        self.name = name
        self.missing = False
        self.near, self.far = HostEnd(self), FarEnd(self)
        self.to_device = PacedChannel(loop, baud, lambda data: self.far.deliver(self._heard(data)), bits)
        self.to_host = PacedChannel(loop, baud, lambda data: self.near.deliver(self._heard(data)), bits)
        self._host_baud = self._device_baud = baud
        self._noise = random.Random(baud)

    def set_host_baud(self, baud: int) -> None:
        """The host sends and listens at this speed from now on."""
        self._host_baud = baud
        self.to_device.set_baud(baud)

    def set_device_baud(self, baud: int) -> None:
        """The device sends and listens at this speed from now on."""
        self._device_baud = baud
        self.to_host.set_baud(baud)

    def _heard(self, data: bytes) -> bytes:
        """What the other end makes of the bytes."""
        return data if self._host_baud == self._device_baud else self._noise.randbytes(len(data))

    def unplug(self, reason: str = "the port has vanished") -> None:
        """Pull the cable: bytes under way are lost, the host hears `on_lost`, `open` fails until `replug`."""
        self.missing = True
        self.to_device.cut()
        self.to_host.cut()
        self.near.drop(reason)

    def replug(self) -> None:
        self.missing = False
