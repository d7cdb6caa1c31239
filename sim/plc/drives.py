"""Drives in fault: an axis that leaves the set-points of its PLC and comes to rest by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

BoolArray = NDArray[np.bool_]


@dataclass
class _Ramp:
    """Where the drive's own ramp is, or where it lost its torque."""

    position_mm: float
    speed_mm_s: float
    torque: bool


class FailedDrives:
    """Replaces the set-points of drives in fault. `a_quick_mm_s2` (m,) are the decelerations of their own ramps."""

    def __init__(self, a_quick_mm_s2: Array) -> None:
        self._a_quick = a_quick_mm_s2
        self._ramps: dict[int, _Ramp] = {}

    @property
    def indices(self) -> tuple[int, ...]:
        return tuple(self._ramps)

    def fail(self, index: int, position_mm: float, speed_mm_s: float, torque: bool) -> None:
        """The drive ramps down from its set-point and speed; without torque its brake takes the axis."""
        self._ramps[index] = _Ramp(position_mm, speed_mm_s, torque)

    def repair(self, index: int) -> None:
        """The drive follows its PLC again."""
        self._ramps.pop(index, None)

    def lead(
        self, dt_s: float, target_mm: Array, powered: BoolArray, braked: BoolArray
    ) -> tuple[Array, BoolArray, BoolArray]:
        """Set-points, torque and brakes (m,) as the drives make them of what their PLCs ask for."""
        target_mm, powered, braked = target_mm.copy(), powered.copy(), braked.copy()
        for index, ramp in self._ramps.items():
            target_mm[index] = self._further(ramp, float(self._a_quick[index]), dt_s)
            powered[index] &= ramp.torque
            braked[index] |= not ramp.torque
        return target_mm, powered, braked

    @staticmethod
    def _further(ramp: _Ramp, a_mm_s2: float, dt_s: float) -> float:
        run_s = min(dt_s, abs(ramp.speed_mm_s) / a_mm_s2)
        slower = ramp.speed_mm_s - float(np.copysign(a_mm_s2 * run_s, ramp.speed_mm_s))
        ramp.position_mm += 0.5 * (ramp.speed_mm_s + slower) * run_s
        ramp.speed_mm_s = slower if run_s == dt_s else 0.0
        return ramp.position_mm
