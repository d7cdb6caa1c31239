"""The small Kalman filters of [Zhao]'s decoupled form, all points and axes side by side.

Riccati in the printed order: M = Phi P Phi^T + Q; K = M H^T (H M H^T + R)^-1; P = (I - K H) M. With three states and
H = [1, 0, 0] the covariance is six numbers a channel, and its prediction one 6 x 6 product for all channels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

_ROWS, _COLS = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
_KEPT = 64
Mask = NDArray[np.bool_]


def transition(dt_s: float) -> Array:
    """Phi (3, 3) of value, rate and acceleration over `dt_s`: [Zhao]'s polynomial of order 2."""
    return np.array([[1.0, dt_s, 0.5 * dt_s * dt_s], [0.0, 1.0, dt_s], [0.0, 0.0, 1.0]])


def polynomial_noise(dt_s: float, density: float) -> Array:
    """Q (3, 3) of white noise of spectral density `density` (mm^2/s^5) in the rate of the acceleration."""
    t = dt_s
    shape = [
        [t**5 / 20.0, t**4 / 8.0, t**3 / 6.0],
        [t**4 / 8.0, t**3 / 3.0, t * t / 2.0],
        [t**3 / 6.0, t * t / 2.0, t],
    ]
    return density * np.array(shape)


def drift_noise(dt_s: float, force_density: float, bias_density: float) -> Array:
    """Q (3, 3) of [dp, dv, b]: white force noise (mm/s^2/sqrt(Hz)) and a walking bias (mm^2/s^5)."""
    t, a = dt_s, force_density**2
    return np.array(
        [[a * t**3 / 3.0, a * t * t / 2.0, 0.0], [a * t * t / 2.0, a * t, 0.0], [0.0, 0.0, bias_density * t]]
    )


def _six(matrix: Array) -> Array:
    """The upper triangle of (3, 3) as (6, 1)."""
    upper: Array = matrix[_ROWS, _COLS][:, None]
    return upper


def _spread(phi: Array) -> Array:
    """(6, 6): the upper triangle of Phi P Phi^T from that of P."""
    result = np.zeros((6, 6))
    for k, (i, j) in enumerate(zip(_ROWS, _COLS, strict=True)):
        for l, (m, n) in enumerate(zip(_ROWS, _COLS, strict=True)):  # noqa: E741
            result[k, l] = phi[i, m] * phi[j, n] + (phi[i, n] * phi[j, m] if m != n else 0.0)
    return result


class ThreeStateFilters:
    """`m` independent filters with three states, Phi as `transition`, H = [1, 0, 0].

    `x` (3, m) states, `p` (6, m) upper triangles of the covariances. `noise(dt)` gives Q (3, 3).
    """

    def __init__(self, x: Array, cov: Array, noise: Callable[[float], Array]) -> None:
        self.x, self._noise = x, noise
        self.p = np.repeat(_six(cov), x.shape[1], axis=1)
        self._steps: dict[float, tuple[Array, Array, Array]] = {}

    def copy(self) -> ThreeStateFilters:
        """The same filters at this moment, to look ahead with."""
        other = object.__new__(ThreeStateFilters)
        other.x, other.p, other._noise, other._steps = self.x, self.p, self._noise, self._steps
        return other

    def predict(self, dt_s: float) -> None:
        """Advance all channels by `dt_s`."""
        step = self._steps.get(dt_s)
        if step is None:
            phi = transition(dt_s)
            step = phi, _spread(phi), _six(self._noise(dt_s))
            if len(self._steps) < _KEPT:
                self._steps[dt_s] = step
        self.x = step[0] @ self.x
        self.p = step[1] @ self.p + step[2]

    def update(self, z: Array, variance: Array | float, mask: Mask | None = None) -> None:
        """Take the measurements `z` (m,) of the first state; channels outside `mask` (m,) stay as they are."""
        gain = self.p[:3] / (self.p[0] + variance)
        if mask is not None:
            gain = np.where(mask, gain, 0.0)
            z = np.where(mask, z, 0.0)
        self.x = self.x + gain * (z - self.x[0])
        self.p = self.p - gain[_ROWS] * self.p[_COLS]

    def cov(self, channel: int) -> Array:
        """Covariance (3, 3) of one channel."""
        full = np.empty((3, 3))
        full[_ROWS, _COLS] = full[_COLS, _ROWS] = self.p[:, channel]
        return full


class BiasFilters:
    """[Zhao]'s filter 1, order 0: `m` biases `b` (m,) mm/s^2 with variances `p` (m,).

    H = +t^2/2 belongs to INS minus image."""

    def __init__(self, count: int, variance: float, density: float) -> None:
        self.b, self.p, self._density = np.zeros(count), np.full(count, variance), density

    def step(self, dt_s: float, since_s: float, ins_minus_image_mm: Array, variance: Array, mask: Mask) -> None:
        """Predict by `dt_s` and take the differences (m,) at `since_s` after the INS began, where `mask` holds."""
        m = self.p + self._density * dt_s
        h = 0.5 * since_s * since_s
        gain = np.where(mask, m * h / (h * h * m + variance), 0.0)
        self.b = self.b + gain * (np.where(mask, ins_minus_image_mm, 0.0) - np.where(mask, h * self.b, 0.0))
        self.p = (1.0 - gain * h) * m
