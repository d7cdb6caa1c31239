"""The tracker line protocol as bytes: framing, checksum and grammar (docs/line-protocol.md). Pure; no I/O, no clock.

    $<TYPE>,<seq>,<fields>*<CRC-16/ARC, 4 upper-case hex digits>\\r\\n

Nothing is guessed: a line that departs from the grammar in one character is counted and dropped. Numbers are decimal
integers in micrometres and microseconds, so NaN, infinity, exponents and decimal commas cannot be written at all.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LINE_MAX = 200
SEQ_MODULUS = 65536

VALID, DEGRADED, OCCLUDED, CHANGED, FACE_2 = 1, 2, 4, 8, 16
FLAG_MASK = 31


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
        table.append(value)
    return tuple(table)


_TABLE = _crc_table()
_SHARED_MAX = 256


def _share_tables() -> tuple[NDArray[np.uint16], list[NDArray[np.intp]]]:
    """What a byte adds to the register by its distance from the end, and where that stands for each length of data."""
    table = np.array(_TABLE, dtype=np.uint16)
    rows = [table]
    for _ in range(_SHARED_MAX - 1):
        rows.append((rows[-1] >> 8) ^ table[rows[-1] & 0xFF])
    starts = np.arange(_SHARED_MAX, dtype=np.intp) * 256
    return np.concatenate(rows[::-1]), [starts[_SHARED_MAX - length :] for length in range(_SHARED_MAX + 1)]


_SHARES, _STARTS = _share_tables()


def crc16_arc(data: bytes) -> int:
    """CRC-16/ARC: polynomial 0x8005 reflected, start 0, no final xor; 0xBB3D over b"123456789".

    With start 0 the sum is linear: the shares of the single bytes are looked up at once, which for lines of the usual
    length is faster than byte after byte.
    """
    if len(data) <= _SHARED_MAX:
        places = np.frombuffer(data, dtype=np.uint8) + _STARTS[len(data)]
        return int(np.bitwise_xor.reduce(_SHARES.take(places)))
    crc = 0
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def crcs16_arc(bodies: Sequence[bytes]) -> list[int]:
    """CRC-16/ARC of each of several data of at most 256 bytes: leading zeros add nothing, so all are padded in front to
    one length and looked up in one table."""
    width = max(map(len, bodies), default=0)
    padded = np.frombuffer(b"".join([body.rjust(width, b"\0") for body in bodies]), dtype=np.uint8)
    places = padded.reshape(len(bodies), width) + _STARTS[width]
    return list(map(int, np.bitwise_xor.reduce(_SHARES.take(places), axis=1)))


def encode(kind: str, seq: int, *fields: str | int) -> bytes:
    """One line of the host; ValueError when it would break the grammar."""
    body = ",".join((kind, str(seq), *map(str, fields)))
    if not _BODY.fullmatch(body):
        raise ValueError(f"not a line of the protocol: {body!r}")
    raw = body.encode("ascii")
    line = b"$%b*%04X\r\n" % (raw, crc16_arc(raw))
    if len(line) > LINE_MAX:
        raise ValueError(f"line of {len(line)} bytes, limit {LINE_MAX}")
    return line


class PointLine(NamedTuple):
    """`$PNT`: coordinates and their standard deviations in whole micrometres, frame of the station."""

    seq: int
    t_us: int
    target: str
    xyz_um: tuple[int, int, int]
    sigma_um: tuple[int, int, int]
    flags: int


@dataclass(frozen=True)
class RefusalLine:
    """`$ERR`: the device cannot do what was asked."""

    seq: int
    code: int
    words: str


@dataclass(frozen=True)
class AckLine:
    """`$ACK`: done, nothing to report."""

    seq: int


@dataclass(frozen=True)
class HeartbeatLine:
    """`$HBT`: the device is alive; `state` is 0 idle, 1 measuring, 2 not ready. `seq` is the device's own counter."""

    seq: int
    t_us: int
    state: int


@dataclass(frozen=True)
class IdentityLine:
    """`$IDN`: answer to `$VER`; `protocol` is the version of this protocol that the device speaks."""

    seq: int
    protocol: int
    vendor: str
    product: str
    serial: str
    firmware: str


Reply = PointLine | RefusalLine | AckLine | HeartbeatLine | IdentityLine

_BODY = re.compile(r"[A-Z]{3},(?:0|[1-9][0-9]{0,4})(?:,[ -#%-)+\-./0-9:-~]*)*")
_UINT = r"(0|[1-9][0-9]{0,17})"
_INT = r"(0|-?[1-9][0-9]{0,8})"
_NAME = r"([A-Za-z0-9][A-Za-z0-9_.\-]{0,31})"
_TEXT = r"([ -#%-)+\-./0-9:-~]*)"
_SEQ = r"(0|[1-9][0-9]{0,4})"

