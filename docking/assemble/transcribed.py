"""Transcripts of what simulated devices hear and say, with the directions of the host."""

from __future__ import annotations

from collections.abc import Callable

from docking.ports import CanFrame
from docking.transcript import Transcript
from sim.wires.can_frames import CanEnd
from sim.wires.pacing import DeviceEnd, SpeedEnd


def _ignore(*_: object) -> None:
    """Until the device listens."""


class TranscribedDevice:
    """The end of a simulated serial device; its directions are those of the host."""

    def __init__(self, wire: DeviceEnd, transcript: Transcript, name: str) -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self._wire, self._transcript, self._name = wire, transcript, name
        wire.on_bytes = self._arrived

    def write(self, data: bytes) -> None:
        self._transcript.serial(self._name, False, data)
        self._wire.write(data)

    def _arrived(self, data: bytes) -> None:
        self._transcript.serial(self._name, True, data)
        self.on_bytes(data)


class TranscribedSpeed(TranscribedDevice):
    """The same for a device that changes the speed of its line."""

    def __init__(self, wire: SpeedEnd, transcript: Transcript, name: str) -> None:
        super().__init__(wire, transcript, name)
        self.on_break: Callable[[], None] = _ignore
        self._speed = wire
        wire.on_break = self._broke

    def set_baud(self, baud: int) -> None:
        """As the wire does."""
        self._speed.set_baud(baud)

    def _broke(self) -> None:
        self.on_break()


class TranscribedStation:
    """The end of simulated CAN devices; its directions are those of the host."""

    def __init__(self, end: CanEnd, transcript: Transcript, name: str = "can") -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self._end, self._transcript, self._name = end, transcript, name
        end.on_frames = self._arrived

    def send(self, frames: list[CanFrame]) -> None:
        self._transcript.can(self._name, False, frames)
        self._end.send(frames)

    def _arrived(self, batch: list[CanFrame]) -> None:
        self._transcript.can(self._name, True, batch)
        self.on_frames(batch)
