"""The first waypoints of a path: lift the component off its seat, bring it level. docs/mechanics.md (51) to (53).

Level is as level as docked by design: gravity then pulls on the component along the same direction in C as
when docked. The shortest rotation leads there, so that the heading stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.types import Array, Correction, Pose

LEVEL_RAD = 2e-4
"""A component as level as 0.2 mm/m is level: the alignment turns it to its mate afterwards."""


@dataclass(frozen=True, eq=False)
class Raising:
    """`lift_mm` straight up (0: no lift), `level` whether the component is then brought level, both at `speed_mm_s`.

    `up_W` (3,) unit vector against gravity, `up_C` (3,) the direction in C that is up when docked; `pivot_C_mm` (3,)
    stays in place as the component is levelled.
    """

    lift_mm: float
    level: bool
    speed_mm_s: float
    up_W: Array
    up_C: Array
    pivot_C_mm: Array

    def lift(self, X_WC: Pose) -> Correction:
        """Straight up by `lift_mm`."""
        return Correction(X_WC.apply(self.pivot_C_mm), np.zeros(3), self.lift_mm * self.up_W)

    def levelling(self, X_WC: Pose) -> Correction:
        """The shortest rotation about the pivot that makes the component level."""
        return Correction(X_WC.apply(self.pivot_C_mm), self._turn(X_WC), np.zeros(3))

    def tilt_rad(self, X_WC: Pose) -> float:
        """How far from level the component is."""
        return float(np.linalg.norm(self._turn(X_WC)))

    def _turn(self, X_WC: Pose) -> Array:
        """Rotation vector (3,) in W from the component's up to the true one: theta = atan2(|a x b|, a . b)."""
        leaning = X_WC.R @ self.up_C
        across = np.cross(leaning, self.up_W)
        sine = float(np.linalg.norm(across))
        if sine == 0.0:
            return np.zeros(3)
        result: Array = np.arctan2(sine, float(leaning @ self.up_W)) / sine * across
        return result


def level_pivot_C_mm(balls_C_mm: Array, face_C_mm: Array, up_C: Array) -> Array:
    """The middle of the balls (k, 3) at the height of the docking face (3,): levelling lifts the balls least, and moves
    the docking face neither to the mate nor away from it."""
    middle = balls_C_mm.mean(axis=0)
    result: Array = middle + float((face_C_mm - middle) @ up_C) * up_C
    return result
