"""Faults of the sources, told from what they say: each is named, raised once, and again after it has gone.

`InertialWatch` looks at the samples (frozen, saturated, jumping clock), `FrameWatch` at the seen points against the
estimate (swapped, moved tracker, frozen camera, no agreement).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


class InertialWatch:
    """Says of every sample whether it may be integrated."""

    def __init__(self, model: InertialModel, settings: WatchSettings, alarms: Alarms, where: str) -> None:
        self._model, self._s, self._alarms, self._where = model, settings, alarms, where
        self._last: tuple[float, list[float], list[float]] | None = None
        self._usual_s, self._same = 0.0, 0
        self._force_limit = settings.near_range * model.force_range
        self._rate_limit = settings.near_range * model.rate_range

    def good(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> bool:
        """False for a sample that is frozen, saturated or behind a jump of its clock."""
        force, rate = force_m_s2.tolist(), rate_rad_s.tolist()
        last, self._last = self._last, (t_s, force, rate)
        ok = self._in_range(force, rate)
        if last is None:
            return ok
        moving = self._moving(force == last[1] and rate == last[2])
        return self._in_time(t_s - last[0]) and moving and ok

    def _moving(self, same: bool) -> bool:
        self._same = self._same + 1 if same else 0
        if self._same < self._s.same_samples:
            if not same:
                self._alarms.gone(SensorFrozen, self._where)
            return True
        self._alarms.raise_(SensorFrozen(self._where, value=self._same, limit=self._s.same_samples))
        return False

    def _in_time(self, step_s: float) -> bool:
        limit = self._s.jump_s + 2.0 * self._usual_s
        if not (0.0 < step_s <= limit):
            self._alarms.raise_(TimeJumped(self._where, value=step_s, limit=limit))
            return False
        self._usual_s = step_s if self._usual_s == 0.0 else 0.99 * self._usual_s + 0.01 * step_s
        self._alarms.gone(TimeJumped, self._where)
        return True

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

    def frozen(self, xyz_mm: Array, resting: bool) -> bool:
        """Whether the camera repeats itself although the body moves."""
        same = xyz_mm.shape == self._before.shape and bool(np.all(xyz_mm == self._before)) and xyz_mm.size > 0
        self._before = xyz_mm
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

    def refused(self, t_s: float, residuals_mm: Array, good: NDArray[np.bool_], sd_mm: float) -> bool:
        """Count a frame of which nothing was used; True when tracking has to begin anew."""
        self._refused += 1
        self._since = min(self._since, t_s)
        shift = residuals_mm.mean(axis=0)
        size = float(np.linalg.norm(shift))
        spread = float(np.sqrt(np.mean(np.sum((residuals_mm - shift) ** 2, axis=1))))
        together = spread <= 0.2 * size + 3.0 * sd_mm
        if self._refused >= self._s.shift_frames and together and not good.any():
            limit = 5.0 * sd_mm
            self._alarms.raise_(ReferenceShifted(self._body.name, value=size, limit=limit))
        blind_s = t_s - self._since
        if blind_s >= self._s.lost_s:
            self._alarms.raise_(TrackingLost(self._body.name, value=blind_s, limit=self._s.lost_s))
            self._refused, self._since = 0, _NEVER_S
            return True
        return False
