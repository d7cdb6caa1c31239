"""Faults of the sources, told from what they say: each is named, raised once, and again after it has gone.

`InertialWatch` looks at the samples (frozen, saturated, jumping clock), `FrameWatch` at the seen points against the
estimate (swapped, moved tracker, frozen camera, no agreement), `StepWatch` at the seen points against the sensor alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import (
    DockingError,
    PointsSwapped,
    ReferenceShifted,
    SensorFrozen,
    SensorSaturated,
    TimeJumped,
    TrackingLost,
)
from docking.tracking.types import BodyModel, InertialModel
from docking.types import Array

_NEVER_S = float("inf")
_SLOWEST_S = 2.0
"""A first step up to this long is taken for the source's pace."""
_STEADY_S = 1.0
"""A clock that has gone on for so long is right again."""
_LINE_S = 0.25
"""Frames farther apart say nothing about a step: what the sensor feels in between is not known well enough."""
_FELT_MM_S2 = 300.0
"""By so much an acceleration may be felt wrongly: attitude, scale, stamps that are late."""


@dataclass(frozen=True)
class WatchSettings:
    """When a source counts as faulty.

    `same_samples`, `same_frames`: equal values running that no noisy sensor gives. `jump_s`: step of a clock beyond the
    usual interval. `near_range`: share of the range that counts as saturated. `shift_frames`: refused frames running
    after which a common step of all points is the tracker's. `lost_s` without agreement before tracking begins anew.
    """

    same_samples: int = 12
    same_frames: int = 30
    jump_s: float = 0.1
    near_range: float = 0.995
    shift_frames: int = 5
    lost_s: float = 1.0


class Alarms:
    """Alarms waiting to be taken; a fault that stands is told once."""

    def __init__(self) -> None:
        self._standing: set[tuple[type[DockingError], str]] = set()
        self._waiting: list[DockingError] = []

    def raise_(self, error: DockingError) -> None:
        """Keep the alarm unless one of its kind stands for the same source."""
        key = type(error), error.where
        if key not in self._standing:
            self._standing.add(key)
            self._waiting.append(error)

    def gone(self, kind: type[DockingError], where: str) -> None:
        """The fault of that source is over: it would be told again."""
        self._standing.discard((kind, where))

    def taken(self) -> list[DockingError]:
        """All waiting alarms; afterwards none waits."""
        result, self._waiting = self._waiting, []
        return result


class ClockWatch:
    """Says of every stamp of a source whether its clock goes on as it did."""

    def __init__(self, settings: WatchSettings, alarms: Alarms, where: str) -> None:
        self._s, self._alarms, self._where = settings, alarms, where
        self._last_s, self._usual_s, self._steady_s = float("nan"), 0.0, 0.0

    def good(self, t_s: float) -> bool:
        """False for a stamp that goes back, repeats or jumps ahead."""
        step_s, self._last_s = t_s - self._last_s, t_s
        if step_s != step_s:
            return True
        if self._usual_s == 0.0 and 0.0 < step_s <= _SLOWEST_S:
            self._usual_s = step_s
        if not (0.0 < step_s <= self._limit_s):
            self._jumped(step_s)
            return False
        self._usual_s = 0.99 * self._usual_s + 0.01 * step_s
        self._steady_s += step_s
        if self._steady_s >= _STEADY_S:
            self._alarms.gone(TimeJumped, self._where)
        return True

    def silent(self, now_s: float) -> bool:
        """Whether nothing has come for so long that the source has to count as lost."""
        if not (now_s - self._last_s > self._limit_s):
            return False
        self._jumped(now_s - self._last_s)
        return True

    @property
    def _limit_s(self) -> float:
        return self._s.jump_s + 2.0 * self._usual_s

    def _jumped(self, step_s: float) -> None:
        self._steady_s = 0.0
        self._alarms.raise_(TimeJumped(self._where, value=step_s, limit=self._limit_s))


