"""Gaps bridged by the positioners' encoders: the body's pose by the read-backs, corrected by what the image showed.

What the image shows beyond the read-backs, for a point at `r` from the middle of the points that has gone the way `d`:

    p_image - p_encoders = o + phi x r + diag(s) d + (K d) x r

`o` and `phi` are where the part sits otherwise than the read-backs say, `s` the scale errors of the ways, and `K` the
turn a way that follows from scales that differ between the positioners. All points share these eighteen states, since
they are those of one rigid body: the errors of its points are as correlated as the predicted ones. Offsets and scales
walk slowly: settling, temperature, compliance under changing load.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument, DockingError
from docking.geometry import skew
from docking.tracking.axis_filters import Mask
from docking.tracking.body import body_pose, described
from docking.tracking.encoder_watch import EncoderWatch
from docking.tracking.faults import Alarms, WatchSettings
from docking.tracking.pointwise import FOR_A_POSE
from docking.tracking.types import BodyModel, TrackedState
from docking.types import Array, Pose

_OFFSET, _TURN, _SCALE, _TURN_A_WAY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 18)
_STATES = 18


@dataclass(frozen=True)
class EncoderSettings:
    """Noise of a read-back (mm) and the time over which a line is laid through them; sd of offset and scale at the
    start, and their walks a sqrt(s). `unlike`: by what share of `scale_sd` the scales of the positioners differ from
    each other, which turns the body on its way: pitch errors and temperature of like drives are mostly common.
    `blind_mm_s`: how fast the body may be while no read-back tells. `watch` None: who pushes frames in has judged them.
    """

    noise_mm: float = 0.02
    offset_sd_mm: float = 10.0
    scale_sd: float = 0.001
    unlike: float = 0.2
    offset_walk_mm: float = 0.001
    scale_walk: float = 1e-6
    history_s: float = 2.0
    smooth_s: float = 0.1
    blind_mm_s: float = 20.0
    watch: WatchSettings | None = field(default_factory=WatchSettings)


class _Here(NamedTuple):
    """The body by the read-backs: points (n, 3), the rotation (3, 3), and variance (mm^2) that all points share."""

    points: Array
    R: Array
    common_mm2: float


class EncoderTracker:
    """Follows one body by encoders and image; see `docking.tracking.types.Tracker`."""

    method = "encoders"

    def __init__(self, body: BodyModel, settings: EncoderSettings | None = None) -> None:
        self.body, self._s = body, settings or EncoderSettings()
        self._index = {name: i for i, name in enumerate(body.names)}
        s = self._s
        off = body.points_B_mm - body.points_B_mm.mean(axis=0)
        size_mm = max(float(np.sqrt(np.mean(np.sum(off * off, axis=1)))), 1.0)
        sd = np.repeat([s.offset_sd_mm, s.offset_sd_mm / size_mm, s.scale_sd], 3)
        differing = s.unlike / size_mm
        self._p = self._begun = np.diag(np.concatenate([sd, np.full(9, differing * s.scale_sd)]) ** 2)
        walk = np.repeat([s.offset_walk_mm, s.offset_walk_mm / size_mm, s.scale_walk], 3)
        self._walk = np.concatenate([walk, np.full(9, differing * s.scale_walk)]) ** 2
        self._x = np.zeros(_STATES)
        self._times: list[float] = []
        self._poses: list[Pose] = []
        self._places: list[Array] = []
        self._origin: Array | None = None
        self._thawed_s = float("-inf")
        self._frame_s = float("nan")
        self._used_s = float("nan")
        self._seen = np.zeros(len(body.names), dtype=bool)
        self._alarms = Alarms()
        self._watch = EncoderWatch(body, s.watch, self._alarms) if s.watch is not None else None
        self.dropped = 0

    def imu(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """Not used by this method."""

    def encoders(self, t_s: float, X_WB: Pose) -> None:
        """One read-back; see `Tracker.encoders`."""
        place = X_WB.apply(self.body.points_B_mm)
        if self._watch is not None and self._watch.thawed(t_s, place):
            # While they stood still the body was followed by the image, as if it sat elsewhere.
            self._p, self._thawed_s = self._p + self._begun, t_s
        if self._times and not (t_s > self._times[-1]):
            self.dropped += 1
            return
        self._times.append(t_s)
        self._poses.append(X_WB)
        self._places.append(place)
        if len(self._times) > 512 and self._times[256] < t_s - self._s.history_s:
            del self._times[:256], self._poses[:256], self._places[:256]

    def _by_encoders(self, t_s: float) -> _Here | None:
        """The body at `t_s`, on a line through the read-backs of the last `smooth_s`."""
        last = bisect_right(self._times, t_s)
        if last == 0:
            return None
        first = bisect_right(self._times, t_s - self._s.smooth_s, 0, last)
        if self._thawed_s <= t_s:  # no line through read-backs from before they stood still
            first = max(first, bisect_left(self._times, self._thawed_s))
        first = min(first, last - 1)
        t = np.array(self._times[first:last])
        off, n = t - t.mean(), len(t)
        weights = np.full(n, 1.0 / n)
        if n > 2:
            weights += (t_s - t.mean()) / float(off @ off) * off
        elif n == 2:
            weights = np.array([0.0, 1.0])
        points = np.tensordot(weights, np.array(self._places[first:last]), 1)
        late_s = max(t_s - self._times[-1] - self._s.smooth_s, 0.0)
        common = float(weights @ weights) * self._s.noise_mm**2 + (self._s.blind_mm_s * late_s) ** 2
        return _Here(points, self._poses[last - 1].R, common)

    def _slopes(self, points: Array, about: Array) -> Array:
        """d(points) / d(states), (k, 3, 18), for points of the body whose middle is at `about`."""
        assert self._origin is not None
        way, k = about - self._origin, len(points)
        H = np.zeros((k, 3, _STATES))
        H[:, :, _OFFSET], H[:, :, _SCALE] = np.eye(3), np.diag(way)
        H[:, :, _TURN] = -skew(points - about)
        H[:, :, _TURN_A_WAY] = (H[:, :, _TURN, None] * way).reshape(k, 3, 9)
        return H

    def points(self, t_s: float, names: tuple[str, ...], xyz_W_mm: Array, cov_mm2: Array) -> None:
        """One frame; see `Tracker.points`. One before the first read-back or out of order is dropped and counted."""
        rows = self._rows(names)
        here = self._by_encoders(t_s)
        if here is None or t_s <= self._frame_s:
            self.dropped += 1
            return
        about = here.points.mean(axis=0)
        if self._watch is not None:
            self._watch.silent(t_s)
        if self._origin is None:
            self._origin = about
        if not np.isnan(self._frame_s):
            self._p = self._ahead(t_s)
        self._frame_s = t_s
        good = self._believed(t_s, rows, (xyz_W_mm, cov_mm2), here)
        rows, xyz_W_mm, cov_mm2 = rows[good], xyz_W_mm[good], cov_mm2[good]
        self._seen = np.zeros(len(self.body.names), dtype=bool)
        self._seen[rows] = True
        if len(rows):
            H = self._slopes(here.points[rows], about).reshape(-1, _STATES)
            # what all points share weighs as many times as there are points
            var = np.diagonal(cov_mm2, axis1=1, axis2=2).ravel() + len(rows) * here.common_mm2
            self._update(H, (xyz_W_mm - here.points[rows]).ravel(), var)
            self._used_s = t_s

    def _rows(self, names: tuple[str, ...]) -> NDArray[np.intp]:
        for name in names:
            if name not in self._index:
                raise BadArgument(self.body.name, "no such point", value=name)
        return np.array([self._index[name] for name in names], dtype=np.intp)

    def _believed(self, t_s: float, rows: NDArray[np.intp], seen: tuple[Array, Array], here: _Here) -> Mask:
        """Which points (k, 3) with covariances (k, 3, 3) are taken in; begins anew where none has been for long."""
        xyz, noise = seen
        about = here.points.mean(axis=0)
        if self._watch is None or len(rows) == 0:
            return np.ones(len(rows), dtype=bool)
        if self._watch.repeated(xyz, about):
            return np.zeros(len(rows), dtype=bool)
        beyond = xyz - here.points[rows]
        sd_mm = float(np.sqrt(np.trace(noise, axis1=1, axis2=2).max()))
        self._watch.compare(beyond, sd_mm)
        H = self._slopes(here.points[rows], about)
        cov = H @ self._p @ H.transpose(0, 2, 1) + noise + here.common_mm2 * np.eye(3)
        residual = beyond - H @ self._x
        good = self._watch.agreeing(rows, xyz, residual, cov)
        if not good.any() and self._watch.refused(t_s, residual, sd_mm):
            # Nothing is believed any more of where the part sits; this frame says it anew.
            shift = beyond.mean(axis=0)
            self._x, self._p = np.zeros(_STATES), self._begun.copy()
            self._x[_OFFSET] = shift
            self._origin = about
            return np.ones(len(rows), dtype=bool)
        return good

    def _ahead(self, t_s: float) -> Array:
        """Covariance of the states at `t_s`; where the read-backs do not tell, the body may have gone anywhere."""
        p = self._p + np.diag(self._walk * max(t_s - self._frame_s, 0.0))
        if self._watch is not None and self._watch.frozen:
            used_s = self._frame_s if np.isnan(self._used_s) else self._used_s
            before_s, now_s = self._frame_s - used_s, max(t_s, self._frame_s) - used_s
            p[_OFFSET, _OFFSET] += self._s.blind_mm_s**2 * (now_s**2 - before_s**2) * np.eye(3)
        return p

    def _update(self, H: Array, shown_mm: Array, var: Array) -> None:
        """Kalman update by the information of the whole frame: P = (P^-1 + H^T R^-1 H)^-1."""
        weighed = H.T / var
        p = np.linalg.solve(np.eye(_STATES) + self._p @ weighed @ H, self._p)
        self._p = 0.5 * (p + p.T)
        self._x = self._x + self._p @ (weighed @ (shown_mm - H @ self._x))

    def alarms(self) -> list[DockingError]:
        """See `Tracker.alarms`."""
        return self._alarms.taken()

    def state(self, t_s: float | None = None) -> TrackedState | None:
        """See `Tracker.state`."""
        if self._origin is None or np.isnan(self._used_s):
            return None
        t = max(self._times[-1], self._frame_s) if t_s is None else t_s
        here = self._by_encoders(t)
        assert here is not None
        about = here.points.mean(axis=0)
        H = self._slopes(here.points, about)
        ahead = self._ahead(t)
        common = here.common_mm2 * np.eye(3)
        cov = H @ ahead @ H.transpose(0, 2, 1) + common
        points = here.points + H @ self._x
        if len(points) >= FOR_A_POSE:
            fitted = body_pose(self.body, points, np.tile(np.eye(3), (len(points), 1, 1)))
            points, X = fitted.X_WB.apply(self.body.points_B_mm), fitted.X_WB
        else:
            X = Pose(here.R, (points - self.body.points_B_mm @ here.R.T).mean(axis=0))
        return self._described(t, X, points, cov, self._body_cov(X, about, ahead, common))

    def _body_cov(self, X: Pose, about: Array, p: Array, common: Array) -> Array:
        """(6, 6) of turn and place of the centre of mass; NaN in the turn where fewer than three points show it."""
        com = X.apply(self.body.com_B_mm)[None]
        jac = np.concatenate([np.zeros((3, _STATES)), self._slopes(com, about)[0]])
        way = about - self._origin if self._origin is not None else np.zeros(3)
        jac[:3, _TURN] = np.eye(3)
        jac[:3, _TURN_A_WAY] = (np.eye(3)[:, :, None] * way).reshape(3, 9)
        six = jac @ p @ jac.T
        six[3:, 3:] += common
        if len(self.body.names) < FOR_A_POSE:
            six[:3], six[:, :3] = np.nan, np.nan
        return np.asarray(six)

    def _described(self, t_s: float, X: Pose, points: Array, cov: Array, six: Array) -> TrackedState:
        pose = described(X, X.apply(self.body.com_B_mm), six)
        source = "image" if self._seen.any() else "encoders"
        worst = float(np.sqrt(np.trace(cov, axis1=1, axis2=2).max()))
        return TrackedState(
            t_s, pose.X_WB, np.full(3, np.nan), pose.cov, pose.com_W_mm, points, cov, self._seen, pose.attitude_rad,
            pose.attitude_sd_rad, t_s - self._used_s, source, worst,
        )  # fmt: skip
