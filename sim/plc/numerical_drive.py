"""A simulated drive that moves by numbers written to 9900h..9908h, written down apart from the controller's map."""

from __future__ import annotations

import struct
from collections.abc import Callable

from sim.plc.modbus_tcp import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusRefusal

_MOVEMENT_AT, _MOVEMENT = 0x9900, struct.Struct(">iiiHHH")
_STATUS_AT, _STATUS = 0x9000, struct.Struct(">iHHHH")
_SERVO, _ALARM, _HOMED, _THERE = 1 << 12, 1 << 10, 1 << 4, 1 << 3
OVER_SPEED, NOT_HOMED = 0xA3, 0x83
"""Alarm codes that this simulated drive uses for itself."""


class NumericalAxis:
    """One axis on the clock `clock`, moving at constant speed. Positions in mm."""

    def __init__(self, clock: Callable[[], float], v_max_mm_s: float = 100.0) -> None:
        self._clock, self._v_max_mm_s = clock, v_max_mm_s
        self.servo = self.homed = True
        self.alarm = 0
        self.moves = 0
        self._from_mm = self._to_mm = self._speed_mm_s = 0.0
        self._since_s = clock()

    @property
    def position_mm(self) -> float:
        """Where the axis is now."""
        way_mm = self._to_mm - self._from_mm
        gone_mm = min(abs(way_mm), self._speed_mm_s * (self._clock() - self._since_s))
        return self._from_mm + (gone_mm if way_mm >= 0.0 else -gone_mm)

    def read(self, address: int, count: int) -> bytes:
        """The status block from its start."""
        at_mm = self.position_mm
        device = _SERVO * self.servo | _ALARM * bool(self.alarm) | _HOMED * self.homed | _THERE * (at_mm == self._to_mm)
        data = _STATUS.pack(round(at_mm * 100.0), self.alarm, 0, 0, device)[: 2 * count]
        if address != _STATUS_AT or len(data) != 2 * count:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return data

    def write(self, address: int, data: bytes) -> None:
        """The whole movement block: the axis goes at once."""
        if address != _MOVEMENT_AT or len(data) != _MOVEMENT.size:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        position, band, speed, acceleration, _push, control = _MOVEMENT.unpack(data)
        if not (abs(position) <= 999999 and band >= 1 and speed >= 1 and acceleration and control == 0):
            raise ModbusRefusal(ILLEGAL_VALUE)
        if not speed / 100.0 <= self._v_max_mm_s or not self.homed:
            self.alarm = OVER_SPEED if self.homed else NOT_HOMED
            return
        self.moves += 1
        self._from_mm, self._to_mm = self.position_mm, position / 100.0
        self._speed_mm_s, self._since_s = speed / 100.0, self._clock()
