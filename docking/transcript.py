"""Transcripts: all bytes of all wires with their times, as text that a person reads and a test replays.

    # docking transcript 1: seconds, > to the device or < from it, wire, bytes | what they are
    12.345678 > tracker 24564552 | $VER
    12.345912 < can 1A8#0102 | contacts of node 40
    12.346120 > modbus:A 000100000006010301000010 | 1: unit 1, read 16 from 100h

Times are those of the loop (the monotonic clock of the computer), so that several programs may write into one file:
every write appends whole lines. Lines are in order for each program; `read_transcript` sorts them by time.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from docking.errors import BadReply, FileUnreadable, FileUnwritable
from docking.ports import ByteSink, CanFrame, CanLink, SerialLink

HEAD = "# docking transcript 1: seconds, > to the device or < from it, wire, bytes | what they are\n"
KEPT_LINES, KEPT_S = 200, 0.2
"""What a program that is killed may take with it."""
_FUNCTIONS = {1: "read coils", 2: "read contacts", 3: "read", 4: "read inputs", 6: "write", 16: "write", 23: "exchange"}
_NODE_MESSAGES = {
    0x080: "emergency",
    0x180: "read-back",
    0x200: "set-point",
    0x280: "second read-back",
    0x580: "SDO answer",
    0x600: "SDO request",
    0x700: "heartbeat",
}
_COMMANDS = {0x01: "start", 0x02: "stop", 0x80: "pre-operational", 0x81: "reset", 0x82: "reset communication"}


class Transcript:
    """Writes one transcript file; `clock` gives seconds. Raises FileUnwritable when the file cannot be opened."""

    def __init__(self, path: Path, clock: Callable[[], float]) -> None:
        self.path, self._clock = path, clock
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            if os.fstat(self._file).st_size == 0:
                os.write(self._file, HEAD.encode())
        except OSError as error:
            raise FileUnwritable(str(path), (error.strerror or str(error)).lower()) from error
        self._lines: list[str] = []
        self._written_s = clock()

    def serial(self, wire: str, sent: bool, data: bytes) -> None:
        """Bytes of a serial line."""
        self._line(sent, wire, data.hex().upper(), ascii(data.decode("latin-1"))[1:-1])

    def can(self, wire: str, sent: bool, frames: list[CanFrame]) -> None:
        """Frames of a CAN bus."""
        for cob, data in frames:
            self._line(sent, wire, f"{cob:03X}#{data.hex().upper()}", can_words(cob, data))

    def modbus(self, device: str, sent: bool, data: bytes) -> None:
        """Bytes of the Modbus TCP connection to `device`."""
        self._line(sent, f"modbus:{device}", data.hex().upper(), modbus_words(data, sent))

    def close(self) -> None:
        if self._file >= 0:
            self._write()
            os.close(self._file)
            self._file = -1

    def _line(self, sent: bool, wire: str, payload: str, words: str) -> None:
        if self._file < 0:
            return
        now_s = self._clock()
        self._lines.append(f"{now_s:.6f} {'>' if sent else '<'} {wire} {payload} | {words}\n")
        if len(self._lines) >= KEPT_LINES or now_s - self._written_s >= KEPT_S:
            self._written_s = now_s
            self._write()

    def _write(self) -> None:
        """One write of whole lines; a full disk ends the transcript and nothing else."""
        text, self._lines = "".join(self._lines), []
        try:
            os.write(self._file, text.encode())
        except OSError:
            os.close(self._file)
            self._file = -1


def can_words(cob: int, data: bytes) -> str:
    """A CANopen frame by its identifier."""
    if cob == 0 and len(data) == 2:
        return f"NMT {_COMMANDS.get(data[0], hex(data[0]))} node {data[1] or 'all'}"
    if cob == 0x080:
        return "SYNC"
    words = f"{_NODE_MESSAGES.get(cob & 0x780, 'frame')} of node {cob & 0x7F}"
    if cob & 0x780 in (0x580, 0x600) and len(data) == 8 and data[0] >> 5 in (1, 2, 3, 4):
        index, sub = struct.unpack_from("<HB", data, 1)
        words += f", {'abort ' if data[0] >> 5 == 4 else ''}{index:04X}h:{sub:02X}"
    return words


def modbus_words(data: bytes, request: bool) -> str:
    """A Modbus TCP frame: transaction, unit, function, and in a request the span."""
    if len(data) < 8:
        return f"{len(data)} bytes"
    transaction, _, _, unit, function = struct.unpack_from(">HHHBB", data)
    words = f"{transaction}: unit {unit}, "
    if function & 0x80:
        return f"{words}exception {data[8] if len(data) > 8 else '?'}"
    words += _FUNCTIONS.get(function, f"function {function}")
    if request and len(data) >= 12:
        address, count = struct.unpack_from(">HH", data, 8)
        words += f" {count} from {address:X}h"
    return words


@dataclass(frozen=True)
class Line:
    """One line of a transcript. `data` are bytes; `cob` is the identifier of a CAN frame, None elsewhere."""

    t_s: float
    sent: bool
    wire: str
    data: bytes
    cob: int | None = None


def read_transcript(path: Path) -> list[Line]:
    """The lines of a transcript in the order of their times. Raises FileUnreadable, BadReply where it is not one."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileUnreadable(str(path), getattr(error, "strerror", None) or str(error)) from error
    found = [_parsed(path, number, line) for number, line in enumerate(lines, start=1) if not line.startswith("#")]
    return sorted(found, key=lambda line: line.t_s)


