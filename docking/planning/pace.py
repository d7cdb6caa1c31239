"""How fast one rigid path may be run: the shortest time law inside all limits. docs/mechanics.md (35) to (38).

Along the path `q' = g s'`, `q'' = g s'' + h s'^2`, `q''' = g s''' + 3 h s' s'' + l s'^3`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from docking.errors import AxisLimitExceeded
from docking.kinematics import Positioners
from docking.planning.jam import JamBound
from docking.planning.path import RigidPath
from docking.planning.settings import PlanSettings
from docking.planning.time_law import TimeLaw, quintic, s_curve
from docking.types import Array

_SAMPLES = 257
_GUARD = 1.0002
"""Stretch that covers what peaks between two samples of the law."""
_LEAST_PERIODS = 4
_NEARLY = 0.98
"""A limit this near to the strictest is named before it when it stands earlier in the list: speeds first."""
_SPEEDS = "stage speed", "lateness"
_DIVISIONS = (1.0, 0.6, 0.3, 0.15)


@dataclass(frozen=True, eq=False)
class Motion:
    """A law on a path at samples in time: |q'|, |q''|, |q'''| (n, m), peak speed of sockets and pivot, peak ds/dt."""

    speed: Array
    acceleration: Array
    jerk: Array
    point_speed: float
    rate: float


def motion_along(path: RigidPath, law: TimeLaw) -> Motion:
    """Axis speeds, accelerations and jerks of `law` on `path`."""
    s, ds, dds, ddds = law.samples(_SAMPLES)
    g, h, third = (path.axis_derivative(s, order) for order in (1, 2, 3))
    d1, d2, d3 = ds[:, None], dds[:, None], ddds[:, None]
    return Motion(
        np.abs(g * d1),
        np.abs(g * d2 + h * d1**2),
        np.abs(g * d3 + 3.0 * h * d1 * d2 + third * d1**3),
        float(np.max(path.point_speed_mm(s) * d1)),
        float(np.max(ds)),
    )


@dataclass(frozen=True, eq=False)
class PaceLimits:
    """What bounds one move: the axes, speeds of the fastest ball or the pivot, the bus's period, settings.

    `speeds_mm_s`: what the stage asks, and what the lateness of the cycles permits. `linear`: the devices interpolate
    each axis linearly over a period, so the chord error binds.
    """

    positioners: Positioners
    speeds_mm_s: tuple[float, float]
    period_s: float
    linear: bool
    settings: PlanSettings
    jam: JamBound

    def stretches(self, path: RigidPath, law: TimeLaw) -> list[tuple[float, str]]:
        """(factor, limit) by which `law` must be stretched (shrunk below 1) to just meet each limit."""
        motion = motion_along(path, law)
        axes, share = self.positioners, self.settings.acceleration_share
        skew = self._skew(motion, law)
        found = [(motion.point_speed / v, name) for v, name in zip(self.speeds_mm_s, _SPEEDS, strict=True)]
        found.append((skew, "start skew of the bus"))
        found += self.jam.stretches(motion.speed.max(axis=0))
        ratios = {"speed": motion.speed.max(axis=0) / axes.v_mm_s}
        if self.settings.playback_ramp_s > 0.0:
            ratios["stopping"] = self._stopping(motion)
        ratios["acceleration"] = np.sqrt(motion.acceleration.max(axis=0) / (share * axes.a_mm_s2))
        ratios["jerk"] = np.cbrt(motion.jerk.max(axis=0) / axes.j_mm_s3)
        found += [(float(r.max()), f"{axes.axes[int(r.argmax())]} {what}") for what, r in ratios.items()]
        if self.linear:
            found.append((self._chord(path, motion), "chord error of the interpolation"))
        return found

    def _stopping(self, motion: Motion) -> Array:
        """Stretch x per axis with |q''| / x^2 + |q'| / (ramp x) <= a: the devices' ramp adds |q'| / ramp."""
        limit = self.positioners.a_mm_s2
        ramp = motion.speed / self.settings.playback_ramp_s
        root: Array = (ramp + np.sqrt(ramp**2 + 4.0 * motion.acceleration * limit)) / (2.0 * limit)
        worst: Array = root.max(axis=0)
        return worst

    def _chord(self, path: RigidPath, motion: Motion) -> float:
        """Rotation per period over the largest that keeps L theta^2 / 8 inside the chord error."""
        largest = sqrt(8.0 * self.settings.chord_error_mm / path.spread_mm) if path.spread_mm > 0.0 else float("inf")
        return path.angle_rad * motion.rate * self.period_s / largest

    def _skew(self, motion: Motion, law: TimeLaw) -> float:
        """v (skew + 2 ppm T) <= delta. Stretching leaves v T as it is, so drift takes a fixed part of delta."""
        drift = motion.point_speed * law.duration_s * 2e-6 * self.settings.clock_ppm
        left = self.settings.sync_error_mm - drift
        if not left > 0.0:
            parts = ceil(drift / self.settings.sync_error_mm * 1.25)
            cause = f"Clock drift over the move in mm; {parts} moves with a stop between them would fit."
            raise AxisLimitExceeded("bus", cause, value=drift, limit=self.settings.sync_error_mm)
        return motion.point_speed * self.settings.start_skew_s / left


