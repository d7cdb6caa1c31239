"""Is the body at rest? Told from how quiet the inertial sensor is over a short window.

Slow even motion is as quiet as rest: what the detector says is a measurement of zero velocity that must pass the
filter's gate, never a command.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from docking.types import Array


@dataclass(frozen=True)
class ZeroVelocity:
    """Settings: window, largest sd of force and rate in it (root of the sum over the axes), and the sd of the pseudo
    measurements of velocity and of the rate that is taken for bias."""

    window_s: float = 0.25
    force_sd_m_s2: float = 0.14
    rate_sd_rad_s: float = 0.008
    velocity_sd_mm_s: float = 2.0
    rate_noise_rad_s: float = 0.002
    every_s: float = 0.02


class RestDetector:
    """Running sums over the window; one sample in, one answer out."""

    def __init__(self, settings: ZeroVelocity) -> None:
        self._s = settings
        self._window: deque[tuple[float, Array]] = deque()
        self._sum, self._squares = np.zeros(6), np.zeros(6)
        self._offset: Array | None = None
        self._next_s = -np.inf

    @property
    def force_m_s2(self) -> Array:
        """Mean specific force (3,) over the window."""
        assert self._offset is not None
        result: Array = (self._sum / max(len(self._window), 1) + self._offset)[:3]
        return result

    @property
    def rate_rad_s(self) -> Array:
        """Mean rate (3,) over the window."""
        assert self._offset is not None
        result: Array = (self._sum / max(len(self._window), 1) + self._offset)[3:]
        return result

    def sample(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> bool | None:
        """Whether the full window is quiet, judged every `every_s`; None in between."""
        row = np.concatenate((force_m_s2, rate_rad_s))
        if self._offset is None:
            self._offset = row
        row = row - self._offset  # near zero, so that sums of squares keep their digits
        self._window.append((t_s, row))
        self._sum += row
        self._squares += row * row
        while self._window[0][0] < t_s - self._s.window_s:
            _, old = self._window.popleft()
            self._sum -= old
            self._squares -= old * old
        if t_s < self._next_s or t_s - self._window[0][0] < 0.9 * self._s.window_s:
            return None
        self._next_s = t_s + self._s.every_s
        n = len(self._window)
        mean = self._sum / n
        var = self._squares / n - mean * mean
        quiet = var[:3].sum() < self._s.force_sd_m_s2**2 and var[3:].sum() < self._s.rate_sd_rad_s**2
        return bool(quiet)
