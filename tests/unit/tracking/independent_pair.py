"""The repaired pair and the published one once more, written from the equations alone: plain loops, SciPy's rotations.

Shares no code with `docking.tracking`. One point, image with one sigma for all axes.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from docking.types import Array

G = np.array([0.0, 0.0, -9806.65])


def attitudes(t: Array, rate: Array, force: Array, R0: Array, quiet: Array) -> Array:
    """Body attitudes (n, 3, 3) at the samples: gyroscope from R0, its bias taken where `quiet` (n,) stands for at least
    a second, levelled there."""
    out = np.empty((len(t), 3, 3))
    R, bias, since = Rotation.from_matrix(R0), np.zeros(3), t[0]
    out[0] = R.as_matrix()
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        R = R * Rotation.from_rotvec((0.5 * (rate[k] + rate[k - 1]) - bias) * dt)
        if not quiet[k]:
            since = t[k]
        elif t[k] - since >= 1.0 and k % 6 == 0:
            span = slice(max(0, k - 70), k + 1)
            bias = rate[span].mean(axis=0)
            up = R.apply(force[span].mean(axis=0))
            R = Rotation.from_rotvec([0.2 * up[1] / up[2], -0.2 * up[0] / up[2], 0.0]) * R
        out[k] = R.as_matrix()
    return out


def quiet_samples(t: Array, rate: Array, force: Array, densities: tuple[float, float], window_s: float = 0.25) -> Array:
    """Whether force and rate are no louder than 1.3 times the sensor's noise over the window before each sample."""
    hz = 1.0 / float(np.median(np.diff(t)))
    n = int(window_s * hz)
    result = np.zeros(len(t), dtype=bool)
    for data, density in ((force, densities[0]), (rate, densities[1])):
        s1, s2 = np.cumsum(data, axis=0), np.cumsum(data * data, axis=0)
        mean, square = (s1[n:] - s1[:-n]) / n, (s2[n:] - s2[:-n]) / n
        calm = (square - mean * mean).sum(axis=1) < 3.0 * (1.3 * density) ** 2 * hz
        result[n:] = calm if density == densities[0] else result[n:] & calm
    return result


def repaired(
    t: Array, force: Array, R: Array, frame_t: Array, image: Array, hidden: Array, noise: tuple[float, float, float]
) -> Array:
    """Positions (m, 3) mm at the frames. `noise`: image sd mm, white force mm/s^2/sqrt(Hz), bias walk mm^2/s^5."""
    sd, white, walk = noise
    acc = np.einsum("nij,nj->ni", R, 1000.0 * force) + G
    p, v, b = image[0].copy(), np.zeros(3), np.zeros(3)
    P = [np.diag([sd**2, 100.0**2, 200.0**2]) for _ in range(3)]
    out = np.empty((len(frame_t), 3))
    out[0] = p
    now = frame_t[0]
    k = int(np.searchsorted(t, now, "right"))
    for m in range(1, len(frame_t)):
        end = frame_t[m]
        while now < end:
            until = min(end, t[k]) if k < len(t) else end
            dt = until - now
            a0 = _between(t, acc, now)
            a1 = _between(t, acc, until)
            a = 0.5 * (a0 + a1) - b
            p, v = p + v * dt + 0.5 * a * dt * dt, v + a * dt
            now = until
            if k < len(t) and now >= t[k]:
                k += 1
        T = end - frame_t[m - 1]
        F = np.array([[1.0, T, T * T / 2.0], [0.0, 1.0, T], [0.0, 0.0, 1.0]])
        Q = np.zeros((3, 3))
        Q[:2, :2] = white**2 * np.array([[T**3 / 3.0, T * T / 2.0], [T * T / 2.0, T]])
        Q[2, 2] = walk * T
        for axis in range(3):
            P[axis] = F @ P[axis] @ F.T + Q
            if not hidden[m]:
                K = P[axis][:, 0] / (P[axis][0, 0] + sd**2)
                correction = K * (p[axis] - image[m, axis])
                P[axis] = P[axis] - np.outer(K, P[axis][0])
                p[axis] -= correction[0]
                v[axis] -= correction[1]
                b[axis] += correction[2]
        out[m] = p
    return out


def _between(t: Array, values: Array, at: float) -> Array:
    k = int(np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2))
    share = np.clip((at - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0)
    return np.asarray(values[k] + share * (values[k + 1] - values[k]))


def bias_only(t: Array, acc: Array, frame_t: Array, image: Array, sd: float) -> Array:
    """Published filter 1 alone, (3,): biases from an inertial channel that starts at the first frame, from rest."""
    v, s = np.zeros(3), np.zeros(3)
    b, P, k = np.zeros(3), 900.0, 1
    for m in range(1, len(frame_t)):
        while k < len(t) and t[k] <= frame_t[m]:
            dt = t[k] - t[k - 1]
            a = 0.5 * (acc[k] + acc[k - 1])
            s, v, k = s + v * dt + 0.5 * a * dt * dt, v + a * dt, k + 1
        tau = frame_t[m] - frame_t[0]
        h = tau * tau / 2.0
        K = P * h / (h * h * P + sd**2)
        b = b + K * (image[0] + s - image[m] - h * b)
        P *= 1.0 - K * h
    return b