def _parsed(path: Path, number: int, text: str) -> Line:
    try:
        time, direction, wire, payload, _ = text.split(" ", 4)
        cob, mark, digits = payload.partition("#")
        if direction not in ("<", ">"):
            raise ValueError(direction)
        data = bytes.fromhex(digits if mark else payload)
        return Line(float(time), direction == ">", wire, data, int(cob, 16) if mark else None)
    except ValueError as error:
        raise BadReply(str(path), f"Line {number} is no line of a transcript.", value=text[:60]) from error


# on the wires ------------------------------------------------------------------------------------------------------
def _ignore(_: object) -> None:
    """Until the driver sets its own."""


class TranscribedSerial:
    """`docking.ports.SerialLink` over another one, with every byte in the transcript."""

    def __init__(self, link: SerialLink, transcript: Transcript, wire: str) -> None:
        self.on_bytes: ByteSink = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._link, self._transcript, self._wire = link, transcript, wire

    async def open(self) -> None:
        self._link.on_bytes, self._link.on_lost = self._arrived, self._lost
        await self._link.open()

    def write(self, data: bytes) -> None:
        self._transcript.serial(self._wire, True, data)
        self._link.write(data)

    def close(self) -> None:
        self._link.close()

    async def set_baud(self, baud: int) -> None:
        """As the link does; one without a speed has nothing to change."""
        change = getattr(self._link, "set_baud", None)
        if change is not None:
            await change(baud)

    async def send_break(self) -> None:
        """As the link does."""
        send = getattr(self._link, "send_break", None)
        if send is not None:
            await send()

    def _arrived(self, data: bytes) -> None:
        self._transcript.serial(self._wire, False, data)
        self.on_bytes(data)

    def _lost(self, reason: str) -> None:
        self.on_lost(reason)


class TranscribedCan:
    """`docking.ports.CanLink` over another one, with every frame in the transcript."""

    def __init__(self, link: CanLink, transcript: Transcript, wire: str = "can") -> None:
        self.on_frames: Callable[[list[CanFrame]], None] = _ignore
        self.on_lost: Callable[[str], None] = _ignore
        self._link, self._transcript, self._wire = link, transcript, wire

    async def open(self) -> None:
        self._link.on_frames, self._link.on_lost = self._arrived, self._lost
        await self._link.open()

    def send(self, frames: list[CanFrame]) -> None:
        self._transcript.can(self._wire, True, frames)
        self._link.send(frames)

    def close(self) -> None:
        self._link.close()

    def _arrived(self, batch: list[CanFrame]) -> None:
        self._transcript.can(self._wire, False, batch)
        self.on_frames(batch)

    def _lost(self, reason: str) -> None:
        self.on_lost(reason)
