"""What the filters that follow every point by itself have in common: times, attitude, the body made of the points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from docking.errors import AttitudeUnknown, BadArgument, DockingError, TooFewPoints
from docking.geometry import log_so3
from docking.tracking.axis_filters import Mask
from docking.tracking.body import BodyPose, body_pose, described, points_from_pose
from docking.tracking.faults import Alarms, FrameWatch, InertialWatch, StepWatch, WatchSettings, swapped
from docking.tracking.strapdown import G_W_MM_S2, Integral, Strapdown
from docking.tracking.types import BodyModel, InertialModel, Start, TrackedState
from docking.tracking.zero_velocity import RestDetector, ZeroVelocity
from docking.types import Array, Pose

FOR_A_POSE = 3
ATTITUDE_GAIN = 0.05
"""Share of the attitude that the seen points show which is taken over with every frame; the gyroscope does the rest."""
SURE_REST_S = 1.0
"""Quiet for so long is rest; an even slow turn may be as quiet for a moment and would be taken for bias."""
SHOWN_HEADING_RAD, SHOWN_TILT_RAD = 0.003, 0.0003
"""How well three seen points and more show the heading, and the part of the tilt that no bias state follows: what the
study of tracking shows for eight points of 1 mm."""
REST_WINDOW_S = 0.25
"""Over which the rate at rest is averaged."""
SWAP_GATE = 30.0
"""Squared distance in sigmas within which a point that was taken for another lies at that one's place."""
UNFELT_MM_S2 = 5000.0
"""What the body may do unnoticed, 1 sigma with a tenth of a second of memory."""
LEVEL_S, REST_LEVEL_GAIN = 300.0, 0.2
"""Where too few points show the attitude: time in which the mean specific force levels it, and the share of the tilt
that one window of rest takes away."""


@dataclass(frozen=True)
class Frame:
    """A frame in the body's order: `xyz_mm` (n, 3) and `var_mm2` (n, 3) of every axis, meaningful where `seen` (n,)."""

    t_s: float
    xyz_mm: Array
    var_mm2: Array
    seen: Mask


