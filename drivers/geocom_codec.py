"""Leica GeoCOM, ASCII form, as bytes: requests, replies, numbers, return codes, polar geometry. Pure; no I/O, no clock.

    request   %R1Q,<RPC>,<TrId>[,<crc>]:<P0>,<P1>...\\r\\n
    reply     %R1P,<RC_COM>,<TrId>[,<crc>]:<RC>,<P0>,<P1>...\\r\\n

The checksum form carries a decimal CRC-16/ARC over the line without `,<crc>` and without its end. Without it GeoCOM
has no checksum at all: a flipped digit is a valid number. The driver therefore asks for every value twice.

Station frame T: x = east, y = north, z = up; Hz turns clockwise from north, V is the zenith angle, so
x = d sin V sin Hz, y = d sin V cos Hz, z = d cos V. In face 2 the instrument reports Hz + pi and 2 pi - V, for which
the same three equations give the same point.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from docking.types import Array
from drivers.line_codec import crc16_arc

LINE_MAX = 512
TRID_MODULUS = 32768
MM_PER_M = 1000.0

COM_NULL_PROC = 0
COM_SET_DOUBLE_PRECISION = 107
COM_GET_DOUBLE_PRECISION = 108
CSV_INSTRUMENT_NO = 5003
CSV_INSTRUMENT_NAME = 5004
CSV_SW_VERSION = 5034
TMC_DO_MEASURE = 2008
TMC_GET_PRISM = 2023
TMC_SET_PRISM = 2024
TMC_SET_AIR = 2028
TMC_GET_AIR = 2029
TMC_GET_SIMPLE_MEA = 2108
TMC_GET_FULL_MEAS = 2167
AUT_MAKE_POSITIONING = 9027
AUT_SEARCH = 9029
AUT_FINE_ADJUST = 9037
AUS_SET_USER_ATR = 18005

RPC_NAMES = {
    COM_NULL_PROC: "NullProc",
    COM_SET_DOUBLE_PRECISION: "SetDoublePrecision",
    COM_GET_DOUBLE_PRECISION: "GetDoublePrecision",
    CSV_INSTRUMENT_NO: "GetInstrumentNo",
    CSV_INSTRUMENT_NAME: "GetInstrumentName",
    CSV_SW_VERSION: "GetSWVersion",
    TMC_DO_MEASURE: "DoMeasure",
    TMC_GET_PRISM: "GetPrismCorr",
    TMC_SET_PRISM: "SetPrismCorr",
    TMC_SET_AIR: "SetAtmCorr",
    TMC_GET_AIR: "GetAtmCorr",
    TMC_GET_SIMPLE_MEA: "GetSimpleMea",
    TMC_GET_FULL_MEAS: "GetFullMeas",
    AUT_MAKE_POSITIONING: "MakePositioning",
    AUT_SEARCH: "Search",
    AUT_FINE_ADJUST: "FineAdjust",
    AUS_SET_USER_ATR: "SetUserAtrState",
}

MOTOR_PROCEDURES = frozenset({AUT_MAKE_POSITIONING, AUT_SEARCH, AUT_FINE_ADJUST})
"""They turn the instrument and can be aborted."""

MEASUREMENTS = frozenset({TMC_GET_SIMPLE_MEA, TMC_GET_FULL_MEAS})

ABORT_LINE = b"c\r\n"
"""Stops a motorised function; the instrument answers with a question mark."""

DEGRADED_CODES = frozenset({1283, 1284})
"""Values are returned, their accuracy is not guaranteed."""

BUSY_CODES = frozenset({13, 1293})
"""Ask again shortly."""

NOT_OFFERED = 3081
"""The instrument does not have the procedure."""

NOT_FOUND_CODES = frozenset({8704, 8710})
"""Nothing in the window: a wider search may help."""

TARGET_CODES = {
    1285: "angles without a distance",
    1288: "angles only, accuracy not guaranteed",
    1289: "angles only, not corrected",
    1292: "the distance could not be measured",
    8704: "the search for the reflector timed out",
    8710: "no reflector in the search window",
    8711: "several reflectors in the search window",
    8712: "the surroundings disturb the search (light, haze)",
    8716: "the reflector could not be aimed at accurately",
}

REFUSAL_WORDS = {
    8: "aborted",
    1291: "distance settings: ppm or prism correction",
    3077: "the instrument timed out on the line",
    3078: "the instrument found the request in the wrong format",
    3080: "the instrument could not decode the request",
    3081: "the instrument does not offer this procedure",
    3093: "transaction number mismatch",
    3101: "the instrument received a bad checksum",
    3102: "checksum error on the line",
    3107: "another request was still running",
    3108: "the instrument is asleep",
    3109: "the instrument is switched off",
    8714: "automatic target recognition is switched off",
}


@dataclass(frozen=True)
class GeocomReply:
    """One reply: communication code, transaction number, return code, parameters as text (quotes kept)."""

    com: int
    trid: int
    rc: int
    params: tuple[str, ...]


_START = b"%R1P,"
_REPLY = re.compile(r"%R1P,(\d{1,5}),(\d{1,5})(,\d{1,5})?:(\d{1,5})((?:,.*)?)")
_PARAM = re.compile(r',("(?:[^"\\]|\\.)*"|[^",]*)')
_NUMBER = re.compile(r"-?\d{1,15}(?:\.\d{1,18})?(?:[eE][+-]?\d{1,2})?")
_ESCAPE = re.compile(r"\\(.)")


def encode_request(rpc: int, trid: int, params: tuple[int | float, ...], checksum: bool = False) -> bytes:
    """One request line; floats (m, rad) with 12 decimals and never an exponent."""
    values = ",".join(f"{v:.12f}" if isinstance(v, float) else str(v) for v in params)
    head = f"%R1Q,{rpc},{trid}"
    if checksum:
        head += f",{crc16_arc(f'{head}:{values}'.encode('ascii'))}"
    return f"{head}:{values}\r\n".encode("ascii")


def decode_reply(line: bytes, checksum: bool = False) -> GeocomReply:
    """The reply in one line without its end; ValueError for anything else, a missing or wrong checksum included."""
    text = line.decode("ascii")
    match = _REPLY.fullmatch(text)
    if not match or not text.isprintable():
        raise ValueError(f"not a GeoCOM reply: {text!r}")
    com, trid, crc, rc, tail = match.groups()
    if checksum:
        if crc is None:
            raise ValueError("reply without a checksum")
        bare = text[: match.start(3)] + text[match.end(3) :]
        if int(crc[1:]) != crc16_arc(bare.encode("ascii")):
            raise ValueError("checksum differs")
    params = tuple(_PARAM.findall(tail))
    if sum(len(p) + 1 for p in params) != len(tail):
        raise ValueError(f"parameters cannot be told apart: {tail!r}")
    return GeocomReply(int(com), int(trid), int(rc), params)


def number(param: str) -> float:
    """A finite decimal number; ValueError for NaN, infinity, decimal commas, hexadecimal, 1e400."""
    if not _NUMBER.fullmatch(param):
        raise ValueError(f"not a number: {param!r}")
    value = float(param)
    if not math.isfinite(value):
        raise ValueError(f"not finite: {param!r}")
    return value


def words(param: str) -> str:
    """The text of a quoted parameter, its escapes undone; other parameters as they are."""
    if len(param) >= 2 and param[0] == param[-1] == '"':
        return _ESCAPE.sub(r"\1", param[1:-1])
    return param


def polar_from_point(p_T_mm: ArrayLike, face: int) -> tuple[float, float]:
    """Hz in [0, 2 pi) and V, rad, that point at `p_T_mm` (3,) in `face` 1 (V < pi) or 2 (V > pi)."""
    east, north, up = (float(v) for v in np.asarray(p_T_mm, dtype=np.float64))
    hz, v = math.atan2(east, north), math.atan2(math.hypot(east, north), up)
    if face == 2:
        hz, v = hz + math.pi, 2.0 * math.pi - v
    return hz % (2.0 * math.pi), v


def point_from_polar(hz: float, v: float, slope_m: float) -> Array:
    """Point (3,) mm in the station frame from Hz, V (rad, either face) and the slope distance (m)."""
    d_mm = slope_m * MM_PER_M
    across = d_mm * math.sin(v)
    return np.array([across * math.sin(hz), across * math.cos(hz), d_mm * math.cos(v)])


class GeocomParser:
    """Bytes in, replies out; a line that begins anew inside another ends the first as bad.

    Counts `bad` lines (a reply begun and not good) and `noise` bytes (what is no reply at all).
    """

    def __init__(self, checksum: bool = False) -> None:
        self.bad = 0
        self.noise = 0
        self._checksum = checksum
        self._rest = b""

    def feed(self, data: bytes) -> list[GeocomReply]:
        """The replies completed by `data`, in order."""
        *lines, rest = (self._rest + data).split(b"\r\n")
        replies: list[GeocomReply] = []
        for line in lines:
            self._take(line, replies)
        if len(rest) > LINE_MAX:
            # A reply may have begun in the noise: its start is kept, and so are the bytes that could begin one.
            start = rest.rfind(_START)
            kept = rest[start:] if start >= 0 and len(rest) - start <= LINE_MAX else rest[1 - len(_START) :]
            self._drop(rest[: len(rest) - len(kept)])
            rest = kept
        self._rest = rest
        return replies

    def _take(self, line: bytes, replies: list[GeocomReply]) -> None:
        start = line.rfind(_START)
        if start < 0:
            self._drop(line if line.strip() != b"?" else b"")
            return
        self._drop(line[:start])
        try:
            replies.append(decode_reply(line[start:], self._checksum))
        except ValueError:
            self.bad += 1

    def _drop(self, piece: bytes) -> None:
        begun = piece.count(_START)
        self.bad += begun
        self.noise += 0 if begun else len(piece)

    def reset(self) -> None:
        """Forget the unfinished line; the counts stay."""
        self._rest = b""
