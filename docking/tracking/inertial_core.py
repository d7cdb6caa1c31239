"""The error-state Kalman filter of an inertial navigation: prediction in blocks, measurements by few columns.

Error state, mm, s, rad: position p, velocity v of the sensor's origin in W, attitude phi in W (true = Exp(phi) C),
force bias b_a (mm/s^2) and rate bias b_g in I: 15; behind them, as asked for, the time by which the sensor's stamps are
late (1), scales and misalignments of gyroscope M and accelerometer N (9 each, by rows), a lever arm (3). Between
samples, with a = C f:

    p' = v    v' = -[a]x phi - C b_a + C N f    phi' = -C b_g + C M w

The covariance is carried over several samples at once with the sums of a and C over them; closed forms, no matrix
exponential.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.tracking.strapdown import G_W_MM_S2, orthonormal, turn
from docking.tracking.types import MM_PER_M, InertialModel
from docking.types import Array

P, V, PHI, BA, BG = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
BASE = 15
_EYE3 = np.eye(3)
_KNOCK, _UNKNOWN_SHARE = 4.0, 0.5
"""A knock changes the force between two samples by so many times the variance of noise; the share of such a change by
which its push is uncertain, 1 sigma."""
_LAG_KNOWN_S = 1e-3
"""A lag with a larger sd is none that was found."""


class Extras(NamedTuple):
    """States beyond the fifteen and their sd at the start; 0 leaves one out: `time_sd_s`, `scale_sd` and
    `force_scale_sd` (ratio, rad) of gyroscope and accelerometer, `lever_sd_mm`."""

    time_sd_s: float = 0.0
    scale_sd: float = 0.0
    force_scale_sd: float = 0.0
    lever_sd_mm: float = 0.0


class Layout:
    """Where the extra states lie in the error state; None where they are left out."""

    def __init__(self, extras: Extras) -> None:
        self.size = BASE
        self.time = self._take(1, extras.time_sd_s)
        self.scale = self._take(9, extras.scale_sd)
        self.force_scale = self._take(9, extras.force_scale_sd)
        self.lever = self._take(3, extras.lever_sd_mm)

    def _take(self, count: int, sd: float) -> slice | None:
        if not sd > 0.0:
            return None
        self.size += count
        return slice(self.size - count, self.size)


class Navigation(NamedTuple):
    """Nominal state at `t_s`: `p_mm`, `v_mm_s` (3,) of the sensor in W, `C_WI` (3, 3), biases, and the extra states:
    `scale` and `force_scale` are (3, 3)."""

    t_s: float
    p_mm: Array
    v_mm_s: Array
    C_WI: Array
    force_bias_mm_s2: Array
    rate_bias: Array
    late_s: float
    scale: Array
    force_scale: Array
    lever_mm: Array

    def moved(self, dx: Array, layout: Layout) -> Navigation:
        """The state with the error `dx` (n,) taken in."""
        x, y, z = dx[PHI].tolist()
        return Navigation(
            self.t_s,
            self.p_mm + dx[P],
            self.v_mm_s + dx[V],
            turn(x, y, z) @ self.C_WI,
            self.force_bias_mm_s2 + dx[BA],
            self.rate_bias + dx[BG],
            self.late_s + (float(dx[layout.time][0]) if layout.time else 0.0),
            self.scale + dx[layout.scale].reshape(3, 3) if layout.scale else self.scale,
            self.force_scale + dx[layout.force_scale].reshape(3, 3) if layout.force_scale else self.force_scale,
            self.lever_mm + dx[layout.lever] if layout.lever else self.lever_mm,
        )


class Since(NamedTuple):
    """Sums over the samples since the covariance was last carried on: duration, velocity gained by specific force, the
    way that it brought, and in I the angle turned and the specific force times time. `jolt_mm2_s2`: variance of what
    knocks between samples did to the velocity."""

    dt_s: float
    dv_mm_s: Array
    ds_mm: Array
    angle_rad: Array
    push_mm_s: Array
    jolt_mm2_s2: float = 0.0


NOTHING = Since(0.0, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


def integrate(nav: Navigation, since: Since, t_s: float, force: Array, rate: Array) -> tuple[Navigation, Since]:
    """Advance to `t_s` with the interval's mean specific force (mm/s^2) and rate (rad/s), both as measured."""
    _, p, v, C, force_bias, rate_bias, late, scale, force_scale, lever = nav
    summed_s, summed_dv, summed_ds, summed_angle, summed_push, jolt = since
    dt = t_s - nav.t_s
    angle = dt * (rate - rate_bias)
    angle = angle + scale @ angle
    x, y, z = angle.tolist()
    after = C @ turn(x, y, z)
    push = dt * (force - force_bias)
    push = push + force_scale @ push
    dv = 0.5 * ((C + after) @ push)
    gained = dv + G_W_MM_S2 * dt
    moved = Navigation(
        t_s, p + (v + 0.5 * gained) * dt, v + gained, after, force_bias, rate_bias, late, scale, force_scale, lever
    )
    ds = summed_ds + (summed_dv + 0.5 * dv) * dt
    return moved, Since(summed_s + dt, summed_dv + dv, ds, summed_angle + angle, summed_push + push, jolt)


def known_lag_s(nav: Navigation, cov: Array, layout: Layout) -> float:
    """By how much the sensor's stamps are late, 0 where the data do not show it."""
    at = layout.time
    return nav.late_s if at is not None and float(cov[at, at][0, 0]) <= _LAG_KNOWN_S**2 else 0.0


