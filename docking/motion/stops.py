"""What a plan means for the stops: the drives' own ramps, and how hard path time may be stopped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.types import Array, Plan

NEAR_PEAK = 0.9
"""An armed ramp is for at least this part of the axis's largest speed."""
MOVING = 1e-3
"""Part of the largest ds/dt from which on a row counts as moving."""


@dataclass(frozen=True, eq=False)
class PlannedStop:
    """Stops of one plan.

    `peak_mm_s` (m,) and `t_stop_s`: a quick stop of every drive by itself with peak / t_stop keeps the speeds in
    proportion, so the figure stays straight; `longest_s` is what it takes at most. `fast_slew_per_s`: slope of a
    straight stop of path time.
    """

    peak_mm_s: Array
    t_stop_s: float
    fast_slew_per_s: float
    longest_s: float


def planned_stop(plan: Plan, a_quick_mm_s2: Array, least_s: float) -> PlannedStop:
    """Stops of `plan` for axes with quick-stop decelerations `a_quick_mm_s2` (m,); `least_s` bounds t_stop from below.

    t_stop = max_k peak_k / a_quick,k. Along a straight stop |q''| <= |q'| slew + |q''_plan| stays inside a_quick.
    A turning part changes the proportion of the speeds on its way, so the peak of an axis is taken as the middle of
    what the path asks of it, |dq/ds|, times the largest ds/dt: no more than `1 - NEAR_PEAK` under its true peak.
    """
    speed = np.abs(np.diff(plan.q_mm, axis=0)) / plan.period_s
    largest = speed.max(axis=0)
    along = np.maximum(speed[:-1], speed[1:])
    spare = a_quick_mm_s2 - np.abs(np.diff(plan.q_mm, 2, axis=0)) / plan.period_s**2
    slew = float(np.min(spare / np.maximum(along, 1e-9)))
    t_stop_s = max(float(np.max(largest / a_quick_mm_s2)), least_s)
    peak = np.maximum(_middle(plan, speed), NEAR_PEAK * largest)
    return PlannedStop(
        np.minimum(peak, largest), t_stop_s, max(slew, plan.rate_slew_per_s), max(t_stop_s / NEAR_PEAK, least_s)
    )


def _middle(plan: Plan, speed_mm_s: Array) -> Array:
    """Middle (m,) between least and largest |dq/ds| on the way, times the largest ds/dt."""
    rate = np.diff(plan.s) / plan.period_s
    moving = rate > MOVING * rate.max()
    if not moving.any():
        return np.zeros(speed_mm_s.shape[1])
    slope = speed_mm_s[moving] / rate[moving, None]
    middle: Array = 0.5 * (slope.min(axis=0) + slope.max(axis=0)) * rate.max()
    return middle
