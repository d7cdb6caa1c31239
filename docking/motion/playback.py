"""Path time: a plan's table is read at a rate that holds and stops bring to zero, so every stop stays on the path."""

from __future__ import annotations

import numpy as np

from docking.planning import position_at
from docking.types import Array, Plan

ROW_S = 1e-9
"""Path times nearer than this to a row are that row: rounding of the sum of cycles, far below any clock."""


class Playback:
    """Reads a plan's table at path time tau, d(tau)/dt = rate in 0..1. `share` is the rate at which it runs.

    A change of the rate takes 1.5 |change| / slew seconds along a cubic, so ds/dt is smooth and its largest slope is
    the plan's `rate_slew_per_s`. At full rate the rows themselves are the set-points; between rows, as a hold leaves
    it, the plan's own interpolation keeps the part rigid.
    """

    def __init__(self, plan: Plan, share: float = 1.0) -> None:
        self.plan = plan
        self.path_time_s = 0.0
        self.rate = share
        self._share, self._held, self._straight = share, False, False
        self._from, self._to, self._since, self._span = share, share, 0.0, 0.0
        self._q = plan.q_mm
        self._last = len(plan.q_mm) - 1
        self._columns = np.arange(plan.q_mm.shape[1])
        self._period = plan.period_s

    def hold(self) -> None:
        """Come to rest; harder stops that are under way go on."""
        self._held = True
        if not (self._straight and self._to == 0.0):
            self.turn_to(0.0)

    def stop_straight(self, slew_per_s: float) -> None:
        """Come to rest along a straight line of time, faster than a hold does."""
        self._held = True
        self._turn(0.0, self.rate / slew_per_s, straight=True)

    def resume(self) -> None:
        """Run again, at the rate last asked for."""
        self._held = False
        self.turn_to(self._share)

    def override(self, share: float) -> None:
        """Run at another rate, 0..1; a hold goes on."""
        self._share = share
        if not self._held:
            self.turn_to(share)

    def wait(self) -> None:
        """Stand where it is until it is resumed."""
        self._held = True
        self.rate = self._from = self._to = 0.0

    def turn_to(self, rate: float) -> None:
        """Begin to bring the rate to `rate` along a cubic."""
        self._turn(rate, self.turn_s(rate), straight=False)

    def turn_s(self, rate: float) -> float:
        """How long it takes to bring the rate to `rate`."""
        return 1.5 * abs(rate - self.rate) / self.plan.rate_slew_per_s

    def _turn(self, rate: float, span_s: float, *, straight: bool) -> None:
        self._from, self._to, self._since, self._span = self.rate, rate, 0.0, span_s
        self._straight = straight

    @property
    def at_end(self) -> bool:
        return self.path_time_s >= self.plan.duration_s - ROW_S

    @property
    def standing(self) -> bool:
        return self.rate == 0.0 and self._to == 0.0

    def advance(self, dt_s: float) -> Array:
        """Move on by `dt_s` and return the set-point (m,)."""
        if self.rate != self._to:
            self._since += dt_s
            before = self.rate
            self.rate = self._rate_now()
            self.path_time_s += 0.5 * (before + self.rate) * dt_s
        else:
            self.path_time_s += self.rate * dt_s
        return self.setpoint_at(self.path_time_s)

    def _rate_now(self) -> float:
        u = self._since / self._span if self._span > 0.0 else 1.0
        if not (u < 1.0 - 1e-9):
            return self._to
        return self._from + (self._to - self._from) * (u if self._straight else u * u * (3.0 - 2.0 * u))

    def setpoint_at(self, path_time_s: float) -> Array:
        """The set-point (m,) at a path time; clamped to the ends of the table."""
        row = max(0, round(path_time_s / self._period))
        if row >= self._last:
            end: Array = self._q[self._last]
            return end
        if abs(path_time_s - row * self._period) < ROW_S:
            exact: Array = self._q[row]
            return exact
        return position_at(self.plan, path_time_s)

    def chord_at(self, path_time_s: Array | float) -> Array:
        """Where devices that interpolate each axis linearly between rows stand (m,) at a path time, one for all or one
        for each axis (m,)."""
        position = np.minimum(np.maximum(np.asarray(path_time_s) / self._period, 0.0), self._last)
        row = np.minimum(position.astype(np.intp), self._last - 1)
        start = self._q[row, self._columns]
        between: Array = start + (position - row) * (self._q[row + 1, self._columns] - start)
        return between

    def slope_at(self, path_time_s: Array | float) -> Array:
        """Axis speeds (m,) in mm/s of the table at full rate, at a path time, one for all or one for each axis."""
        row = np.minimum(np.maximum(np.asarray(path_time_s) / self._period, 0.0).astype(np.intp), self._last - 1)
        slope: Array = np.abs(self._q[row + 1, self._columns] - self._q[row, self._columns]) / self._period
        return slope

    def speed_at(self, path_time_s: float) -> Array:
        """Axis speeds (m,) in mm/s of the table at a path time, times the present rate."""
        row = min(int(max(path_time_s, 0.0) / self._period), self._last - 1)
        speed: Array = np.abs(self._q[row + 1] - self._q[row]) * (self.rate / self._period)
        return speed
