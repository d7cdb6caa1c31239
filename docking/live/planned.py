"""Where read-backs and plan have the part at one instant."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from docking.kinematics import Positioners, pose_from_axes
from docking.types import Array, Plan, Pose

KEPT_S = 3.0


class ReadBacks:
    """The newest axis positions (m,) by time, straight lines between them."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._rows: list[Array] = []

    def add(self, t_s: float, q_mm: Array) -> bool:
        """Keep one read-back; False for one that is not newer than the last."""
        if self._times and not (t_s > self._times[-1]):
            return False
        self._times.append(t_s)
        self._rows.append(q_mm)
        if self._times[-1] - self._times[0] > 2.0 * KEPT_S:
            old = bisect_right(self._times, t_s - KEPT_S)
            del self._times[:old], self._rows[:old]
        return True

    @property
    def newest_s(self) -> float:
        """Time of the last one, -inf before the first."""
        return self._times[-1] if self._times else float("-inf")

    def at(self, t_s: float) -> Array:
        """Positions at `t_s`; beyond the ends those there. At least one is needed."""
        i = bisect_right(self._times, t_s)
        if i == 0 or i == len(self._times):
            return self._rows[max(i - 1, 0)]
        share = (t_s - self._times[i - 1]) / (self._times[i] - self._times[i - 1])
        result: Array = self._rows[i - 1] + share * (self._rows[i] - self._rows[i - 1])
        return result


class PlannedPoses:
    """The poses X_WC of a plan by what the read-backs show of its path: the row and the share of the way to the next
    that lie nearest to them. An axis that is off the path by itself hardly moves that place."""

    def __init__(self, plan: Plan, positioners: Positioners) -> None:
        self._q_mm, self._positioners = plan.q_mm, positioners

    def at(self, q_mm: Array) -> Pose:
        """X_WC that the plan has when the axes stand at `q_mm` (m,)."""
        return pose_from_axes(self._positioners, self.nearest(q_mm))

    def nearest(self, q_mm: Array) -> Array:
        """The point (m,) of the planned polyline nearest to `q_mm` (m,)."""
        rows = self._q_mm
        k = int(np.argmin(((rows - q_mm) ** 2).sum(axis=1)))
        best, least = rows[k], float(((rows[k] - q_mm) ** 2).sum())
        for a, b in ((k - 1, k), (k, k + 1)):
            if a < 0 or b >= len(rows):
                continue
            way = rows[b] - rows[a]
            length2 = float(way @ way)
            if length2 == 0.0:
                continue
            point = rows[a] + min(max(float((q_mm - rows[a]) @ way) / length2, 0.0), 1.0) * way
            gap = float(((point - q_mm) ** 2).sum())
            if gap < least:
                best, least = point, gap
        result: Array = best
        return result