def fastest_law(path: RigidPath, limits: PaceLimits) -> tuple[TimeLaw, str]:
    """The shorter of quintic and seven-segment law within all limits, its duration a multiple of the period.

    Returns the law and the name of the limit that sets its duration.
    """
    if path.travel_mm <= 0.0:
        return quintic(_LEAST_PERIODS * limits.period_s), "standstill"
    stretched = []
    for law in (quintic(), *_s_curves_for(path, limits)):
        found = limits.stretches(path, law)
        factor = max(found)[0]
        reason = next(name for ratio, name in found if ratio >= _NEARLY * factor)
        stretched.append((law.stretched_to(law.duration_s * factor * _GUARD), reason))
    best, reason = min(stretched, key=lambda pair: pair[0].duration_s)
    periods = max(_LEAST_PERIODS, ceil(best.duration_s / limits.period_s - 1e-9))
    if periods == _LEAST_PERIODS:
        reason = "period of the bus"
    return best.stretched_to(periods * limits.period_s), reason


def _s_curves_for(path: RigidPath, limits: PaceLimits) -> Iterator[TimeLaw]:
    """Seven-segment laws whose shapes suit the limits projected on s; exact durations follow from their stretches.

    Where the devices' own ramp needs acceleration too, several divisions between path and ramp are tried.
    """
    axes, ramp_s = limits.positioners, limits.settings.playback_ramp_s
    g, h = (np.maximum(path.axis_bounds(order), 1e-12) for order in (1, 2))
    point_speed = float(path.point_speed_mm(np.linspace(0.0, 1.0, 17)).max())
    j = float(np.min(axes.j_mm_s3 / g))
    unjammed = 1.0 / max(factor for factor, _ in limits.jam.stretches(g))
    for part in (1.0,) if ramp_s == 0.0 else _DIVISIONS:
        usable = part * limits.settings.acceleration_share * axes.a_mm_s2
        bounds = [axes.v_mm_s / g, np.sqrt(0.25 * usable / h)]
        if ramp_s > 0.0:
            bounds.append(ramp_s * (axes.a_mm_s2 - usable) / g)
        v = min(unjammed, min(limits.speeds_mm_s) / point_speed, *(float(np.min(bound)) for bound in bounds))
        yield s_curve(v, float(np.min((usable - h * v**2) / g)), j)


def rate_slew_per_s(path: RigidPath, law: TimeLaw, limits: PaceLimits) -> float:
    """Largest |d rate / dt| of the playback rate that keeps |q''| + |q'| rate' inside every axis's acceleration."""
    if limits.settings.playback_ramp_s > 0.0:
        return 1.0 / limits.settings.playback_ramp_s
    motion = motion_along(path, law)
    spare = (limits.positioners.a_mm_s2 - motion.acceleration) / np.maximum(motion.speed, 1e-9)
    return min(float(spare.min()), limits.settings.rate_slew_max_per_s)
