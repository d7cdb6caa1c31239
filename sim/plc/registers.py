"""The register table of a simulated positioner PLC, written down apart from the driver's map.

All words are big-endian, 32-bit values high word first. Positions in um, forces in 10 N, times in ms.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from enum import IntEnum

AXES = 3
MAP_VERSION = 2
MAGIC = 0x12345678

COMMAND_AT, COMMAND = 0x00, struct.Struct(">HHH")
"""cmd_seq, cmd, axis_mask. Taken only as one whole write."""

HEARTBEAT_AT = 0x0F
SEGMENT_AT, SEGMENT_HEAD, SEGMENT_CRC = 0x10, struct.Struct(">IHHHH"), struct.Struct(">H")
"""plan_id u32, seg_seq, dt_ms, flags, n_axes; then crc16; then n_axes positions."""
SEGMENT_POINT = struct.Struct(f">{AXES}i")
SEGMENT_BYTES = SEGMENT_HEAD.size + SEGMENT_CRC.size + SEGMENT_POINT.size
FLAG_LAST = 1

SETTINGS_AT, SETTINGS = 0x40, struct.Struct(">5H")
"""watchdog_ms, ramp_ms, min_fill, stuck_um, servo_lag_us. Accepted only while disabled."""

MOTION_AT, MOTION = 0x50, struct.Struct(">HH")
"""quick_ramp_ms, rate_permille. Accepted only while path time stands still."""

STATUS_AT = 0x100
STATUS_HEAD = struct.Struct(">6HI7H")
"""hb_plc, hb_echo, state, fault, cmd_ack, cmd_result, plan_id u32, last_seq, play_seq, fraction, fifo_free,
seg_result, flags, station."""
STATUS_AXIS = struct.Struct(">ihhH")
"""position um, following error um, force 10 N, status bits."""

IDENTITY_AT, IDENTITY = 0x200, struct.Struct(">IHHHH32s16s16s16s8s")
"""magic, map version, axes, scan_ms, fifo capacity, station, vendor, product, serial, firmware."""

LIMITS_AT, LIMITS = 0x240, struct.Struct(">3i")
"""Each axis: stroke min um, stroke max um, speed um/s."""

NO_FORCE = -0x8000
FRACTION = 0x10000
FULL_RATE = 1000
AXIS_POWERED, AXIS_BRAKED, AXIS_PASSIVE, AXIS_FAULT, AXIS_LIMIT = 1, 2, 4, 8, 16
STATUS_RUN_LINE, STATUS_WATCHDOG_ARMED, STATUS_GROUP_LINE = 1, 2, 4


class State(IntEnum):
    """What the PLC is doing."""

    DISABLED = 1
    ENABLING = 2
    ENABLED = 3
    ARMED = 4
    RUNNING = 5
    STOPPING = 6
    HELD = 7
    DONE = 8
    DISABLING = 9
    FAULT = 10


class Command(IntEnum):
    """What the host may ask."""

    ENABLE = 1
    DISABLE = 2
    HOLD = 3
    QUICK_STOP = 4
    FAULT_RESET = 5
    RUN = 7
    CLEAR = 8
    RESUME = 10


class Fault(IntEnum):
    """Why the PLC stopped by itself."""

    NONE = 0
    UNDERRUN = 1
    WATCHDOG = 2
    FOLLOWING_ERROR = 3
    RUN_LINE = 4
    STUCK = 5
    LIMIT = 6
    DRIVE = 7
    QUICK_STOP = 8
    GROUP_LINE = 9


RAMPED = frozenset((Fault.UNDERRUN, Fault.WATCHDOG, Fault.RUN_LINE))
"""Faults that leave all axes in order: all ramp down over the RUN line before GROUP_OK falls."""


class Reject(IntEnum):
    """Why a segment (below 20) or a command was not taken."""

    NONE = 0
    SEQUENCE = 1
    CRC = 2
    PLAN = 3
    FULL = 4
    SHAPE = 5
    OFF_POSITION = 6
    PERIOD = 7
    STROKE = 8
    NOT_ENABLED = 9
    SPEED = 10
    AFTER_LAST = 11
    STATE = 20
    UNKNOWN = 21
    TOO_FEW = 22
    COMMAND_SEQUENCE = 23
    MASK = 24
    WATCHDOG = 25
    GROUP_LINE = 26


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE (polynomial 1021h, start FFFFh): "123456789" gives 29B1h."""
    return crc_hqx(data, 0xFFFF)


def following(sequence: int) -> int:
    """The number after `sequence` in 1..65535, 1 again."""
    return sequence % 0xFFFF + 1
