"""A serial line inside the process: `near` is the host's `docking.ports.SerialLink`, `far` belongs to the device.

Both directions are paced at the baud rate with one timer a chunk, so an exchange takes the wire time of its bytes on
the loop's clock. `unplug` makes the port vanish as a pulled cable does; `missing` lets `open` fail.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.errors import LinkLost, PortMissing
from sim.wires.pacing import PacedChannel


def _ignore(_: object) -> None:
    """Bytes that nobody listens for are lost, as on a line with no receiver."""


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
        self._wire = wire

    def write(self, data: bytes) -> None:
        self._wire.to_host.send(data)

    def deliver(self, data: bytes) -> None:
        """Bytes have reached the device."""
        self.on_bytes(data)


class VirtualSerial:
    """One line of `baud` bits/s with its two ends, on the time of `loop`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, baud: int, name: str = "virtual serial line") -> None:
        self.name = name
        self.missing = False
        self.near, self.far = HostEnd(self), FarEnd(self)
        self.to_device = PacedChannel(loop, baud, self.far.deliver)
        self.to_host = PacedChannel(loop, baud, self.near.deliver)

    def unplug(self, reason: str = "the port has vanished") -> None:
        """Pull the cable: bytes under way are lost, the host hears `on_lost`, `open` fails until `replug`."""
        self.missing = True
        self.to_device.cut()
        self.to_host.cut()
        self.near.drop(reason)

    def replug(self) -> None:
        self.missing = False
