"""Whether axes that ramp down by themselves have come to rest, seen from their read-backs."""

from __future__ import annotations

import numpy as np

from docking.types import Feedback

REST_MM = 0.002
"""An axis that moves no more between two cycles stands..."""
REST_CYCLES = 3
"""...when it did so for these cycles, reporting at most..."""
REST_AGE = 2
"""...so many cycles late: an axis that is not heard of is not known to stand."""


class Standstill:
    """Counts the cycles in which nothing moved."""

    def __init__(self) -> None:
        self._still = 0

    def begin(self) -> None:
        """Count from here on."""
        self._still = 0

    def seen(self, before: Feedback | None, now: Feedback, gone: tuple[int, ...] = ()) -> bool:
        """Judge one cycle; true when all axes stand. Those `gone` (indices) have no torque and no voice any more."""
        moved = np.inf if before is None else np.abs(now.position_mm - before.position_mm).max()
        resting = moved <= REST_MM and np.delete(now.age_cycles, gone).max() <= REST_AGE
        self._still = self._still + 1 if resting else 0
        return self._still >= REST_CYCLES
