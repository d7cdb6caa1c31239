"""By how much the stamps of the inertial sensor lag those of the image: found before anything is fused.

What needs no attitude is compared: the length of the specific force with that of the image's acceleration minus
gravity, both smoothed alike: the image's way by a local parabola, the force by what that parabola does to a second
derivative. The lag with the best correlation wins, between steps by a parabola.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs

from docking.pose.batch import fit_poses
from docking.pose.layout import MIN_POINTS
from docking.tracking.recording import Recording
from docking.tracking.strapdown import G_W_MM_S2
from docking.tracking.types import MM_PER_M
from docking.types import Array

_RATE_HZ = 200.0
_WINDOW_S = 0.25
_LEAST_CORRELATION = 0.5
_LEAST_S = 5.0


class TimeOffset(NamedTuple):
    """`late_s` to subtract from the sensor's stamps, and the correlation that it brings; 0 and NaN where the motion
    shows none."""

    late_s: float
    correlation: float


def find_time_offset(recording: Recording, reach_s: float = 0.3) -> TimeOffset:
    """The lag within +-`reach_s`. Raises DegenerateTargets where three points or more lie on a line."""
    grid, image, known = _image_force(recording)
    if known.sum() < _LEAST_S * _RATE_HZ:
        return TimeOffset(0.0, float("nan"))
    lags = np.arange(-int(reach_s * _RATE_HZ), int(reach_s * _RATE_HZ) + 1)
    score = np.array([_correlation(recording, grid, image, known, lag / _RATE_HZ) for lag in lags])
    best = int(np.nanargmax(score))
    if not (score[best] >= _LEAST_CORRELATION) or best in (0, len(lags) - 1):
        return TimeOffset(0.0, float(score[best]))
    a, b, c = score[best - 1 : best + 2]
    part = 0.5 * (a - c) / (a - 2.0 * b + c)
    return TimeOffset(float((lags[best] + part) / _RATE_HZ), float(b))


def _image_force(recording: Recording) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Even times (k,), length of the specific force (m/s^2) that the image shows, and whether it is known there."""
    xyz = _sensor_places(recording)
    good = np.isfinite(xyz).all(axis=1)
    if good.sum() < 4:
        nothing = np.zeros(0)
        return nothing, nothing, nothing.astype(bool)
    t = recording.frame_t_s[good]
    grid = np.arange(t[0], t[-1], 1.0 / _RATE_HZ)
    even = np.column_stack([np.interp(grid, t, xyz[good, k]) for k in range(3)])
    bend = _kernel(2)
    acceleration = np.column_stack([np.convolve(even[:, k], bend, "same") for k in range(3)])
    force = np.linalg.norm(acceleration - G_W_MM_S2, axis=1) / MM_PER_M
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    gap = t[after] - t[after - 1] > 3.0 * float(np.median(np.diff(t)))
    bad = np.convolve(gap.astype(float), np.ones(len(bend)), "same") > 0.0
    bad[: len(bend)] = bad[-len(bend) :] = True
    return grid, force, np.asarray(~bad)


def _sensor_places(recording: Recording) -> Array:
    """Where the sensor is (M, 3) by the pose of three points or more, else the point that is seen most."""
    body, seen = recording.body, recording.seen()
    if len(body.names) < MIN_POINTS:
        return recording.points_W_mm[:, int(np.argmax(seen.sum(axis=0)))]
    whole, result = seen.all(axis=1), np.full((len(seen), 3), np.nan)
    if whole.any():
        poses = fit_poses(body.points_B_mm, recording.points_W_mm[whole])
        result[whole] = poses.R @ body.X_BI.t_mm + poses.t_mm
    return result


def _kernel(derivative: int) -> Array:
    """Weights of a local parabola's value or curvature over the window, in the order of `np.convolve`."""
    length = 2 * int(_WINDOW_S * _RATE_HZ / 2) + 1
    return np.asarray(savgol_coeffs(length, 2, deriv=derivative, delta=1.0 / _RATE_HZ))


def _correlation(recording: Recording, grid: Array, image: Array, known: NDArray[np.bool_], late_s: float) -> float:
    """Of the image's force with that of the sensor, smoothed by the same curvature of its double integral."""
    t = recording.imu_t_s - late_s
    size = np.linalg.norm(recording.force_m_s2, axis=1)
    smooth = np.convolve(np.interp(grid, t, size), _double_integral_weights(), "same")
    use = known & (grid > t[0] + _WINDOW_S) & (grid < t[-1] - _WINDOW_S)
    if use.sum() < _LEAST_S * _RATE_HZ:
        return float("nan")
    a, b = image[use] - image[use].mean(), smooth[use] - smooth[use].mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-12))


def _double_integral_weights() -> Array:
    """What the curvature of a local parabola of the way does to the acceleration: the weights summed twice. The last
    two sums are 0; without them the middle is the middle again."""
    weights = np.cumsum(np.cumsum(_kernel(2)))[:-2]
    return np.asarray(weights / weights.sum())
