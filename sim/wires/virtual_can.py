"""A CAN bus inside the process: frames take their time on the wire; one delivery a batch, on the loop's clock.

Batches that wait for a busy bus go in the order of arbitration: the one whose first identifier is lowest first.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.errors import PortMissing
from sim.wires.can_frames import CanFrame, wire_time_s


def _ignore(_: object) -> None:
    """Frames that nobody listens for pass by."""


class VirtualCanEnd:
    """One station on the bus; satisfies `docking.ports.CanLink` and `sim.wires.can_frames.CanEnd`."""

    def __init__(self, bus: VirtualCan) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self.timed: list[CanFrame] = []
        self.wire_s = 0.0
        self._bus = bus
        self.is_open = False

    async def open(self) -> None:
        """Join the bus; PortMissing while it is cut."""
        if self._bus.is_cut:
            raise PortMissing(self._bus.name, "no such device", value=self._bus.name)
        self.is_open = True

    def send(self, frames: list[CanFrame]) -> None:
        """Put a batch on the bus, not to be altered any more; it is delivered when its last bit has passed."""
        if self.is_open:
            self._bus.put(self, frames)

    def close(self) -> None:
        self.is_open = False

    def drop(self, reason: str) -> None:
        """This station alone falls off the bus, as one whose frames are refused (queue full) or that is bus-off."""
        if self.is_open:
            self.is_open = False
            self.on_lost(reason)


class VirtualCan:
    """The bus. `keep(cob, data)` may be set to lose single frames on their way (False = lost)."""

    def __init__(self, loop: asyncio.AbstractEventLoop, bitrate: int, name: str = "can") -> None:
        self.name, self.is_cut = name, False
        self.keep: Callable[[int, bytes], bool] | None = None
        self.busy_s = 0.0
        self._loop, self._bitrate = loop, bitrate
        self._ends: list[VirtualCanEnd] = []
        self._waiting: list[tuple[VirtualCanEnd, list[CanFrame]]] = []
        self._busy = False

    def end(self) -> VirtualCanEnd:
        """A further station."""
        end = VirtualCanEnd(self)
        self._ends.append(end)
        return end

    def put(self, sender: VirtualCanEnd, frames: list[CanFrame]) -> None:
        """Send now or, while the bus is busy, when its turn comes."""
        if self.is_cut or not frames:
            return
        if self._busy:
            self._waiting.append((sender, frames))
        else:
            self._start(sender, frames)

    def cut(self, reason: str) -> None:
        """The bus fails: every station hears of it once, nothing passes any more."""
        self.is_cut = True
        self._waiting.clear()
        for end in self._ends:
            if end.is_open:
                end.is_open = False
                end.on_lost(reason)

    def _start(self, sender: VirtualCanEnd, frames: list[CanFrame]) -> None:
        self._busy = True
        if frames is not sender.timed:
            # While nothing moves, a station sends one and the same batch again and again.
            sender.timed, sender.wire_s = frames, wire_time_s(frames, self._bitrate)
        self.busy_s += sender.wire_s
        self._loop.call_at(self._loop.time() + sender.wire_s, self._deliver, sender, frames)

    def _deliver(self, sender: VirtualCanEnd, frames: list[CanFrame]) -> None:
        self._busy = False
        if self._waiting:
            first = min(range(len(self._waiting)), key=lambda i: self._waiting[i][1][0][0])
            self._start(*self._waiting.pop(first))
        if self.is_cut:
            return
        if self.keep is not None:
            keep = self.keep
            frames = [frame for frame in frames if keep(*frame)]
        for end in self._ends:
            if end is not sender and end.is_open and frames:
                end.on_frames(frames)
