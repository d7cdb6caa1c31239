"""Truth and sensors of a body that moves in space: what an inertial sensor, a camera and encoders would have said.

Everything follows from the place and turn of the body as functions of time, by differences over them; rotations are
SciPy's. Nothing here knows how anybody integrates or filters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from docking.types import Array, Pose

G_W_MM_S2 = np.array([0.0, 0.0, -9806.65])
_RATE_STEP_S, _FORCE_STEP_S = 1e-4, 1e-3
Random = np.random.Generator


@dataclass(frozen=True)
class Motion:
    """Place (n, 3) mm and turn of the body in W at times (n,)."""

    place: Callable[[Array], Array]
    turn: Callable[[Array], Rotation]

    def points(self, t_s: Array, points_B_mm: Array) -> Array:
        """Body points (k, 3) in W at times (n,): (n, k, 3)."""
        R = self.turn(t_s).as_matrix()
        result: Array = self.place(t_s)[:, None] + np.einsum("nij,kj->nki", R, points_B_mm)
        return result


@dataclass(frozen=True)
class InertialErrors:
    """What is wrong with an inertial sensor, 1 sigma or as drawn; units as in data sheets (m, s, rad).

    White noise densities, bias at switching on and its walk, scale and misalignment (ratio, rad), `late_s` by which its
    stamps lag, ranges at which it clips.
    """

    force_density: float
    rate_density: float
    force_bias: float
    rate_bias: float
    force_walk: float
    rate_walk: float
    force_range: float = 160.0
    rate_range: float = 35.0
    scale: float = 0.0
    misalignment_rad: float = 0.0
    late_s: float = 0.0


def multi_sine(rng: Random, reach_mm: float = 400.0, turn_rad: float = 0.1745) -> Motion:
    """Five sines between 0.05 and 0.5 Hz on every axis that reach at most so far, from rest within four seconds."""
    places, angles = (_waves(rng, reach) for reach in (reach_mm, turn_rad))
    heading = rng.uniform(-np.pi, np.pi)

    def turn(t_s: Array) -> Rotation:
        euler = angles(t_s)
        euler[:, 0] += heading
        return Rotation.from_euler("ZYX", euler)

    return Motion(places, turn)


def _waves(rng: Random, reach: float) -> Callable[[Array], Array]:
    frequency = rng.uniform(0.05, 0.5, (5, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, 3))
    size = rng.uniform(0.2, 1.0, (5, 3)) / frequency
    size *= reach / size.sum(axis=0)

    def waves(t_s: Array) -> Array:
        s = np.clip(np.asarray(t_s) / 4.0, 0.0, 1.0)
        ramp = s**4 * (35.0 - 84.0 * s + 70.0 * s * s - 20.0 * s**3)
        waving = np.sum(size * np.sin(2.0 * np.pi * frequency * np.asarray(t_s)[:, None, None] + phase), axis=1)
        result: Array = ramp[:, None] * waving
        return result

    return waves


def docking_motion(rng: Random, length_s: float, fastest_mm_s: float = 10.0) -> Motion:
    """Smooth approach along one direction at changing speeds up to `fastest_mm_s`, rests between, half a degree of
    turning."""
    knots = np.arange(0.0, length_s + 8.0, 2.0)
    speed = rng.uniform(0.0, fastest_mm_s, len(knots)) * (rng.random(len(knots)) > 0.2)
    speed[:2] = 0.0
    way = PchipInterpolator(knots, speed).antiderivative()
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    angles = _waves(rng, 0.009)
    heading = rng.uniform(-np.pi, np.pi)

    def turn(t_s: Array) -> Rotation:
        euler = angles(0.2 * np.asarray(t_s))
        euler[:, 0] += heading
        return Rotation.from_euler("ZYX", euler)

    return Motion(lambda t: way(t)[:, None] * direction, turn)


def inertial_samples(
    motion: Motion, t_s: Array, X_BI: Pose, errors: InertialErrors, rng: Random
) -> tuple[Array, Array]:
    """Specific force (n, 3) m/s^2 and rate (n, 3) rad/s that the sensor stamps with `t_s`, in its own axes."""
    t = np.asarray(t_s) - errors.late_s
    h = _FORCE_STEP_S
    arm = X_BI.t_mm[None]
    before, here, after = (motion.points(t + step, arm)[:, 0] for step in (-h, 0.0, h))
    acceleration = (after - 2.0 * here + before) / (h * h)
    mount = Rotation.from_matrix(X_BI.R)
    axes = motion.turn(t) * mount
    force = axes.inv().apply(acceleration - G_W_MM_S2) / 1000.0
    turned = (motion.turn(t - _RATE_STEP_S) * mount).inv() * (motion.turn(t + _RATE_STEP_S) * mount)
    rate = turned.as_rotvec() / (2.0 * _RATE_STEP_S)
    step_s = float(np.median(np.diff(t_s)))
    f = _spoiled(force, (errors.force_density, errors.force_bias, errors.force_walk), errors, step_s, rng)
    w = _spoiled(rate, (errors.rate_density, errors.rate_bias, errors.rate_walk), errors, step_s, rng)
    return np.clip(f, -errors.force_range, errors.force_range), np.clip(w, -errors.rate_range, errors.rate_range)


def _spoiled(
    true: Array, noise: tuple[float, float, float], errors: InertialErrors, step_s: float, rng: Random
) -> Array:
    """Crooked and scaled axes, bias that walks, white noise."""
    density, bias, walk = noise
    axes = np.eye(3) + np.diag(rng.normal(0.0, errors.scale, 3)) + _crooked(errors.misalignment_rad, rng)
    drift = rng.normal(0.0, bias, 3) + np.cumsum(rng.normal(0.0, walk * np.sqrt(step_s), true.shape), axis=0)
    result: Array = true @ axes.T + drift + rng.normal(0.0, density / np.sqrt(step_s), true.shape)
    return result


def _crooked(size_rad: float, rng: Random) -> Array:
    off: Array = rng.normal(0.0, size_rad, (3, 3)) * (1.0 - np.eye(3))
    return off


def encoder_poses(motion: Motion, t_s: Array, scale: float, noise_mm: float, rng: Random) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) and places (n, 3) as the positioners' encoders have them: the ways are scaled by `scale` an
    axis and everything is put elsewhere by some millimetres."""
    place = motion.place(t_s)
    wrong = rng.normal(0.0, scale, 3) * (place - place[0]) + rng.normal(0.0, 3.0, 3)
    return motion.turn(t_s).as_matrix(), place + wrong + rng.normal(0.0, noise_mm, place.shape)
