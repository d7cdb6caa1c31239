"""Between the object dictionaries and the power stages: values that change by themselves, writes that take effect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from docking.types import Array
from sim.canopen.dictionary import MM_PER_REVOLUTION, NEWTON_PER_PER_MILLE
from sim.canopen.drives import Drives
from sim.canopen.plant_axes import NEWTON_PER_COUNT, PlantAxes


class ObjectAccess:
    """Objects in the drives' units (counts, counts/s^2, 10 N) against millimetres and newtons."""

    def __init__(
        self,
        drives: Drives,
        plant: PlantAxes,
        counts_per_mm: float,
        now_s: Callable[[], float],
        shown_mm: Callable[[Array], Array],
    ) -> None:
        """`shown_mm` makes reported positions (m,) of the encoders' ones."""
        self._drives, self._plant, self._counts_per_mm, self._now_s = drives, plant, counts_per_mm, now_s
        self._shown_mm = shown_mm
        limits = drives.parameters
        self._lengths: dict[tuple[int, int], Array] = {
            (0x6065, 0): limits.window_mm,
            (0x6085, 0): limits.decel_mm_s2,
            (0x607D, 1): limits.low_mm,
            (0x607D, 2): limits.high_mm,
            (0x607C, 0): drives.homing.home_mm,
            (0x6099, 1): drives.homing.speed_mm_s,
            (0x6081, 0): drives.profile.speed_mm_s,
            (0x6083, 0): drives.profile.acceleration_mm_s2,
            (0x6084, 0): drives.profile.deceleration_mm_s2,
        }
        self._numbers: dict[int, list[int]] = {
            0x605A: limits.quick_stop_option,
            0x605E: limits.fault_option,
            0x6098: drives.homing.method,
        }

    def live(self, index: int, obj: int, sub: int) -> int | None:
        """Present value of an object that changes by itself, None for a stored one."""
        drives = self._drives
        if obj == 0x6041:
            return int(drives.statuswords[index])
        if obj == 0x6061:
            return drives.modes[index]
        if obj == 0x6064:
            return round(float(self._shown_mm(self._plant.encoder_mm())[index]) * self._counts_per_mm)
        if obj == 0x60F4:
            return round(float(self._plant.following_error_mm()[index]) * self._counts_per_mm)
        if obj == 0x603F:
            return drives.error_codes[index]
        if obj == 0x6092 and sub == 1:
            return round(MM_PER_REVOLUTION * self._counts_per_mm)
        if obj == 0x2100 and sub == 1:
            return round(float(np.nan_to_num(self._plant.force_n()[index])) / NEWTON_PER_COUNT)
        return None

    def changed(self, index: int, obj: int, sub: int, value: int) -> None:
        """A master has written an object of the power stage."""
        if (obj, sub) in self._lengths:
            self._lengths[obj, sub][index] = value / self._counts_per_mm
        elif obj in self._numbers:
            self._numbers[obj][index] = value
        elif obj == 0x6060:
            self._drives.select(index, value)
        elif obj == 0x6066:
            self._drives.parameters.window_s[index] = value * 1e-3
        elif obj == 0x6040:
            self._drives.control(index, value, self._now_s())
        elif obj == 0x6071:
            self._drives.forces.aim(index, value * NEWTON_PER_PER_MILLE)
        elif obj == 0x6072:
            self._drives.parameters.max_force_n[index] = value * NEWTON_PER_PER_MILLE
        elif obj == 0x6080:
            self._drives.parameters.max_speed_mm_s[index] = value * MM_PER_REVOLUTION / 60.0
        elif obj == 0x607A:
            self._drives.latch(np.array([index]), np.array([value / self._counts_per_mm]))
