"""CANopen frames: pure bytes <-> values. Integers are little-endian (CiA 301)."""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

import numpy as np

from docking.ports import CanFrame

NMT_START: Final = 0x01
NMT_PRE_OPERATIONAL: Final = 0x80

STATE_BOOT_UP: Final = 0
STATE_OPERATIONAL: Final = 5

COB_NMT: Final = 0x000
COB_SYNC: Final = 0x080
COB_EMERGENCY: Final = 0x080
COB_SDO_REPLY: Final = 0x580
COB_SDO_REQUEST: Final = 0x600
COB_HEARTBEAT: Final = 0x700
COB_INVALID: Final = 0x8000_0000
"""Bit 31 of a PDO's COB-ID: the PDO does not exist."""

SYNC: Final[CanFrame] = (COB_SYNC, b"")

SET_POINT: Final = np.dtype([("controlword", "<u2"), ("target", "<i4"), ("mode", "i1")])
"""RPDO1, 7 bytes."""
READ_BACK: Final = np.dtype([("statusword", "<u2"), ("position", "<i4"), ("following_error", "<i2")])
"""TPDO1, 8 bytes."""

_FORMATS: Final = {"u8": "<B", "i8": "<b", "u16": "<H", "i16": "<h", "u32": "<I", "i32": "<i"}


class Emergency(NamedTuple):
    """An emergency message: error code, error register 1001h, the maker's five bytes."""

    code: int
    register: int
    vendor: bytes


def nmt(command: int, node: int) -> CanFrame:
    """Network management command to one node (0 = all)."""
    return COB_NMT, bytes((command, node))


def heartbeat(node: int, state: int = STATE_OPERATIONAL) -> CanFrame:
    return COB_HEARTBEAT + node, bytes((state,))


def parse_emergency(data: bytes) -> Emergency:
    """Decode an emergency message (8 bytes); struct.error on another length."""
    code, register, vendor = struct.unpack("<HB5s", data)
    return Emergency(code, register, vendor)


def pack_value(kind: str, value: int) -> bytes:
    """One object's value as it travels; struct.error where it does not fit its type."""
    return struct.pack(_FORMATS[kind], value)


def unpack_value(kind: str, data: bytes) -> int:
    """One object's value; struct.error where the length does not match the type."""
    return int(struct.unpack(_FORMATS[kind], data)[0])


# SDO, seen from the client ---------------------------------------------------------------------------------------
def sdo_read(index: int, sub: int) -> bytes:
    """Upload request."""
    return struct.pack("<BHB4x", 0x40, index, sub)


def sdo_read_segment(toggle: int) -> bytes:
    return struct.pack("<B7x", 0x60 | toggle << 4)


def sdo_write(index: int, sub: int, data: bytes) -> bytes:
    """Download request: expedited for 1 to 4 bytes, else the first frame of a segmented transfer."""
    if 1 <= len(data) <= 4:
        return struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\x00")
    return struct.pack("<BHBI", 0x21, index, sub, len(data))


def sdo_write_segment(chunk: bytes, toggle: int, last: bool) -> bytes:
    """One segment of at most 7 bytes."""
    return bytes((toggle << 4 | (7 - len(chunk)) << 1 | int(last),)) + chunk.ljust(7, b"\x00")


def sdo_abort(index: int, sub: int, code: int) -> bytes:
    return struct.pack("<BHBI", 0x80, index, sub, code)


class SdoReply(NamedTuple):
    """A server's answer.

    `kind`: upload, upload-segmented, upload-segment, download, download-segment, abort or unknown.
    `address` is (index, sub) where the frame carries one; `code` is the abort code or the announced length;
    `toggle` and `last` belong to segments.
    """

    kind: str
    address: tuple[int, int] | None = None
    data: bytes = b""
    code: int = 0
    toggle: int = 0
    last: bool = False


def parse_sdo(frame: bytes) -> SdoReply:
    """Decode an SDO answer of 8 bytes; anything else is `unknown`."""
    if len(frame) != 8:
        return SdoReply("unknown")
    command, index, sub = struct.unpack_from("<BHB", frame)
    specifier, body = command >> 5, frame[4:]
    if specifier == 0:
        size = 7 - (command >> 1 & 7)
        return SdoReply("upload-segment", None, frame[1 : 1 + size], 0, command >> 4 & 1, bool(command & 1))
    if specifier == 1:
        return SdoReply("download-segment", toggle=command >> 4 & 1)
    if specifier == 2 and command & 2:
        size = 4 - (command >> 2 & 3) if command & 1 else 4
        return SdoReply("upload", (index, sub), body[:size])
    number = int(struct.unpack("<I", body)[0])
    kinds = {2: "upload-segmented", 3: "download", 4: "abort"}
    return SdoReply(kinds.get(specifier, "unknown"), (index, sub), code=number)
