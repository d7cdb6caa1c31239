"""Profile position of the simulated drives: each goes to its target by its own trapezoid once told by an edge."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from docking.types import Array

PP: Final = 1
NEW_SET_POINT, HALT = 1 << 4, 1 << 8
REACHED, ACKNOWLEDGED = 1 << 10, 1 << 12

TICK_S = 2e-3


class Profile:
    """m axes. `speed_mm_s`, `acceleration_mm_s2`, `deceleration_mm_s2` (m,) are 6081h, 6083h, 6084h; a halt ramps down
    by 6084h. A set-point is taken on the edge of bit 4 and acknowledged by bit 12 as long as that bit is there."""

    def __init__(self, count: int) -> None:
        self.speed_mm_s: Array = np.ones(count)
        self.acceleration_mm_s2: Array = np.full(count, 10.0)
        self.deceleration_mm_s2: Array = np.full(count, 10.0)
        self._target: dict[int, float] = {}
        self._rate: dict[int, float] = {}
        self._halted: set[int] = set()
        self._acknowledged: set[int] = set()

    def bits(self, index: int) -> int:
        """Bits 10 and 12 of the statusword in profile position."""
        idle = index not in self._target or (index in self._halted and self._rate.get(index, 0.0) == 0.0)
        return REACHED * idle | ACKNOWLEDGED * (index in self._acknowledged)

    def control(self, index: int, before: int, word: int, target_mm: float) -> None:
        """A controlword to an axis that is under torque."""
        (self._halted.add if word & HALT else self._halted.discard)(index)
        if word & ~before & NEW_SET_POINT:
            self._target[index] = target_mm
            self._rate.setdefault(index, 0.0)
            self._acknowledged.add(index)
        elif not word & NEW_SET_POINT:
            self._acknowledged.discard(index)

    def leave(self, index: int) -> None:
        """The axis is no longer under torque in this mode."""
        self._target.pop(index, None)
        self._rate.pop(index, None)
        self._acknowledged.discard(index)

    def speed(self, index: int) -> float:
        """Signed speed of the set-point, mm/s."""
        return self._rate.get(index, 0.0)

    def step(self, index: int, dt_s: float, now_mm: float) -> float:
        """Set-point of one axis a step later; in steps of about 2 ms, as a position controller takes them."""
        if index not in self._target:
            return now_mm
        count = max(1, round(dt_s / TICK_S))
        for _ in range(count):
            now_mm = self._tick(index, dt_s / count, now_mm)
        return now_mm

    def _tick(self, index: int, dt_s: float, now_mm: float) -> float:
        target, rate = self._target.get(index), self._rate.get(index, 0.0)
        if target is None or dt_s <= 0.0:
            return now_mm
        way = target - now_mm
        sign = 1.0 if way >= 0.0 else -1.0
        up, down = float(self.acceleration_mm_s2[index]), float(self.deceleration_mm_s2[index])
        speed = rate * sign
        if index in self._halted:
            wanted = max(0.0, speed - down * dt_s)
        else:
            braking = math.sqrt(max(0.0, 2.0 * down * abs(way)))
            wanted = min(speed + up * dt_s, float(self.speed_mm_s[index]), braking)
        gone = 0.5 * (speed + wanted) * dt_s
        if index not in self._halted and (gone >= abs(way) or abs(way) <= down * dt_s * dt_s):
            self._target.pop(index)
            self._rate[index] = 0.0
            return target
        self._rate[index] = wanted * sign
        return now_mm + sign * gone
