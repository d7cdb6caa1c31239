"""By how much the stamps of the inertial sensor lag those of the image: found before anything is fused.

What needs no attitude is compared: the length of the specific force with that of the image's acceleration minus
gravity, both smoothed alike: the image's way by a local parabola, the force by what that parabola does to a second
derivative. Where the image shows attitudes, the turning between frames is compared with the gyroscope's, too. The lag
with the best correlation wins, between steps by a parabola.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs
from scipy.spatial.transform import Rotation

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
_STRIDE_S = 0.1


class TimeOffset(NamedTuple):
    """`late_s` to subtract from the sensor's stamps, and the correlation that it brings; 0 and NaN where the motion
    shows none."""

    late_s: float
    correlation: float


Score = Callable[[float], float]
"""Correlation of what image and sensor say, for a lag in s; NaN where too little is known."""


def find_time_offset(recording: Recording, reach_s: float = 0.3) -> TimeOffset:
    """The lag within +-`reach_s`, by force or by turning, whichever shows it more sharply.

    Raises DegenerateTargets where three points or more lie on a line.
    """
    peaks = [_peak(score, reach_s) for score in (_force_score(recording), _turning_score(recording))]
    return max(peaks, key=lambda peak: peak[1])[0]


def _peak(score: Score, reach_s: float) -> tuple[TimeOffset, float]:
    """The best lag and how sharp it stands out (bend of the correlation over its lack to 1; -1: it does not)."""
    lags = np.arange(-int(reach_s * _RATE_HZ), int(reach_s * _RATE_HZ) + 1)
    found = np.array([score(lag / _RATE_HZ) for lag in lags])
    if np.isnan(found).all():
        return TimeOffset(0.0, float("nan")), -1.0
    best = int(np.nanargmax(found))
    if not (found[best] >= _LEAST_CORRELATION) or best in (0, len(lags) - 1):
        return TimeOffset(0.0, float(found[best])), -1.0
    a, b, c = found[best - 1 : best + 2]
    bend = 2.0 * b - a - c
    if not (bend > 0.0):
        return TimeOffset(0.0, float(b)), -1.0
    late_s = float((lags[best] + 0.5 * (c - a) / bend) / _RATE_HZ)
    return TimeOffset(late_s, float(b)), float(bend / max(1.0 - b, 1e-9))


def _force_score(recording: Recording) -> Score:
    grid, image, known = _image_force(recording)
    if known.sum() < _LEAST_S * _RATE_HZ:
        return lambda late_s: float("nan")
    return lambda late_s: _correlation(recording, grid, image, known, late_s)


def _turning_score(recording: Recording) -> Score:
    """Length of the mean turning rate between frames `_STRIDE_S` apart: the image's against the gyroscope's."""
    R, t, imu_t = image_attitudes(recording), recording.frame_t_s, recording.imu_t_s
    if len(t) < 2 or len(imu_t) < 2:
        return lambda late_s: float("nan")
    step = max(1, round(_STRIDE_S / float(np.median(np.diff(t)))))
    known = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    pair = known[step:] & known[:-step] & (t[step:] - t[:-step] < 1.5 * _STRIDE_S)
    first, last = t[:-step][pair], t[step:][pair]
    if (last - first).sum() < _LEAST_S * step:
        return lambda late_s: float("nan")
    turn = np.swapaxes(R[:-step][pair], 1, 2) @ R[step:][pair]
    image = Rotation.from_matrix(turn).magnitude() / (last - first)
    steps = 0.5 * (recording.rate_rad_s[1:] + recording.rate_rad_s[:-1]) * np.diff(imu_t)[:, None]
    turned = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    def score(late_s: float) -> float:
        ends = (
            np.column_stack([np.interp(at + late_s, imu_t, turned[:, k]) for k in range(3)]) for at in (first, last)
        )
        begun, ended = ends
        use = (first + late_s > imu_t[0]) & (last + late_s < imu_t[-1])
        rate = np.linalg.norm(ended - begun, axis=1) / (last - first)
        return _correlated(image[use], rate[use])

    return score


def image_attitudes(recording: Recording) -> Array:
    """(M, 3, 3) as recorded, else by the pose of three points or more; NaN where the image shows none."""
    if np.isfinite(recording.attitude_WB).any():
        return recording.attitude_WB
    whole = np.asarray(recording.seen().all(axis=1))
    result = np.full((len(whole), 3, 3), np.nan)
    if len(recording.body.names) >= MIN_POINTS and whole.any():
        result[whole] = fit_poses(recording.body.points_B_mm, recording.points_W_mm[whole]).R
    return result


def _correlated(a: Array, b: Array) -> float:
    if len(a) < 2:
        return float("nan")
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-12)


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
    return _correlated(image[use], smooth[use])


def _double_integral_weights() -> Array:
    """What the curvature of a local parabola of the way does to the acceleration: the weights summed twice. The last
    two sums are 0; without them the middle is the middle again."""
    weights = np.cumsum(np.cumsum(_kernel(2)))[:-2]
    return np.asarray(weights / weights.sum())
