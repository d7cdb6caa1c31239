"""[Zhao] as printed, with its formulas put right: the decoupled pair a point and axis, and the coupled 9 + 6 form.

The inertial channel is started once, from rest, and never again: its time t counts from there. What the printed models
leave out (velocity at the start, tilt, gyroscope bias) is left out here too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.tracking.axis_filters import BiasFilters, ThreeStateFilters, polynomial_noise, transition
from docking.tracking.pointwise import Frame, PointwiseTracker
from docking.tracking.strapdown import Integral
from docking.tracking.types import MM_PER_M, BodyModel, InertialModel, Start
from docking.types import Array


@dataclass(frozen=True)
class PublishedSettings:
    """`motion_density` Phi_s in mm^2/s^5; `velocity_sd_mm_s`, `acceleration_sd_mm_s2` of filter 2 at its start."""

    motion_density: float = 2.5e7
    velocity_sd_mm_s: float = 500.0
    acceleration_sd_mm_s2: float = 2000.0


class _PrintedTracker(PointwiseTracker):
    """What both printed forms share: the settings of their motion model."""

    def __init__(
        self,
        body: BodyModel,
        model: InertialModel,
        start: Start | None = None,
        settings: PublishedSettings | None = None,
    ) -> None:
        super().__init__(body, model, start)
        self._s = settings or PublishedSettings()


class PublishedTracker(_PrintedTracker):
    """Decoupled: filter 1 (bias, order 0) and filter 2 (position, order 2) for every point and axis."""

    method = "published"

    def _begin(self, frame: Frame, ins: Integral) -> None:
        s = self._s
        self._origin, self._begun = ins, self._start_points(frame)
        self._origin_arms = self._arms_W(ins.C_WI)
        self._dropped_s = np.full(len(self._begun), np.nan)
        x = np.zeros((3, self._begun.size))
        x[0] = self._begun.ravel()
        cov = np.diag([float(frame.var_mm2.max()), s.velocity_sd_mm_s**2, s.acceleration_sd_mm_s2**2])
        self._position = ThreeStateFilters(x, cov, lambda dt: polynomial_noise(dt, s.motion_density))
        walk = (self._model.force_walk * MM_PER_M) ** 2
        self._bias = BiasFilters(x.shape[1], (self._model.force_bias * MM_PER_M) ** 2, walk)

    def _ins_points(self, ins: Integral) -> Array:
        """Z_INS (n, 3): from rest at the start."""
        a = self._origin
        way = ins.s_mm - a.s_mm - a.v_mm_s * (ins.t_s - a.t_s)
        result: Array = self._begun + way + self._arms_W(ins.C_WI) - self._origin_arms
        return result

    def _step(self, frame: Frame, ins: Integral) -> None:
        dt, since = frame.t_s - self._frame_s, frame.t_s - self._origin.t_s
        seen = np.repeat(frame.seen, 3)
        z, var = frame.xyz_mm.ravel(), frame.var_mm2.ravel()
        z_ins = self._ins_points(ins).ravel()
        self._bias.step(dt, since, z_ins - z, var, seen)
        self._position.predict(dt)
        self._dropped_s = np.where(frame.seen, np.nan, np.where(self._seen, self._frame_s, self._dropped_s))
        z_ins, var_ins = self._bridged(z_ins, frame.t_s)
        self._position.update(np.where(seen, z, z_ins), np.where(seen, var, var_ins))

    def _bridged(self, z_ins: Array, t_s: float) -> tuple[Array, Array]:
        """INS model while occluded: x = Z_INS - b t^2/2 with (t^2/2)^2 P_b and the white noise since the drop-out."""
        half = 0.5 * (t_s - self._origin.t_s) ** 2
        lost = np.repeat(t_s - np.where(np.isnan(self._dropped_s), t_s, self._dropped_s), 3)
        white = (self._model.force_density * MM_PER_M) ** 2 * lost**3 / 3.0
        return z_ins - half * self._bias.b, half * half * self._bias.p + white + 1e-6

    def _unmodelled_mm2(self, lost: Integral, ins: Integral) -> Array:
        """Tilt that grows at the rate bias makes g w t^3 / 6, of which a constant bias explains what was there when the
        point was lost: the rest is g w t^2 (t - t_lost) / 6, t since the inertial channel began. Told, not used: the
        printed equations know nothing of it."""
        t, lost_s = ins.t_s - self._origin.t_s, ins.t_s - lost.t_s
        tilt = 9806.65 * self._rate_sd(ins.t_s) * t * t * lost_s / 6.0
        return np.array([tilt, tilt, 0.0]) ** 2

    def _points_at(self, t_s: float, ins: Integral) -> tuple[Array, Array, Array]:
        ahead = self._position.copy()
        dt = t_s - self._frame_s
        if dt > 0.0:
            ahead.predict(dt)
            if not self._seen.all():
                z, var = self._bridged(self._ins_points(ins).ravel(), t_s)
                ahead.update(z, var, np.repeat(~self._seen, 3))
        points = ahead.x[0].reshape(-1, 3)
        cov = ahead.p[0].reshape(-1, 3)[:, :, None] * np.eye(3)
        return points, cov, ahead.x[1].reshape(-1, 3).mean(axis=0)


class CoupledTracker(_PrintedTracker):
    """Coupled: six biases of the sensor from the first seen point, nine states (x, v, a by axis) for every point.

    H_A = [dp/db_a, dp/db_g] from the variational equations of the INS channel along its own path:
    Jth' = [0 C], Jv' = [C 0] - [C f]x Jth, Jp' = Jv.
    """

    method = "coupled"

    def _begin(self, frame: Frame, ins: Integral) -> None:
        s, m = self._s, self._model
        self._origin = self._past = ins
        self._theta, self._jv, self._jp = np.zeros((3, 6)), np.zeros((3, 6)), np.zeros((3, 6))
        self._begun, self._origin_arms = self._start_points(frame), self._arms_W(ins.C_WI)
        n = len(self._begun)
        self._x = np.zeros((n, 9))
        self._x[:, :3] = self._begun
        sd = np.repeat([np.sqrt(frame.var_mm2.max()), s.velocity_sd_mm_s, s.acceleration_sd_mm_s2], 3)
        self._p = np.tile(np.diag(sd**2), (n, 1, 1))
        self._b = np.zeros(6)
        self._pb = np.diag(np.repeat([m.force_bias * MM_PER_M, m.rate_bias], 3) ** 2)
        self._walk = np.repeat([(m.force_walk * MM_PER_M) ** 2, m.rate_walk**2], 3)

    def _vary(self, ins: Integral) -> None:
        """Carry the variations on to `ins` with the mean attitude and force of the interval."""
        a = self._past
        assert a is not None
        dt = ins.t_s - a.t_s
        C = 0.5 * (a.C_WI + ins.C_WI)
        force = (ins.v_mm_s - a.v_mm_s) / dt - np.array([0.0, 0.0, -9806.65])
        x, y, z = force.tolist()
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        theta = self._theta + dt * np.hstack([np.zeros((3, 3)), C])
        slope = np.hstack([C, np.zeros((3, 3))]) - cross @ (0.5 * (self._theta + theta))
        self._jp = self._jp + dt * self._jv + (0.5 * dt * dt) * slope
        self._jv = self._jv + dt * slope
        self._theta, self._past = theta, ins

    def _ins_points(self, ins: Integral) -> Array:
        a = self._origin
        way = ins.s_mm - a.s_mm - a.v_mm_s * (ins.t_s - a.t_s)
        result: Array = self._begun + way + self._arms_W(ins.C_WI) - self._origin_arms
        return result

    def _step(self, frame: Frame, ins: Integral) -> None:
        dt = frame.t_s - self._frame_s
        self._vary(ins)
        z_ins = self._ins_points(ins)
        self._pb = self._pb + np.diag(self._walk * dt)
        if frame.seen.any():
            i = int(np.argmax(frame.seen))
            s = self._jp @ self._pb @ self._jp.T + np.diag(frame.var_mm2[i])
            gain = np.linalg.solve(s, self._jp @ self._pb).T
            self._b = self._b + gain @ (z_ins[i] - frame.xyz_mm[i] - self._jp @ self._b)
            self._pb = self._pb - gain @ self._jp @ self._pb
            self._pb = 0.5 * (self._pb + self._pb.T)
        bridged, bridged_cov = self._bridged(z_ins)
        z = np.where(frame.seen[:, None], frame.xyz_mm, bridged)
        cov = np.where(frame.seen[:, None, None], frame.var_mm2[:, :, None] * np.eye(3), bridged_cov)
        self._x, self._p = self._position(dt, z, cov, np.ones(len(z), dtype=bool))

    def _bridged(self, z_ins: Array) -> tuple[Array, Array]:
        """Z_INS - H_A B (n, 3) with H_A P_A H_A^T (3, 3)."""
        return z_ins - self._jp @ self._b, self._jp @ self._pb @ self._jp.T + 1e-6 * np.eye(3)

    def _position(self, dt: float, z: Array, cov: Array, use: Array) -> tuple[Array, Array]:
        """Filter B over `dt` with measurements `z` (n, 3), `cov` (n, 3, 3) or (3, 3), where `use` (n,)."""
        phi = np.kron(transition(dt), np.eye(3))
        x = self._x @ phi.T
        p = phi @ self._p @ phi.T + np.kron(polynomial_noise(dt, self._s.motion_density), np.eye(3))
        gain = p[:, :, :3] @ np.linalg.inv(p[:, :3, :3] + cov)
        gain = gain * use[:, None, None]
        x = x + np.einsum("nij,nj->ni", gain, z - x[:, :3])
        return x, p - gain @ p[:, :3, :]

    def _points_at(self, t_s: float, ins: Integral) -> tuple[Array, Array, Array]:
        x, p = self._x, self._p
        if t_s > self._frame_s:
            z, cov = self._bridged(self._ins_points(ins))
            x, p = self._position(t_s - self._frame_s, z, cov, ~self._seen)
        return x[:, :3], p[:, :3, :3], x[:, 3:6].mean(axis=0)