class PointwiseTracker:
    """Base of the decoupled and coupled forms: subclasses say what begins, what a frame does and where the points are.

    Frames must come in order; one that is older than the newest used is dropped and counted.
    """

    method = ""

    def __init__(self, body: BodyModel, model: InertialModel, start: Start | None = None) -> None:
        self.body, self._model, self._start = body, model, start
        self._index = {name: i for i, name in enumerate(body.names)}
        self._alarms = Alarms()
        self._watch = InertialWatch(model, WatchSettings(), self._alarms, f"{body.name} inertial sensor")
        self._frames_watch = FrameWatch(body, WatchSettings(), self._alarms)
        self._step_watch = StepWatch(body, self._alarms)
        self._strapdown: Strapdown | None = None
        self._levelled: Integral | None = None
        self._rest, self._quiet_s, self._resting = RestDetector(ZeroVelocity(), model), float("inf"), False
        self._waiting: list[Frame] = []
        self._frame_s = float("nan")
        self._used_s = float("nan")
        self._seen = np.zeros(len(body.names), dtype=bool)
        self._lost: list[Integral | None] = [None] * len(body.names)
        self._rate_known_s = float("nan")
        self.dropped = 0
        if start is not None:
            self._strapdown = Strapdown(start.R_WB @ body.X_BI.R)

    # what subclasses do ----------------------------------------------------------------------------------------------
    def _begin(self, frame: Frame, ins: Integral) -> None:
        raise NotImplementedError

    def _step(self, frame: Frame, ins: Integral) -> None:
        raise NotImplementedError

    def _points_at(self, t_s: float, ins: Integral) -> tuple[Array, Array, Array]:
        """Points (n, 3), their covariances (n, 3, 3) and the mean velocity (3,) at `t_s`."""
        raise NotImplementedError

    def _unmodelled_mm2(self, lost: Integral, ins: Integral) -> Array:
        """(3,) variances in W of what the model leaves out, for a point last seen at `lost`: tilt above all."""
        return np.zeros(3)

    # what arrives ----------------------------------------------------------------------------------------------------
    def imu(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """One sample; see `Tracker.imu`. One that is not believed leaves a hole that the next interval bridges."""
        good = self._watch.good(t_s, force_m_s2, rate_rad_s)
        if self._strapdown is None or not good or t_s <= self._strapdown.t_s:
            return
        self._strapdown.sample(t_s, force_m_s2, rate_rad_s)
        while self._waiting and self._waiting[0].t_s <= t_s:
            self._take(self._waiting.pop(0))
        quiet = self._rest.sample(t_s, force_m_s2, rate_rad_s)
        self._resting = self._resting if quiet is None else quiet
        if quiet is False or self._quiet_s > t_s:
            self._quiet_s = t_s
        if quiet and t_s - self._quiet_s >= SURE_REST_S:
            self._strapdown.rate_bias = self._rest.rate_rad_s
            self._rate_known_s = t_s
            self._upright(self._strapdown.C_WI @ self._rest.force_m_s2, REST_LEVEL_GAIN)

    def _upright(self, force_W: Array, gain: float) -> None:
        """Turn the attitude so that a share `gain` of the angle between the specific force and the vertical goes."""
        assert self._strapdown is not None
        x, y, z = force_W.tolist()
        self._strapdown.correct(np.array([gain * y / z, -gain * x / z, 0.0]))

    def points(self, t_s: float, names: tuple[str, ...], xyz_W_mm: Array, cov_mm2: Array) -> None:
        """One frame; see `Tracker.points`."""
        frame = self._framed(t_s, names, xyz_W_mm, cov_mm2)
        if self._strapdown is None:
            self._strapdown = Strapdown(self._first_attitude(frame) @ self.body.X_BI.R)
        if t_s > self._strapdown.t_s:
            self._waiting.append(frame)
        else:
            self._take(frame)

    def _take(self, frame: Frame) -> None:
        """A frame at its turn: the samples have passed it, or are not waited for."""
        assert self._strapdown is not None
        t_s, ins = frame.t_s, self._strapdown.at(frame.t_s)
        self._watch.silent(t_s)
        if ins is None or (t_s <= self._frame_s):
            self.dropped += 1
            return
        if np.isnan(self._frame_s):
            if not frame.seen.any():
                return
            self._begin(frame, ins)
        else:
            frame = self._believed(frame, ins)
            self._step(frame, ins)
        self._lost = [ins if seen else old for seen, old in zip(frame.seen.tolist(), self._lost, strict=True)]
        self._frame_s, self._seen = t_s, frame.seen
        if frame.seen.any():
            self._used_s = t_s
        self._level(frame)

    def _believed(self, frame: Frame, ins: Integral) -> Frame:
        """The frame without what is not believed: all of one that a camera repeats, points seen in each other's place.
        A step of all points is told, but taken: the equations have no gate."""
        if self._frames_watch.frozen(frame.xyz_mm[frame.seen], self._resting):
            frame = replace(frame, seen=np.zeros_like(frame.seen))
        if len(frame.seen) > 1:
            frame = self._without_swapped(frame, ins)
        if frame.seen.any():
            way = np.where(frame.seen[:, None], frame.xyz_mm - ins.s_mm - self._arms_W(ins.C_WI), np.nan)
            noise = float(np.sqrt(frame.var_mm2[frame.seen].sum(axis=1).mean()))
            self._step_watch.frame(frame.t_s, way, noise)
        return frame

    def _without_swapped(self, frame: Frame, ins: Integral) -> Frame:
        expected, cov, _ = self._points_at(frame.t_s, ins)
        if int(self._seen.sum()) >= FOR_A_POSE:  # one that is left out for long is where the others have the body
            pose = body_pose(self.body, expected, cov, rows=np.flatnonzero(self._seen))
            expected, cov = points_from_pose(self.body, pose)
        rows = np.flatnonzero(frame.seen)
        wide = np.trace(cov, axis1=1, axis2=2)[rows] + frame.var_mm2[rows].sum(axis=1)
        near_mm = float(np.sqrt(SWAP_GATE * wide.max(initial=0.0) / 3.0))
        pairs = swapped(expected[rows], frame.xyz_mm[rows], near_mm)
        self._frames_watch.tell_swapped(tuple(self.body.names[i] for i in rows), pairs)
        seen = frame.seen.copy()
        seen[rows[[i for pair in pairs for i in pair]]] = False
        return replace(frame, seen=seen)

    def encoders(self, t_s: float, X_WB: Pose) -> None:
        """Not used by this method."""

    def alarms(self) -> list[DockingError]:
        """See `Tracker.alarms`."""
        return self._alarms.taken()

    def _framed(self, t_s: float, names: tuple[str, ...], xyz: Array, cov: Array) -> Frame:
        n = len(self.body.names)
        points, var, seen = np.zeros((n, 3)), np.ones((n, 3)), np.zeros(n, dtype=bool)
        for k, name in enumerate(names):
            if name not in self._index:
                raise BadArgument(self.body.name, "no such point", value=name)
            i = self._index[name]
            points[i], var[i], seen[i] = xyz[k], np.diag(cov[k]), True
        return Frame(t_s, points, var, seen)

    def _first_attitude(self, frame: Frame) -> Array:
        if int(frame.seen.sum()) < FOR_A_POSE:
            raise AttitudeUnknown(self.body.name, f"the first frame has {int(frame.seen.sum())} points")
        return self._fit(frame).X_WB.R

    def _fit(self, frame: Frame) -> BodyPose:
        cov = frame.var_mm2[:, :, None] * np.eye(3)
        return body_pose(self.body, frame.xyz_mm, cov, rows=np.flatnonzero(frame.seen))

    def _level(self, frame: Frame) -> None:
        """Three seen points show the attitude, else the specific force in the long run: a part of it is taken over."""
        assert self._strapdown is not None
        now, before = self._strapdown.at(frame.t_s), self._levelled
        self._levelled = now
        if int(frame.seen.sum()) >= FOR_A_POSE:
            C = self._fit(frame).X_WB.R @ self.body.X_BI.R
            self._strapdown.correct(ATTITUDE_GAIN * log_so3(C @ self._strapdown.C_WI.T))
        elif before is not None and now is not None:
            dt = now.t_s - before.t_s
            self._upright(now.v_mm_s - before.v_mm_s - G_W_MM_S2 * dt, dt / LEVEL_S)

    def _arms_W(self, C_WI: Array) -> Array:
        """Vectors (n, 3) in W from the inertial sensor to the points."""
        result: Array = (self.body.points_B_mm - self.body.X_BI.t_mm) @ (C_WI @ self.body.X_BI.R.T).T
        return result

    def _start_points(self, frame: Frame) -> Array:
        """All points (n, 3) at the first frame; those not seen by the pose of the others."""
        if frame.seen.all():
            return frame.xyz_mm
        if int(frame.seen.sum()) < FOR_A_POSE:
            raise TooFewPoints(self.body.name, value=int(frame.seen.sum()), limit=FOR_A_POSE)
        return np.where(frame.seen[:, None], frame.xyz_mm, self._fit(frame).X_WB.apply(self.body.points_B_mm))

    # what is asked ---------------------------------------------------------------------------------------------------
    def state(self, t_s: float | None = None) -> TrackedState | None:
        """See `Tracker.state`."""
        while self._waiting:
            self._take(self._waiting.pop(0))
        if np.isnan(self._frame_s):
            return None
        assert self._strapdown is not None
        t = max(self._frame_s, self._strapdown.t_s) if t_s is None else t_s
        ins = self._strapdown.at(t)
        assert ins is not None
        points, cov, velocity = self._points_at(t, ins)
        return self._described(t, points, cov, velocity, ins)

    def _rate_sd(self, t_s: float) -> float:
        """How well the rate bias is known, rad/s: as the data sheet says, or from the last rest."""
        m = self._model
        if np.isnan(self._rate_known_s):
            return m.rate_bias
        aged = m.rate_density**2 / REST_WINDOW_S + m.rate_walk**2 * max(t_s - self._rate_known_s, 0.0)
        return min(m.rate_bias, float(np.sqrt(aged)))

    def _heading_sd(self) -> float:
        """What no inertial sensor mends, rad: the stated one where too few points show it."""
        few = len(self.body.names) < FOR_A_POSE and self._start is not None
        return self._start.heading_sd_rad if few and self._start is not None else SHOWN_HEADING_RAD

    def _left_out(self, ins: Integral) -> Array:
        """Variances (n, 3) of what the model leaves out: only for points that are hidden."""
        hidden = [None if seen else lost for seen, lost in zip(self._seen.tolist(), self._lost, strict=True)]
        unfelt = self._unfelt_mm2(ins.t_s)
        return np.array([np.zeros(3) if lost is None else self._unmodelled_mm2(lost, ins) + unfelt for lost in hidden])

    def _unfelt_mm2(self, t_s: float) -> float:
        """Variance a coordinate of what the body may have done since the last sample, where the sensor is silent."""
        assert self._strapdown is not None
        if not self._watch.silent(t_s):
            return 0.0
        return UNFELT_MM_S2**2 * 0.1 * (t_s - self._strapdown.t_s) ** 3 / 3.0

    def _described(self, t_s: float, points: Array, cov: Array, velocity: Array, ins: Integral) -> TrackedState:
        body, R_WB, more = self.body, ins.C_WI @ self.body.X_BI.R.T, self._left_out(ins)
        if len(points) >= FOR_A_POSE:
            pose = body_pose(body, points, cov)
        else:
            arms = body.points_B_mm @ R_WB.T
            pose = described(*_shifted(R_WB, points - arms, body.com_B_mm, cov))
        cov = cov + more[:, :, None] * np.eye(3)
        six = pose.cov.copy()
        six[3:, 3:] += np.diag(more.min(axis=0))  # common to all points: it does not go down with their number
        worst = float(np.sqrt(np.trace(cov, axis1=1, axis2=2).max()))
        source = "image" if self._seen.any() else "inertial"
        return TrackedState(
            t_s, pose.X_WB, velocity, six, pose.com_W_mm, points, cov, self._seen, pose.attitude_rad,
            pose.attitude_sd_rad, t_s - self._used_s, source, worst,
        )  # fmt: skip


def _shifted(R_WB: Array, origins_mm: Array, com_B_mm: Array, cov_mm2: Array) -> tuple[Pose, Array, Array]:
    """Pose, centre of mass and covariance where too few points give a turn: NaN there."""
    X = Pose(R_WB, origins_mm.mean(axis=0))
    cov = np.full((6, 6), np.nan)
    cov[3:, 3:] = cov_mm2.mean(axis=0) / len(cov_mm2)
    return X, X.apply(com_B_mm), cov
