"""NDI Combined API, ASCII form, as bytes: commands, replies, tracking data. Pure; no I/O, no clock.

    command   NAME:params<CRC>\\r       reply   text<CRC>\\r

<CRC> is CRC-16/ARC over everything before it, as four upper-case hexadecimal digits. A reply has no mark at its
start, so noise in front of one costs that reply; the next is whole again. Lengths are hundredths of a millimetre.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from docking.types import Array
from drivers.line_codec import crc16_arc

REPLY_MAX = 4096
MM_PER_COUNT = 0.01
UNIT_PER_COUNT = 1e-4
STRAYS = 0x1000
TRANSFORMS = 0x0001

BAUD_CODES = {
    9600: "0",
    14400: "1",
    19200: "2",
    38400: "3",
    57600: "4",
    115200: "5",
    921600: "6",
    1228739: "7",
    230400: "A",
}

OCCUPIED, INITIALISED, ENABLED, OUT_OF_VOLUME, PARTLY_OUT = 0x01, 0x10, 0x20, 0x40, 0x80

ERROR_WORDS = {
    0x01: "unknown command",
    0x02: "command too long",
    0x03: "command too short",
    0x04: "the device received a bad checksum",
    0x05: "the command took too long",
    0x06: "line settings not taken",
    0x07: "wrong number of parameters",
    0x08: "no such tool handle",
    0x0C: "not possible in the present mode",
    0x0D: "no tool behind this handle",
    0x0E: "the tool is not initialised",
    0x0F: "the tool is not enabled",
    0x10: "the system is not initialised",
    0x11: "tracking could not be stopped",
    0x12: "tracking could not be started",
    0x13: "the tool could not be initialised",
    0x15: "the camera could not be initialised",
    0x1A: "internal error of the camera",
    0x23: "parameter out of range",
    0x28: "too many tools, or a tool of a type that is not supported",
    0x2B: "the handle was never given out",
    0x2C: "the tool was unplugged",
    0x2D: "all handles are in use",
    0x33: "the device does not have this feature",
}

STATUS_WORDS = {
    0x0001: "lost synchronisation inside the system",
    0x0002: "too much infrared light",
    0x0004: "checksum error inside the system",
    0x0008: "processing error",
    0x0010: "hardware failure",
    0x0020: "processing failure",
    0x0200: "temperature out of range",
}
"""Bits of the system status that a user has to hear of."""

_TRANSFORM = r"(?:[+-]\d{5}){4}(?:[+-]\d{6}){3}[+-]\d{5}"
_HANDLE = re.compile(
    rf"([0-9A-F]{{2}})(?:UNOCCUPIED\n?|(MISSING|DISABLED|{_TRANSFORM})([0-9A-F]{{8}})([0-9A-F]{{8}})\n)"
)
_STRAY = re.compile(r"([+-]\d{6})([+-]\d{6})([+-]\d{6})")
_ERROR = re.compile(r"ERROR([0-9A-F]{2})")


@dataclass(frozen=True, eq=False)
class ToolReport:
    """One tool of a TX reply. `turn` (4,) w x y z, `p_mm` (3,), `error_mm`; NaN when MISSING or DISABLED."""

    handle: str
    word: str
    turn: Array
    p_mm: Array
    error_mm: float
    status: int
    frame: int


@dataclass(frozen=True, eq=False)
class TrackReply:
    """A TX reply: tools, markers outside tools (n, 3) mm with `outside` (n,) volume, system status bits."""

    tools: tuple[ToolReport, ...]
    strays_mm: Array
    outside: tuple[bool, ...]
    status: int


def encode_command(name: str, params: str = "") -> bytes:
    """One command in the checksum form."""
    text = f"{name}:{params}".encode("ascii")
    return text + b"%04X\r" % crc16_arc(text)


def decode_reply(line: bytes) -> str:
    """The text of one reply without its end; ValueError for a wrong checksum or bytes that are no text."""
    body, crc = line[:-4], line[-4:]
    if len(line) < 4 or crc != b"%04X" % crc16_arc(body):
        raise ValueError("checksum differs")
    text = body.decode("ascii")
    if not text.replace("\n", "").isprintable():
        raise ValueError("not printable")
    return text


def refusal(text: str) -> int | None:
    """The code of an ERROR reply, None for any other."""
    match = _ERROR.match(text)
    return int(match[1], 16) if match else None


def parse_track(text: str, strays: bool) -> TrackReply:
    """The tracking data in a TX reply with options 0001, or 1001 with `strays`; ValueError for anything else."""
    count, at = _hex(text[:2]), 2
    tools = []
    for _ in range(count):
        match = _HANDLE.match(text, at)
        if match is None:
            raise ValueError(f"not a tool at {at}: {text[at : at + 12]!r}")
        at = match.end()
        if match[2] is not None:
            tools.append(_tool(match))
    positions, outside = np.zeros((0, 3)), tuple[bool, ...]()
    if strays:
        positions, outside, at = _strays(text, at)
    if len(text) != at + 4:
        raise ValueError(f"{len(text) - at} characters left where the status should stand")
    return TrackReply(tuple(tools), positions, outside, _hex(text[at:]))


def parse_handles(text: str) -> dict[str, int]:
    """Handle -> status of a PHSR reply."""
    count = _hex(text[:2])
    if len(text) != 2 + 5 * count:
        raise ValueError(f"not a list of {count} handles: {text!r}")
    return {text[at : at + 2]: _hex(text[at + 2 : at + 5]) for at in range(2, len(text), 5)}


def _hex(text: str) -> int:
    if not text or not re.fullmatch("[0-9A-F]+", text):
        raise ValueError(f"not hexadecimal: {text!r}")
    return int(text, 16)


def _tool(match: re.Match[str]) -> ToolReport:
    handle, word, status, frame = match[1], match[2], int(match[3], 16), int(match[4], 16)
    if word in ("MISSING", "DISABLED"):
        return ToolReport(handle, word, np.full(4, np.nan), np.full(3, np.nan), float("nan"), status, frame)
    turn = np.array([int(word[i : i + 6]) for i in range(0, 24, 6)]) * UNIT_PER_COUNT
    if not abs(float(turn @ turn) - 1.0) <= 0.01:
        raise ValueError(f"quaternion of length {float(np.linalg.norm(turn)):.3f}")
    p_mm = np.array([int(word[i : i + 7]) for i in range(24, 45, 7)]) * MM_PER_COUNT
    return ToolReport(handle, "", turn, p_mm, int(word[45:]) * UNIT_PER_COUNT, status, frame)


def _strays(text: str, at: int) -> tuple[Array, tuple[bool, ...], int]:
    """Positions (n, 3) mm, which are out of volume, and where the text goes on."""
    count = _hex(text[at : at + 2])
    at += 2
    digits = (count + 3) // 4
    flags = _hex(text[at : at + digits]) if count else 0
    at += digits
    rows = []
    for _ in range(count):
        match = _STRAY.match(text, at)
        if match is None:
            raise ValueError(f"not a marker at {at}")
        rows.append([int(v) for v in match.groups()])
        at = match.end()
    outside = tuple(bool(flags >> i & 1) for i in range(count))
    return np.array(rows, dtype=np.float64).reshape(-1, 3) * MM_PER_COUNT, outside, at


class NdiParser:
    """Bytes in, texts of intact replies out. Counts what it drops as `bad`. Keeps at most REPLY_MAX bytes."""

    def __init__(self) -> None:
        self.bad = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """The replies completed by `data`, in order."""
        *lines, rest = (self._rest + data).split(b"\r")
        replies = []
        for line in lines:
            try:
                replies.append(decode_reply(line))
            except ValueError:
                self.bad += 1
        if len(rest) > REPLY_MAX:
            self.bad += 1
            rest = rest[-REPLY_MAX:]
        self._rest = rest
        return replies

    def reset(self) -> None:
        """Forget the unfinished reply; the count stays."""
        self._rest = b""
