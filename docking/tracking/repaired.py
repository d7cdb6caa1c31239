"""The repaired decoupled pair: filter 1 of [Zhao] with the errors of the INS channel as states, fed back at once.

States a point and axis in W: error of the INS position and velocity and the bias, [dp, dv, b]. Printed filter 1 books
an error of the start velocity as bias; here it has a state of its own. The INS channel is corrected after every update,
so that t counts from the last image and errors stay small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.geometry import log_so3
from docking.tracking.axis_filters import ThreeStateFilters, drift_noise
from docking.tracking.pointwise import FOR_A_POSE, SHOWN_TILT_RAD, Frame, PointwiseTracker
from docking.tracking.strapdown import Integral
from docking.tracking.types import GRAVITY_W_MM_S2, MM_PER_M, BodyModel, InertialModel, Start
from docking.types import Array

LAG_S = 2.0
"""By so much the bias state follows a growing tilt late."""


def tilt_growth_mm(rate_sd_rad_s: float, t_s: float) -> float:
    """Horizontal error after `t_s` without image: 0.5 g theta t^2 with the tilt that the bias state has missed, the
    lag, and the mean of what comes in the gap, t / 3."""
    g = float(np.linalg.norm(GRAVITY_W_MM_S2))
    return 0.5 * g * rate_sd_rad_s * (LAG_S + t_s / 3.0) * t_s * t_s


@dataclass(frozen=True)
class RepairedSettings:
    """`drift_s`: the bias in W walks as it turns with the body and stands for the tilt error too, which the rate noise
    and a rate bias over so long let grow."""

    drift_s: float = 0.1
    velocity_sd_mm_s: float = 100.0
    bias_sd_mm_s2: float = 200.0


class RepairedTracker(PointwiseTracker):
    """Decoupled pair with feedback for every point and axis."""

    method = "repaired"

    def __init__(
        self,
        body: BodyModel,
        model: InertialModel,
        start: Start | None = None,
        settings: RepairedSettings | None = None,
    ) -> None:
        super().__init__(body, model, start)
        self._s = settings or RepairedSettings()

    def _begin(self, frame: Frame, ins: Integral) -> None:
        self._at, self._arms = ins, self._arms_W(ins.C_WI)
        self._p_mm = self._start_points(frame)
        self._v_mm_s, self._b_mm_s2 = np.zeros_like(self._p_mm), np.zeros_like(self._p_mm)
        cov = np.diag([float(frame.var_mm2.max()), self._s.velocity_sd_mm_s**2, self._s.bias_sd_mm_s2**2])
        density = self._model.force_density * MM_PER_M
        m, g = self._model, float(np.linalg.norm(GRAVITY_W_MM_S2))
        walk = (m.force_walk * MM_PER_M) ** 2 + g * g * (m.rate_density**2 + self._s.drift_s * m.rate_bias**2)
        self._errors = ThreeStateFilters(np.zeros((3, self._p_mm.size)), cov, lambda dt: drift_noise(dt, density, walk))

    def _carried(self, ins: Integral) -> tuple[Array, Array, Array]:
        """INS positions, velocities (n, 3) and arms at `ins`, the bias taken off."""
        a = self._at
        dt = ins.t_s - a.t_s
        arms = self._arms_W(ins.C_WI)
        way = ins.s_mm - a.s_mm - a.v_mm_s * dt
        p = self._p_mm + self._v_mm_s * dt + way - (0.5 * dt * dt) * self._b_mm_s2 + arms - self._arms
        return p, self._v_mm_s + (ins.v_mm_s - a.v_mm_s) - dt * self._b_mm_s2, arms

    def _step(self, frame: Frame, ins: Integral) -> None:
        dt = frame.t_s - self._frame_s
        self._p_mm, self._v_mm_s, self._arms = self._carried(ins)
        self._at = ins
        self._errors.predict(dt)
        seen = np.repeat(frame.seen, 3)
        self._errors.update((self._p_mm - frame.xyz_mm).ravel(), frame.var_mm2.ravel(), seen)
        dp, dv, db = self._errors.x.reshape(3, -1, 3)
        self._p_mm, self._v_mm_s, self._b_mm_s2 = self._p_mm - dp, self._v_mm_s - dv, self._b_mm_s2 + db
        self._errors.x = np.zeros_like(self._errors.x)

    def _unmodelled_mm2(self, lost: Integral, ins: Integral) -> Array:
        """Tilt goes on growing at the rate bias, 0.5 g theta t^2, from a bias state that lags it; the force bias turns
        with the body while its state stands still in W; and a wrong heading turns what the motion itself gives."""
        t = ins.t_s - lost.t_s
        tilt = tilt_growth_mm(self._rate_sd(ins.t_s), t)
        if len(self.body.names) >= FOR_A_POSE:
            tilt = float(np.hypot(tilt, 0.5 * 9806.65 * SHOWN_TILT_RAD * t * t))
        turned = 0.5 * float(np.linalg.norm(log_so3(ins.C_WI @ lost.C_WI.T)))
        bias = 0.5 * t * t * self._model.force_bias * MM_PER_M * turned
        way = ins.s_mm - lost.s_mm - lost.v_mm_s * t
        aside = self._heading_sd() * float(np.hypot(way[0], way[1]))
        return np.array([np.hypot(tilt, aside)] * 2 + [0.0]) ** 2 + bias * bias

    def _points_at(self, t_s: float, ins: Integral) -> tuple[Array, Array, Array]:
        points, velocity, _ = self._carried(ins)
        ahead = self._errors.copy()
        if t_s > self._frame_s:
            ahead.predict(t_s - self._frame_s)
        cov = ahead.p[0].reshape(-1, 3)[:, :, None] * np.eye(3)
        return points, cov, velocity.mean(axis=0)
