"""Several simulated CAN devices on one end of a bus: each hears what the bus brings and what the others send."""

from __future__ import annotations

from collections.abc import Callable

from sim.wires.can_frames import CanEnd, CanFrame


def _ignore(_: list[CanFrame]) -> None:
    """Until a device listens."""


class SharedEnd:
    """Splits `end`; make one `station` a device."""

    def __init__(self, end: CanEnd) -> None:
        self._end = end
        self._stations: list[Station] = []
        end.on_frames = self._arrived

    def station(self) -> Station:
        """A further device."""
        station = Station(self)
        self._stations.append(station)
        return station

    def spread(self, sender: Station, frames: list[CanFrame]) -> None:
        """Send to the bus, and to the other devices of this end."""
        self._end.send(frames)
        for station in self._stations:
            if station is not sender:
                station.on_frames(frames)

    def _arrived(self, batch: list[CanFrame]) -> None:
        for station in self._stations:
            station.on_frames(batch)


class Station:
    """One device's end; satisfies `sim.wires.can_frames.CanEnd`."""

    def __init__(self, shared: SharedEnd) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self._shared = shared

    def send(self, frames: list[CanFrame]) -> None:
        self._shared.spread(self, frames)