_PNT = re.compile(f"PNT,{_SEQ},{_UINT},{_NAME}" + f",{_INT}" * 3 + r",(0|[1-9][0-9]{0,7})" * 3 + r",(0|[1-9][0-9]?)")
_ERR = re.compile(f"ERR,{_SEQ},([0-9]{{1,4}}),{_TEXT}")
_ACK = re.compile(f"ACK,{_SEQ}")
_HBT = re.compile(f"HBT,{_SEQ},{_UINT},([0-2])")
_IDN = re.compile(f"IDN,{_SEQ},([0-9]{{1,3}}),{_TEXT},{_TEXT},{_TEXT},{_TEXT}")


def _point(g: tuple[str, ...]) -> PointLine:
    x, y, z, sx, sy, sz, flags = map(int, g[3:])
    if flags & ~FLAG_MASK:
        raise ValueError(f"unknown flags {flags}")
    return PointLine(int(g[0]), int(g[1]), g[2], (x, y, z), (sx, sy, sz), flags)


def parse_body(body: str) -> Reply:
    """The reply that `body` (the text between $ and *) spells; ValueError for anything else."""
    reply: Reply
    if m := _PNT.fullmatch(body):
        reply = _point(m.groups())
    elif m := _HBT.fullmatch(body):
        reply = HeartbeatLine(int(m[1]), int(m[2]), int(m[3]))
    elif m := _ACK.fullmatch(body):
        reply = AckLine(int(m[1]))
    elif m := _ERR.fullmatch(body):
        reply = RefusalLine(int(m[1]), int(m[2]), m[3])
    elif m := _IDN.fullmatch(body):
        reply = IdentityLine(int(m[1]), int(m[2]), m[3], m[4], m[5], m[6])
    else:
        raise ValueError(f"not a reply of the protocol: {body!r}")
    if reply.seq >= SEQ_MODULUS:
        raise ValueError(f"seq {reply.seq}, limit {SEQ_MODULUS - 1}")
    return reply


def _framed(line: bytes) -> bool:
    return len(line) <= LINE_MAX and line[:1] == b"$" and line[-2:] == b"\r\n" and line[-7:-6] == b"*"


def parse_line(line: bytes) -> Reply:
    """One whole line, from $ to line feed, checksum verified; ValueError for anything else."""
    if not _framed(line):
        raise ValueError("not framed as a line")
    body = line[1:-7]
    if line[-6:-2] != b"%04X" % crc16_arc(body):
        raise ValueError("checksum differs")
    return parse_body(body.decode("ascii"))


class LineParser:
    """Bytes in, intact replies out. `$` occurs only at the start of a line, so it always starts a fresh one.

    Counts `bad` lines (framing, checksum, grammar) and `noise` bytes between lines. Keeps at most one unfinished
    line of LINE_MAX bytes.
    """

    def __init__(self) -> None:
        self.bad = 0
        self.noise = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Reply]:
        """The replies completed by `data`, in order."""
        head, *starts = (self._rest + data).split(b"$")
        self.noise += len(head)
        self._rest = b""
        lines: list[bytes] = []
        for index, piece in enumerate(starts):
            self._cut(piece, index == len(starts) - 1, lines)
        return self._parsed(lines)

    def _cut(self, piece: bytes, is_last: bool, lines: list[bytes]) -> None:
        """`piece` is what follows one `$`, up to the next one or to the end of what has arrived."""
        text, newline, after = piece.partition(b"\n")
        if not newline and is_last and len(piece) < LINE_MAX:
            self._rest = b"$" + piece
            return
        self.noise += len(after)
        line = b"$" + text + newline
        if _framed(line):
            lines.append(line)
        else:
            self.bad += 1

    def _parsed(self, lines: list[bytes]) -> list[Reply]:
        """The replies among framed lines; checksums of several are worked out together."""
        bodies = [line[1:-7] for line in lines]
        sums = crcs16_arc(bodies) if len(bodies) > 1 else [crc16_arc(body) for body in bodies]
        replies: list[Reply] = []
        for line, body, crc in zip(lines, bodies, sums, strict=True):
            try:
                if line[-6:-2] != b"%04X" % crc:
                    raise ValueError("checksum differs")
                replies.append(parse_body(body.decode("ascii")))
            except ValueError:
                self.bad += 1
        return replies

    def reset(self) -> None:
        """Forget the unfinished line; the counts stay."""
        self._rest = b""
