"""Gaps bridged by the positioners' encoders: the body's pose by the read-backs, corrected by what the image showed.

For every point and axis a filter with two states, offset `o` (mm) and scale error `s`: p_image - p_encoders = o + s d,
d the way since the beginning. Both walk slowly: settling, temperature, compliance under changing load.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from docking.errors import BadArgument, DockingError
from docking.tracking.body import body_pose, described, points_from_pose
from docking.tracking.faults import Alarms
from docking.tracking.pointwise import FOR_A_POSE
from docking.tracking.types import BodyModel, TrackedState
from docking.types import Array, Pose


@dataclass(frozen=True)
class EncoderSettings:
    """Noise of a read-back (mm) and the time over which a line is laid through them; sd of offset and scale at the
    start, and their walks a sqrt(s)."""

    noise_mm: float = 0.02
    offset_sd_mm: float = 10.0
    scale_sd: float = 0.001
    offset_walk_mm: float = 0.001
    scale_walk: float = 1e-6
    history_s: float = 2.0
    smooth_s: float = 0.1


class EncoderTracker:
    """Follows one body by encoders and image; see `docking.tracking.types.Tracker`."""

    method = "encoders"

    def __init__(self, body: BodyModel, settings: EncoderSettings | None = None) -> None:
        self.body, self._s = body, settings or EncoderSettings()
        self._index = {name: i for i, name in enumerate(body.names)}
        n = len(body.names)
        s = self._s
        self._x = np.zeros((2, n, 3))
        self._p = np.zeros((3, n, 3))
        self._p[0], self._p[2] = s.offset_sd_mm**2, s.scale_sd**2
        self._times: list[float] = []
        self._poses: list[Pose] = []
        self._places: list[Array] = []
        self._origin: Array | None = None
        self._frame_s = float("nan")
        self._used_s = float("nan")
        self._seen = np.zeros(n, dtype=bool)
        self._alarms = Alarms()
        self.dropped = 0

    def imu(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """Not used by this method."""

    def encoders(self, t_s: float, X_WB: Pose) -> None:
        """One read-back; see `Tracker.encoders`."""
        if self._times and not (t_s > self._times[-1]):
            self.dropped += 1
            return
        self._times.append(t_s)
        self._poses.append(X_WB)
        self._places.append(X_WB.apply(self.body.points_B_mm))
        if len(self._times) > 512 and self._times[256] < t_s - self._s.history_s:
            del self._times[:256], self._poses[:256], self._places[:256]

    def _encoder_points(self, t_s: float) -> tuple[Array, Array, float] | None:
        """Points (n, 3) by the read-backs at `t_s`, on a line through those of the last `smooth_s`; the rotation (3, 3)
        and by how much the line lessens the noise."""
        last = bisect_right(self._times, t_s)
        if last == 0:
            return None
        first = bisect_right(self._times, t_s - self._s.smooth_s, 0, last)
        first = min(first, last - 1)
        t = np.array(self._times[first:last])
        off, n = t - t.mean(), len(t)
        weights = np.full(n, 1.0 / n)
        if n > 2:
            weights += (t_s - t.mean()) / float(off @ off) * off
        elif n == 2:
            weights = np.array([0.0, 1.0])
        points = np.tensordot(weights, np.array(self._places[first:last]), 1)
        return points, self._poses[last - 1].R, float(np.sqrt(weights @ weights))

    def points(self, t_s: float, names: tuple[str, ...], xyz_W_mm: Array, cov_mm2: Array) -> None:
        """One frame; see `Tracker.points`. One before the first read-back or out of order is dropped and counted."""
        found = self._encoder_points(t_s)
        if found is None or t_s <= self._frame_s:
            self.dropped += 1
            return
        here = found[0]
        if self._origin is None:
            self._origin = here
        if not np.isnan(self._frame_s):
            dt = t_s - self._frame_s
            self._p[0] += self._s.offset_walk_mm**2 * dt
            self._p[2] += self._s.scale_walk**2 * dt
        self._frame_s = t_s
        self._seen = np.zeros(len(self.body.names), dtype=bool)
        for k, name in enumerate(names):
            if name not in self._index:
                raise BadArgument(self.body.name, "no such point", value=name)
            self._update(self._index[name], here, xyz_W_mm[k], np.diag(cov_mm2[k]))
            self._used_s = t_s

    def _update(self, i: int, here: Array, seen_mm: Array, var: Array) -> None:
        assert self._origin is not None
        d = (here - self._origin)[i]
        oo, os, ss = self._p[:, i]
        go, gs = oo + d * os, os + d * ss
        total = go + d * gs + var + self._s.noise_mm**2
        residual = seen_mm - here[i] - self._x[0, i] - self._x[1, i] * d
        self._x[0, i] += go / total * residual
        self._x[1, i] += gs / total * residual
        self._p[:, i] = oo - go * go / total, os - go * gs / total, ss - gs * gs / total
        self._seen[i] = True

    def alarms(self) -> list[DockingError]:
        """See `Tracker.alarms`."""
        return self._alarms.taken()

    def state(self, t_s: float | None = None) -> TrackedState | None:
        """See `Tracker.state`."""
        if self._origin is None or np.isnan(self._used_s):
            return None
        t = max(self._times[-1], self._frame_s) if t_s is None else t_s
        found = self._encoder_points(t)
        assert found is not None
        here, R, less = found
        d = here - self._origin
        oo, os, ss = self._p
        points = here + self._x[0] + self._x[1] * d
        var = oo + 2.0 * d * os + d * d * ss + self._s.offset_walk_mm**2 * (t - self._frame_s)
        cov = var[:, :, None] * np.eye(3)
        return self._described(t, points, cov, R, (less * self._s.noise_mm) ** 2)

    def _described(self, t_s: float, points: Array, cov: Array, R: Array, common_mm2: float) -> TrackedState:
        """`common_mm2`: variance that all points share, the noise of the read-backs."""
        if len(points) >= FOR_A_POSE:
            pose = body_pose(self.body, points, cov)
            points, cov = points_from_pose(self.body, pose)  # a rigid body: every point has the others' readings too
        else:
            X = Pose(R, (points - self.body.points_B_mm @ R.T).mean(axis=0))
            six = np.full((6, 6), np.nan)
            six[3:, 3:] = cov.mean(axis=0) / len(cov)
            pose = described(X, X.apply(self.body.com_B_mm), six)
        six = pose.cov.copy()
        six[3:, 3:] += common_mm2 * np.eye(3)
        cov = cov + common_mm2 * np.eye(3)
        source = "image" if self._seen.any() else "encoders"
        worst = float(np.sqrt(np.trace(cov, axis1=1, axis2=2).max()))
        return TrackedState(
            t_s, pose.X_WB, np.full(3, np.nan), six, pose.com_W_mm, points, cov, self._seen, pose.attitude_rad,
            pose.attitude_sd_rad, t_s - self._used_s, source, worst,
        )  # fmt: skip