def squared(nav: Navigation) -> Navigation:
    """The state with its attitude made orthonormal again."""
    return nav._replace(C_WI=orthonormal(nav.C_WI))


def _skew(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


class Propagation:
    """Carries the covariance over the sums of several samples; the noise is the sensor's."""

    def __init__(self, model: InertialModel, layout: Layout) -> None:
        self._layout = layout
        self._force, self._rate = (model.force_density * MM_PER_M) ** 2, model.rate_density**2
        self._force_walk, self._rate_walk = (model.force_walk * MM_PER_M) ** 2, model.rate_walk**2
        self._slip = model.rate_slip**2
        self._i3 = np.arange(3)

    def __call__(self, cov: Array, C_before: Array, C_after: Array, since: Since) -> tuple[Array, Array]:
        """(Phi, Phi P Phi^T + Q), both (n, n)."""
        dt = since.dt_s
        phi = np.eye(self._layout.size)
        C = 0.5 * (C_before + C_after)
        slope, way = _skew(since.dv_mm_s), _skew(since.ds_mm)
        phi[P, V] = dt * _EYE3
        phi[P, PHI], phi[V, PHI] = -way, -slope
        phi[P, BA], phi[V, BA] = (-0.5 * dt * dt) * C, -dt * C
        phi[PHI, BG] = -dt * C
        # phi grows by -C b_g t meanwhile, so half of it has acted on the velocity, a third of that on the way
        phi[V, BG], phi[P, BG] = (0.5 * dt) * (slope @ C), (dt / 3.0) * (way @ C)
        if self._layout.scale is not None:
            turned = np.multiply.outer(C, since.angle_rad).reshape(3, 9)
            phi[PHI, self._layout.scale] = turned
            phi[V, self._layout.scale], phi[P, self._layout.scale] = -0.5 * slope @ turned, (-1.0 / 3.0) * way @ turned
        if self._layout.force_scale is not None:
            gained = np.multiply.outer(C, since.push_mm_s).reshape(3, 9)
            phi[V, self._layout.force_scale], phi[P, self._layout.force_scale] = gained, (0.5 * dt) * gained
        after = phi @ cov @ phi.T
        self._add_noise(after, dt, float(since.angle_rad @ since.angle_rad))
        after[self._i3 + 3, self._i3 + 3] += since.jolt_mm2_s2
        return phi, after

    def jolted(self, since: Since, change_mm_s2: Array, dt: float) -> Since:
        """What the force did between two samples is not known where they differ by far more than noise: a knock. Its
        push is off the trapezoid's by a share of the difference."""
        over = float(change_mm_s2 @ change_mm_s2) - _KNOCK * 6.0 * self._force / dt
        if not (over > 0.0):
            return since
        return since._replace(jolt_mm2_s2=since.jolt_mm2_s2 + (_UNKNOWN_SHARE * dt) ** 2 * over / 3.0)

    def _add_noise(self, cov: Array, dt: float, angle2: float) -> None:
        i, v, a = self._i3, self._i3 + 3, self._force
        cov[i, i] += a * dt**3 / 3.0
        cov[i, v] += a * dt * dt / 2.0
        cov[v, i] += a * dt * dt / 2.0
        cov[v, v] += a * dt
        cov[i + 6, i + 6] += self._rate * dt + self._slip * angle2 / dt
        cov[i + 9, i + 9] += self._force_walk * dt
        cov[i + 12, i + 12] += self._rate_walk * dt


def unguided(cov: Array, dt: float, force_sd_mm_s2: float, rate_sd: float) -> tuple[Array, Array]:
    """(Phi, covariance) after `dt` in which no sample is believed: the body goes on at its velocity, and accelerates
    and turns at random with these sds and a tenth of a second of memory."""
    phi = np.eye(len(cov))
    phi[P, V] = dt * _EYE3
    after = phi @ cov @ phi.T
    a, i = force_sd_mm_s2**2 * 0.1 * dt, np.arange(3)
    after[i, i] += a * dt * dt / 3.0
    after[i, i + 3] += a * dt / 2.0
    after[i + 3, i] += a * dt / 2.0
    after[i + 3, i + 3] += a
    after[i + 6, i + 6] += rate_sd**2 * 0.1 * dt
    return phi, after


def point_rows(nav: Navigation, layout: Layout, arms_W_mm: Array, turning_W: Array) -> Array:
    """H (3k, n) of points at the arms `C l` (k, 3) from the sensor: z = p + C l. A sensor whose stamps are late by dt
    was, when the image was taken, further on by the velocity of the point times dt."""
    k = len(arms_W_mm)
    h = np.zeros((k, 3, layout.size))
    i = np.arange(3)
    h[:, i, i] = 1.0
    x, y, z = arms_W_mm.T
    h[:, 0, 7], h[:, 0, 8] = z, -y
    h[:, 1, 6], h[:, 1, 8] = -z, x
    h[:, 2, 6], h[:, 2, 7] = y, -x
    if layout.time is not None:
        h[:, :, layout.time.start] = nav.v_mm_s + np.cross(turning_W, arms_W_mm)
    if layout.lever is not None:
        h[:, :, layout.lever] = nav.C_WI
    return h.reshape(3 * k, layout.size)


def taken_in(cov: Array, rows: Array, residual: Array, noise: Array) -> tuple[Array, Array]:
    """One Kalman update: (dx (n,), covariance after). `rows` (m, n), `residual` (m,), `noise` (m, m)."""
    ph = cov @ rows.T
    s = rows @ ph + noise
    gain = np.linalg.solve(s, ph.T).T
    after = cov - gain @ ph.T
    return gain @ residual, 0.5 * (after + after.T)
