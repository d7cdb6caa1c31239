"""What the drives of a cell were told: limits by SDO, and the forces that axes in torque mode shall exert."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

BoolArray = NDArray[np.bool_]


class Parameters:
    """What the drives were told by SDO, as arrays (m,) in mm, s."""

    def __init__(self, count: int) -> None:
        self.low_mm: Array = np.full(count, -np.inf)
        self.high_mm: Array = np.full(count, np.inf)
        self.window_mm: Array = np.full(count, np.inf)
        self.window_s: Array = np.zeros(count)
        self.max_force_n: Array = np.full(count, np.inf)
        self.max_speed_mm_s: Array = np.full(count, np.inf)
        self.decel_mm_s2: Array = np.full(count, 100.0)
        self.quick_stop_option: list[int] = [2] * count
        self.fault_option: list[int] = [2] * count


class ForceTargets:
    """What the axes in cyclic synchronous torque mode exert, in newtons at the ball, (m,)."""

    def __init__(self, count: int, limits: Parameters) -> None:
        self.pressing: BoolArray = np.zeros(count, np.bool_)
        self.changed = False
        self._limits = limits
        self._target_n: Array = np.zeros(count)
        self._before_mm: Array | None = None
        self._here_mm: Array | None = None
        self._elapsed_s = 1.0

    def aim(self, index: int, force_n: float) -> None:
        """Target force of one axis, cut to what the drive was permitted."""
        limit = float(self._limits.max_force_n[index])
        force_n = min(max(force_n, -limit), limit)
        self.changed = self.changed or (force_n != self._target_n[index] and bool(self.pressing[index]))
        self._target_n[index] = force_n

    def take(self, index: int) -> None:
        """One axis begins to exert its target force."""
        self.pressing[index] = self.changed = True
        self._before_mm = self._here_mm = None

    def release(self, index: int) -> bool:
        """One axis ceases to; False when it did not press."""
        if not self.pressing[index]:
            return False
        self.pressing[index] = False
        self.changed = True
        return True

    def note(self, standing_mm: Array, elapsed_s: float) -> None:
        """Keep where the axes are taken."""
        self._before_mm, self._here_mm, self._elapsed_s = self._here_mm, standing_mm, elapsed_s

    def speed_mm_s(self, index: int) -> float:
        """How fast one axis is taken along."""
        if self._before_mm is None or self._here_mm is None:
            return 0.0
        return float(self._here_mm[index] - self._before_mm[index]) / self._elapsed_s

    def exerted_n(self) -> Array:
        """Force of the axes that press (m,), NaN for all others; taken as passed on to the plant."""
        self.changed = False
        return np.where(self.pressing, self._target_n, np.nan)