class InertialWatch:
    """Says of every sample whether it may be integrated."""

    def __init__(self, model: InertialModel, settings: WatchSettings, alarms: Alarms, where: str) -> None:
        self._model, self._s, self._alarms, self._where = model, settings, alarms, where
        self._clock = ClockWatch(settings, alarms, where)
        self._last: tuple[list[float], list[float]] | None = None
        self._same = 0
        self._force_limit = settings.near_range * model.force_range
        self._rate_limit = settings.near_range * model.rate_range

    def good(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> bool:
        """False for a sample that is frozen, saturated or behind a jump of its clock."""
        force, rate = force_m_s2.tolist(), rate_rad_s.tolist()
        same, self._last = self._last == (force, rate), (force, rate)
        ok = self._in_range(force, rate)
        moving = self._moving(same)
        return self._clock.good(t_s) and moving and ok

    def silent(self, now_s: float) -> bool:
        """Whether no sample has come for so long that the sensor has to count as lost."""
        return self._clock.silent(now_s)

    def _moving(self, same: bool) -> bool:
        self._same = self._same + 1 if same else 0
        if self._same < self._s.same_samples:
            if not same:
                self._alarms.gone(SensorFrozen, self._where)
            return True
        self._alarms.raise_(SensorFrozen(self._where, value=self._same, limit=self._s.same_samples))
        return False

    def _in_range(self, force: list[float], rate: list[float]) -> bool:
        f, w = max(max(force), -min(force)), max(max(rate), -min(rate))
        if not (f < self._force_limit):
            self._alarms.raise_(SensorSaturated(self._where, value=f, limit=self._model.force_range))
            return False
        if not (w < self._rate_limit):
            self._alarms.raise_(SensorSaturated(self._where, value=w, limit=self._model.rate_range))
            return False
        self._alarms.gone(SensorSaturated, self._where)
        return True


def swapped(predicted_mm: Array, seen_mm: Array, near_mm: float) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, where i is seen where j should be and the other way round, out of (k, 3) each."""
    gap = np.linalg.norm(seen_mm[:, None] - predicted_mm[None], axis=2)
    k = len(gap)
    return [
        (i, j)
        for i in range(k)
        for j in range(i + 1, k)
        if gap[i, j] <= near_mm and gap[j, i] <= near_mm and gap[i, i] > near_mm and gap[j, j] > near_mm
    ]


class FrameWatch:
    """Judges a frame's residuals: what lies behind points that were refused."""

    def __init__(self, body: BodyModel, settings: WatchSettings, alarms: Alarms) -> None:
        self._body, self._s, self._alarms, self._where = body, settings, alarms, f"{body.name} points"
        self._refused, self._since = 0, _NEVER_S
        self._same, self._before = 0, np.zeros(0)
        self.repeats = False
        """Whether the newest frame was that before it once more."""

    def frozen(self, xyz_mm: Array, resting: bool) -> bool:
        """Whether the camera repeats itself although the body moves."""
        same = xyz_mm.shape == self._before.shape and bool(np.all(xyz_mm == self._before)) and xyz_mm.size > 0
        self._before, self.repeats = xyz_mm, same
        self._same = self._same + 1 if same and not resting else 0
        if self._same < self._s.same_frames:
            if not same:
                self._alarms.gone(SensorFrozen, self._where)
            return False
        self._alarms.raise_(SensorFrozen(self._where, value=self._same, limit=self._s.same_frames))
        return True

    def used(self) -> None:
        """A frame agreed: whatever was wrong has gone."""
        self._refused, self._since = 0, _NEVER_S
        for kind in (ReferenceShifted, TrackingLost):
            self._alarms.gone(kind, self._body.name)

    def tell_swapped(self, names: tuple[str, ...], pairs: list[tuple[int, int]]) -> None:
        """Raise or clear the alarm of swapped points."""
        if pairs:
            cause = ", ".join(f"{names[i]} with {names[j]}" for i, j in pairs)
            self._alarms.raise_(PointsSwapped(self._body.name, cause))
        else:
            self._alarms.gone(PointsSwapped, self._body.name)

    def refused(self, t_s: float, residuals_mm: Array, sd_mm: float, stepped: bool = True) -> bool:
        """Count a frame of which nothing was used; True when tracking has to begin anew. Only points that `stepped`
        away from where they were can have been taken there by the tracker."""
        self._refused += 1
        self._since = min(self._since, t_s)
        shift = residuals_mm.mean(axis=0)
        size = float(np.linalg.norm(shift))
        spread = float(np.sqrt(np.mean(np.sum((residuals_mm - shift) ** 2, axis=1))))
        together = spread <= 0.2 * size + 3.0 * sd_mm
        if self._refused >= self._s.shift_frames and together and stepped:
            limit = 5.0 * sd_mm
            self._alarms.raise_(ReferenceShifted(self._body.name, value=size, limit=limit))
        blind_s = t_s - self._since
        if blind_s >= self._s.lost_s:
            self._alarms.raise_(TrackingLost(self._body.name, value=blind_s, limit=self._s.lost_s))
            self._refused, self._since = 0, _NEVER_S
            return True
        return False


class StepWatch:
    """Do all points step together, and stay there, while the inertial sensor felt nothing?

    Judged is how far a frame is off the straight line through the two before it, less what the sensor felt of that. A
    step shows twice, the second time the other way round; a single frame that errs shows three times, twice as large in
    the middle.
    """

    def __init__(self, body: BodyModel, alarms: Alarms) -> None:
        self._where, self._alarms = body.name, alarms
        self._past: list[tuple[float, Array, float]] = []
        self._pending = np.zeros(0)

    def frame(self, t_s: float, beyond_mm: Array, sigma_mm: float) -> None:
        """One frame: points (n, 3) less what the sensor's own way from rest has them go, NaN where not seen, and their
        noise, the expected distance in space."""
        if self._past and not (0.0 < t_s - self._past[-1][0] <= _LINE_S):
            self._past, self._pending = [], np.zeros(0)
        self._past = [*self._past[-2:], (t_s, beyond_mm, sigma_mm)]
        if len(self._past) < 3:
            return
        (t0, a, _), (t1, b, _), _ = self._past
        share = (t_s - t1) / (t1 - t0)
        off = beyond_mm - b - share * (b - a)
        off = off[np.isfinite(off).all(axis=1)]
        if len(off) == 0:
            return
        felt = _FELT_MM_S2 * (t_s - t1) * (t_s - t0)
        noise = 4.0 * sigma_mm * float(np.sqrt(1.0 + (1.0 + share) ** 2 + share**2))
        self._judge(off, share, noise + felt, noise / float(np.sqrt(len(off))) + felt)

    def _judge(self, off: Array, share: float, one_mm: float, limit_mm: float) -> None:
        """`one_mm` is what one point's noise explains, `limit_mm` that of the mean of all."""
        shift = off.mean(axis=0)
        size = float(np.linalg.norm(shift))
        pending, self._pending = self._pending, np.zeros(0)
        if len(pending):
            before = float(np.linalg.norm(pending))
            if float(np.linalg.norm(shift + share * pending)) <= 0.3 * before + 0.5 * limit_mm:
                self._alarms.raise_(ReferenceShifted(self._where, value=before, limit=limit_mm))
            return
        self._alarms.gone(ReferenceShifted, self._where)
        spread = float(np.linalg.norm(off - shift, axis=1).max())
        if size > limit_mm and spread <= 0.2 * size + one_mm:
            self._pending = shift
