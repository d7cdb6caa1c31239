"""VectorNav ASCII as bytes: framing, both checksums, measurements, registers, errors. Pure; no I/O, no clock.

    $VNRRG,11*73\\r\\n      $VNYMR,<12 numbers>[,S<status>][,T<time>]*<checksum>\\r\\n

The checksum covers the text between $ and *: two hexadecimal digits are the XOR of its bytes (as in NMEA 0183), four
are CRC-16/CCITT with start 0. Angles are degrees on the wire, the rest SI; the time is in microseconds, 32 bits.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import reduce
from operator import xor

LINE_MAX = 256
XOR_DIGITS, CRC_DIGITS = 2, 4

USER_TAG, MODEL, SERIAL, FIRMWARE, ASYNC_TYPE, ASYNC_RATE, PROTOCOL = 0, 1, 3, 4, 6, 7, 30
ASYNC_OFF = 0
ASYNC_CODES = {"VNYMR": 14, "VNIMU": 19}
COUNTS = {"VNYMR": 12, "VNIMU": 11}

ERROR_WORDS = {
    1: "hard fault",
    2: "its input buffer overflowed",
    3: "it received a bad checksum",
    4: "unknown command",
    5: "too few parameters",
    6: "too many parameters",
    7: "parameter not allowed",
    8: "no such register",
    9: "not permitted",
    10: "its watchdog has reset it",
    11: "its output buffer overflowed",
    12: "the line is too slow for this output",
    255: "too many errors to report",
}


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021) & 0xFFFF if value & 0x8000 else value << 1
        table.append(value)
    return tuple(table)


_TABLE = _crc_table()


def xor8(data: bytes) -> int:
    """XOR of all bytes."""
    return reduce(xor, data, 0)


def crc16_ccitt(data: bytes) -> int:
    """CRC-16 with generator 0x1021, start 0, not reflected; 0x31C3 over b"123456789"."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _TABLE[crc >> 8 ^ byte]
    return crc


def checksum_text(body: bytes, digits: int) -> bytes:
    """The checksum of `body` as 2 or 4 hexadecimal digits."""
    return b"%02X" % xor8(body) if digits == XOR_DIGITS else b"%04X" % crc16_ccitt(body)


def encode(command: str, *fields: int | str, digits: int = XOR_DIGITS) -> bytes:
    """One command line, such as VNRRG with a register."""
    body = ",".join((command, *map(str, fields))).encode("ascii")
    return b"$" + body + b"*" + checksum_text(body, digits) + b"\r\n"


@dataclass(frozen=True)
class MotionLine:
    """A measurement: `values` as on the wire, `status` bits and `time_us` where they are appended."""

    kind: str
    values: tuple[float, ...]
    status: int | None
    time_us: int | None


@dataclass(frozen=True)
class RegisterLine:
    """The answer to a read or a write of a register."""

    command: str
    register: int
    fields: tuple[str, ...]


@dataclass(frozen=True)
class ErrorLine:
    """The sensor complains."""

    code: int


@dataclass(frozen=True)
class OtherLine:
    """An intact line of another kind."""

    kind: str


Line = MotionLine | RegisterLine | ErrorLine | OtherLine

_BODY = re.compile(r"(VN[A-Z]{3})((?:,[ -#%-)+\-./0-9:-~]*)*)")
_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.\d{1,9})?(?:[eE][+-]?\d{1,2})?")
_STATUS = re.compile(r"S([0-9A-F]{4})")
_TIME = re.compile(r"T(\d{1,10})")


def parse_line(line: bytes, digits: int | None = None) -> Line:
    """One whole line from $ to its end, checksum verified; ValueError for anything else.

    `digits` is the form of checksum that alone is taken; None takes either.
    """
    if line[:1] != b"$" or line[-2:] != b"\r\n":
        raise ValueError("not framed as a line")
    body, star, crc = line[1:-2].rpartition(b"*")
    if not star or len(crc) not in ((XOR_DIGITS, CRC_DIGITS) if digits is None else (digits,)):
        raise ValueError("no checksum of the form that is in use")
    if crc != checksum_text(body, len(crc)):
        raise ValueError("checksum differs")
    match = _BODY.fullmatch(body.decode("ascii"))
    if match is None:
        raise ValueError(f"not a line of the protocol: {body!r}")
    return _meaning(match[1], match[2].split(",")[1:])


def _meaning(kind: str, fields: list[str]) -> Line:
    if kind in COUNTS:
        return _motion(kind, fields)
    if kind in ("VNRRG", "VNWRG"):
        if not fields or not re.fullmatch(r"\d{1,3}", fields[0]):
            raise ValueError(f"{kind} without a register")
        return RegisterLine(kind, int(fields[0]), tuple(fields[1:]))
    if kind == "VNERR":
        if len(fields) != 1 or not re.fullmatch("[0-9A-F]{2}", fields[0]):
            raise ValueError("VNERR without a code")
        return ErrorLine(int(fields[0], 16))
    return OtherLine(kind)


def _motion(kind: str, fields: list[str]) -> MotionLine:
    count = COUNTS[kind]
    numbers, tail = fields[:count], fields[count:]
    if len(numbers) != count or not all(_NUMBER.fullmatch(f) for f in numbers):
        raise ValueError(f"{kind}: {count} numbers expected")
    values = tuple(float(f) for f in numbers)
    if not all(map(math.isfinite, values)):
        raise ValueError("not finite")
    status = time_us = None
    if tail and (match := _STATUS.fullmatch(tail[0])):
        status, tail = int(match[1], 16), tail[1:]
    if tail and (match := _TIME.fullmatch(tail[0])):
        time_us, tail = int(match[1]), tail[1:]
    if tail or (time_us is not None and time_us >= 2**32):
        raise ValueError(f"{kind}: not understood: {tail}")
    return MotionLine(kind, values, status, time_us)


class VectorNavParser:
    """Bytes in, intact lines out. `$` occurs only at the start of a line, so it always starts a fresh one.

    `digits` is the form of checksum that is taken (None: either). Counts `bad` lines and `noise` bytes between lines.
    """

    def __init__(self) -> None:
        self.digits: int | None = None
        self.bad = 0
        self.noise = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Line]:
        """The lines completed by `data`, in order."""
        head, *starts = (self._rest + data).split(b"$")
        self.noise += len(head)
        self._rest = b""
        lines: list[Line] = []
        for index, piece in enumerate(starts):
            text, newline, after = piece.partition(b"\n")
            if not newline and index == len(starts) - 1 and len(piece) < LINE_MAX:
                self._rest = b"$" + piece
                break
            self.noise += len(after)
            try:
                lines.append(parse_line(b"$" + text + newline, self.digits))
            except ValueError:
                self.bad += 1
        return lines

    def reset(self) -> None:
        """Forget the unfinished line; the counts stay."""
        self._rest = b""
