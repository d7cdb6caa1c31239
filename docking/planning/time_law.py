"""One scalar s(t), 0 to 1, for all axes: quintic, or seven segments of constant jerk. docs/mechanics.md (33), (34).

A law is a piecewise polynomial in u = t / T. Stretching T scales s', s'', s''' by 1/T, 1/T^2, 1/T^3 exactly, so the
shortest T of one shape follows from its peaks in one step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from docking.types import Array


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """`breaks` (p,) starts of the pieces in u, `coefficients` (p, 6) ascending powers of (u - break)."""

    kind: str
    duration_s: float
    breaks: Array
    coefficients: Array

    def stretched_to(self, duration_s: float) -> TimeLaw:
        """The same shape over another duration."""
        return replace(self, duration_s=duration_s)

    def at(self, t_s: Array) -> Array:
        """s (n,) at times `t_s` (n,); 0 before the start, exactly 1 from the end on."""
        u = np.clip(t_s / self.duration_s, 0.0, 1.0)
        piece = np.searchsorted(self.breaks, u, side="right") - 1
        local = u - self.breaks[piece]
        columns = self.coefficients.T
        s = columns[5][piece]
        for power in (4, 3, 2, 1, 0):
            s = s * local + columns[power][piece]
        s[u >= 1.0] = 1.0
        result: Array = np.clip(s, 0.0, 1.0)
        return result

    def samples(self, per_law: int) -> Array:
        """About `per_law` samples of s, ds/dt, d2s/dt2, d3s/dt3 (4, n), both ends of every piece included."""
        count = max(9, per_law // len(self.breaks))
        widths = np.diff(np.append(self.breaks, 1.0))
        local = widths[:, None] * np.linspace(0.0, 1.0, count)
        powers = local[:, :, None] ** np.arange(6)
        rows, weights = [], self.coefficients
        for order in range(4):
            values = np.einsum("pnc,pc->pn", powers[:, :, : weights.shape[1]], weights)
            rows.append(values.reshape(-1) / self.duration_s**order)
            weights = weights[:, 1:] * np.arange(1, weights.shape[1])
        return np.stack(rows)


def quintic(duration_s: float = 1.0) -> TimeLaw:
    """s = 10 u^3 - 15 u^4 + 6 u^5: speed and acceleration zero at both ends; peaks 15/8, 10/sqrt(3), 60."""
    return TimeLaw("quintic", duration_s, np.zeros(1), np.array([[0.0, 0.0, 0.0, 10.0, -15.0, 6.0]]))


def s_curve(v: float, a: float, j: float) -> TimeLaw:
    """Fastest law with |s'| <= v, |s''| <= a, |s'''| <= j: T = 1/v + v/a + a/j when all three are met."""
    rise, ramp = a / j, v / a + a / j
    if v * j < a * a:  # the speed is reached before the acceleration
        rise, ramp = (v / j) ** 0.5, 2.0 * (v / j) ** 0.5
    if v * ramp > 1.0:  # the way ends before the speed is reached
        peak = 0.5 * (-a * a / j + ((a * a / j) ** 2 + 4.0 * a) ** 0.5)
        rise, ramp = a / j, peak / a + a / j
        if peak * j < a * a:
            rise = (0.5 / j) ** (1.0 / 3.0)
            ramp = 2.0 * rise
        v = 1.0 / ramp
    cruise = max(1.0 / v - ramp, 0.0)
    flat = max(ramp - 2.0 * rise, 0.0)
    times = np.array([rise, flat, rise, cruise, rise, flat, rise])
    return _from_jerks(times, np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]))


def _from_jerks(times: Array, jerks: Array) -> TimeLaw:
    """The law of seven pieces with `jerks` of equal size, scaled to end at s = 1."""
    keep = times > 1e-12 * times.sum()
    duration_s = float(times[keep].sum())
    times, jerks = times[keep] / duration_s, jerks[keep]
    state = np.zeros(3)
    rows = []
    for width, jerk in zip(times, jerks, strict=True):
        position, speed, acceleration = state
        rows.append([position, speed, 0.5 * acceleration, jerk / 6.0, 0.0, 0.0])
        state = np.array(
            [
                position + speed * width + acceleration * width**2 / 2.0 + jerk * width**3 / 6.0,
                speed + acceleration * width + jerk * width**2 / 2.0,
                acceleration + jerk * width,
            ]
        )
    breaks = np.concatenate([[0.0], np.cumsum(times)[:-1]])
    return TimeLaw("s-curve", duration_s, breaks, np.array(rows) / state[0])
