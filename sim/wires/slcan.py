"""A USB-to-CAN adapter that speaks the serial-line CAN protocol (slcan, Lawicel): text on one side, a bus on the other.

Lines end with CR. From the computer: `Sn` bit rate, `O` open, `C` close, `tiiildd..` a frame: three hexadecimal digits
of identifier, one of length, two for each byte. To the computer: frames in the same form, CR (BEL) for an order that
was (was not) obeyed, `z` before the CR of a sent frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from sim.wires.can_frames import CanFrame
from sim.wires.pacing import DeviceEnd

BIT_RATES: Final = dict(enumerate((10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)))
_OK, _REFUSED, _SENT = b"\r", b"\a", b"z\r"
_LONGEST_LINE = 32


def _ignore(_: list[CanFrame]) -> None:
    """Nobody is on the bus."""


class SlcanAdapter:
    """The devices on the bus hold this end; satisfies `sim.wires.can_frames.CanEnd`. Closed at first.

    `bit_rate` is what the computer has chosen, 0 before; `refused` counts lines that were not obeyed.
    """

    def __init__(self, line: DeviceEnd) -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.is_open = False
        self.bit_rate = self.refused = 0
        self._line, self._pending = line, b""
        line.on_bytes = self._arrived

    def send(self, frames: list[CanFrame]) -> None:
        """Frames of the devices to the computer; lost while the adapter is closed."""
        if self.is_open:
            text = "".join(f"t{cob:03X}{len(data):X}{data.hex().upper()}\r" for cob, data in frames)
            self._line.write(text.encode("ascii"))

    def _arrived(self, data: bytes) -> None:
        *lines, self._pending = (self._pending + data).split(b"\r")
        self._pending = self._pending[-_LONGEST_LINE:]
        batch: list[CanFrame] = []
        answers = b"".join([self._obey(line, batch) for line in lines if line])
        if answers:
            self._line.write(answers)
        if batch:
            self.on_frames(batch)

    def _obey(self, line: bytes, batch: list[CanFrame]) -> bytes:
        """Carry one line out, or add its frame to the batch; the answer."""
        letter, rest = line[:1], line[1:]
        frame = parse_frame(rest) if letter == b"t" and self.is_open else None
        if frame is not None:
            batch.append(frame)
            return _SENT
        if letter in (b"O", b"C") and not rest and self.is_open != (letter == b"O"):
            self.is_open = letter == b"O"
            return _OK
        if letter == b"S" and rest.isdigit() and int(rest) in BIT_RATES and not self.is_open:
            self.bit_rate = BIT_RATES[int(rest)]
            return _OK
        self.refused += 1
        return _REFUSED


def parse_frame(text: bytes) -> CanFrame | None:
    """The frame of a `t` line without its letter; None where it is none."""
    try:
        cob, length, data = int(text[:3], 16), int(text[3:4], 16), bytes.fromhex(text[4:].decode("ascii"))
    except ValueError:
        return None
    return (cob, data) if cob < 0x800 and length == len(data) <= 8 and len(text) == 4 + 2 * length else None
