"""Is the body at rest? Told from how quiet the inertial sensor is over a short window.

Quiet means: no louder than the sensor's own noise. Even motion is as quiet as rest: what the detector says is a
measurement of zero velocity that must pass the filter's gate, never a command. Where a body creeps evenly, as in
docking, leave it out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.tracking.types import InertialModel
from docking.types import Array

_ROOM = 4096


@dataclass(frozen=True)
class ZeroVelocity:
    """Settings: window; largest sd of force and rate in it as a multiple of the sensor's noise; sd of the pseudo
    measurement of velocity; that of the rate taken for bias, as a multiple of the noise of its mean, since windows
    overlap; the gate, largest squared Mahalanobis distance, that both must pass; and how long it has to have been
    quiet: a body that starts gently is quiet for a moment, too.
    """

    window_s: float = 0.25
    noise_ratio: float = 1.3
    velocity_sd_mm_s: float = 2.0
    rate_excess: float = 3.5
    gate: float = 11.0
    sure_s: float = 1.0
    every_s: float = 0.02


class RestDetector:
    """Keeps the samples of the window; one sample in, one answer out."""

    def __init__(self, settings: ZeroVelocity, model: InertialModel) -> None:
        self._s = settings
        self._force = 3.0 * (settings.noise_ratio * model.force_density) ** 2
        self._rate = 3.0 * (settings.noise_ratio * model.rate_density) ** 2
        self._rows = np.empty((_ROOM, 7))
        self._first = self._next = 0
        self._judge_s = -np.inf
        self.force_m_s2, self.rate_rad_s = np.zeros(3), np.zeros(3)
        """Means (3,) over the last judged window."""

    def sample(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> bool | None:
        """Whether the full window is quiet, judged every `every_s`; None in between."""
        if self._next == _ROOM:
            kept = self._rows[self._first :].copy()
            self._rows[: len(kept)] = kept
            self._first, self._next = 0, len(kept)
        row = self._rows[self._next]
        row[0], row[1:4], row[4:] = t_s, force_m_s2, rate_rad_s
        self._next += 1
        if t_s < self._judge_s:
            return None
        return self._judged(t_s)

    def _judged(self, t_s: float) -> bool | None:
        times = self._rows[self._first : self._next, 0]
        self._first += int(np.searchsorted(times, t_s - self._s.window_s))
        self._first = max(self._first, self._next - _ROOM // 2)
        window = self._rows[self._first : self._next]
        length_s = t_s - float(window[0, 0])
        self._judge_s = t_s + self._s.every_s
        if length_s < 0.8 * self._s.window_s or len(window) < 3:
            return None
        mean = window[:, 1:].mean(axis=0)
        off = window[:, 1:] - mean
        var = np.einsum("ij,ij->j", off, off) / len(window)
        self.force_m_s2, self.rate_rad_s = mean[:3], mean[3:]
        per_s = (len(window) - 1) / length_s
        return bool(var[:3].sum() < self._force * per_s and var[3:].sum() < self._rate * per_s)
