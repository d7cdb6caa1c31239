"""What a plan means for the stops: the drives' own ramps, and how hard path time may be stopped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.types import Array, Plan


@dataclass(frozen=True, eq=False)
class PlannedStop:
    """Stops of one plan.

    `peak_mm_s` (m,), each axis's own largest speed, and `t_stop_s`: a quick stop of every drive by itself with
    peak / t_stop keeps the speeds in proportion, so the figure stays straight, and takes `t_stop_s` at most.
    `fast_slew_per_s`: slope of a straight stop of path time.
    """

    peak_mm_s: Array
    t_stop_s: float
    fast_slew_per_s: float


def planned_stop(plan: Plan, a_quick_mm_s2: Array, least_s: float) -> PlannedStop:
    """Stops of `plan` for axes with quick-stop decelerations `a_quick_mm_s2` (m,); `least_s` bounds t_stop from below.

    t_stop = max_k peak_k / a_quick,k. Along a straight stop |q''| <= |q'| slew + |q''_plan| stays inside a_quick.
    """
    speed = np.abs(np.diff(plan.q_mm, axis=0)) / plan.period_s
    peak: Array = speed.max(axis=0)
    along = np.maximum(speed[:-1], speed[1:])
    spare = a_quick_mm_s2 - np.abs(np.diff(plan.q_mm, 2, axis=0)) / plan.period_s**2
    slew = float(np.min(spare / np.maximum(along, 1e-9)))
    return PlannedStop(peak, max(float(np.max(peak / a_quick_mm_s2)), least_s), max(slew, plan.rate_slew_per_s))
