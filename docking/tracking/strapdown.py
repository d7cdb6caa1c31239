"""An inertial sensor on its own: attitude, velocity and displacement by integrating what it says, with a short history.

Trapezoids over every sample interval; the attitude at mid-interval turns the specific force into W: with the attitude
at its start the end of a 3 s gap is off by centimetres.
"""

from __future__ import annotations

from bisect import bisect_right
from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from docking.tracking.types import GRAVITY_W_MM_S2, MM_PER_M
from docking.types import Array

G_W_MM_S2 = np.array(GRAVITY_W_MM_S2)
_SMALL_RAD2 = 1e-6
_ORTHONORMAL_STEPS = 500
_TRIM = 512


def turn(x: float, y: float, z: float) -> Array:
    """Rotation matrix (3, 3) of the rotation vector (x, y, z) rad; one small array instead of many."""
    square = x * x + y * y + z * z
    if square < _SMALL_RAD2:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = sqrt(square)
        a, b = sin(angle) / angle, (1.0 - cos(angle)) / square
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    return np.array(
        (
            (1.0 - b * (y * y + z * z), xy - a * z, xz + a * y),
            (xy + a * z, 1.0 - b * (x * x + z * z), yz - a * x),
            (xz - a * y, yz + a * x, 1.0 - b * (x * x + y * y)),
        )
    )


def orthonormal(C: Array) -> Array:
    """The rotation next to `C` (3, 3), whose columns have lost their angles by rounding."""
    u, _, vt = np.linalg.svd(C)
    result: Array = u @ vt
    return result


class Integral(NamedTuple):
    """What was integrated up to `t_s`: attitude `C_WI` (3, 3), velocity (3,) mm/s and displacement (3,) mm, both from
    rest at the start."""

    t_s: float
    C_WI: Array
    v_mm_s: Array
    s_mm: Array


class Strapdown:
    """Free inertial navigation from rest; attitude and `rate_bias` (3,) rad/s may be corrected from outside."""

    def __init__(self, C_WI: Array, history_s: float = 1.0) -> None:
        self.C_WI, self._history_s = C_WI, history_s
        self._v, self._s = np.zeros(3), np.zeros(3)
        self.rate_bias = np.zeros(3)
        self._force: Array | None = None
        self._rate = np.zeros(3)
        self._times: list[float] = []
        self._past: list[Integral] = []

    @property
    def t_s(self) -> float:
        """Time of the newest sample; NaN before the first."""
        return self._times[-1] if self._times else float("nan")

    def sample(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """Integrate up to `t_s`; samples must come in order."""
        force, rate_rad_s = force_m_s2 * MM_PER_M, rate_rad_s - self.rate_bias
        if self._force is not None:
            dt = t_s - self._times[-1]
            x, y, z = ((0.5 * dt) * (self._rate + rate_rad_s)).tolist()
            after = self.C_WI @ turn(x, y, z)
            dv = ((0.25 * dt) * (self.C_WI + after)) @ (self._force + force) + G_W_MM_S2 * dt
            self._s = self._s + (self._v + 0.5 * dv) * dt
            self._v = self._v + dv
            self.C_WI = orthonormal(after) if len(self._times) % _ORTHONORMAL_STEPS == 0 else after
        self._force, self._rate = force, rate_rad_s
        self._times.append(t_s)
        self._past.append(Integral(t_s, self.C_WI, self._v, self._s))
        if len(self._times) > 2 * _TRIM and self._times[_TRIM] < t_s - self._history_s:
            del self._times[:_TRIM], self._past[:_TRIM]

    def at(self, t_s: float) -> Integral | None:
        """The integral at `t_s`, between samples linear in the specific force; beyond the newest sample as if it held.
        None before the first sample and before the history."""
        i = bisect_right(self._times, t_s) - 1
        if i < 0:
            return None
        a = self._past[i]
        tau = t_s - a.t_s
        if tau == 0.0:
            return a
        if i + 1 < len(self._past):
            b = self._past[i + 1]
            share = tau / (b.t_s - a.t_s)
            C = a.C_WI if share < 0.5 else b.C_WI
            acc = (b.v_mm_s - a.v_mm_s) / (b.t_s - a.t_s)
        else:
            assert self._force is not None
            C, acc = a.C_WI, a.C_WI @ self._force + G_W_MM_S2
        return Integral(t_s, C, a.v_mm_s + acc * tau, a.s_mm + a.v_mm_s * tau + (0.5 * tau * tau) * acc)

    def correct(self, rotvec_W_rad: Array) -> None:
        """Turn the newest attitude by a small rotation in W."""
        x, y, z = rotvec_W_rad.tolist()
        self.C_WI = turn(x, y, z) @ self.C_WI
        if self._past:
            self._past[-1] = self._past[-1]._replace(C_WI=self.C_WI)
