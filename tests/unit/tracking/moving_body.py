"""Simulated recordings for the tests of tracking."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from docking.tracking.grades import GRADES
from docking.tracking.recording import Recording
from docking.tracking.types import BodyModel
from docking.types import Array, Pose
from sim.inertial_motion import InertialErrors, Motion, inertial_samples, multi_sine

BOX = np.array([[x, y, z] for x in (-600.0, 600.0) for y in (-350.0, 400.0) for z in (-200.0, 250.0)])


def section(X_BI: Pose | None = None, points: int = 8) -> BodyModel:
    """A box with points at its corners."""
    names = tuple(f"T{k + 1}" for k in range(points))
    return BodyModel("box", names, BOX[:points], np.array([20.0, 10.0, -5.0]), X_BI or Pose.identity())


def record(
    body: BodyModel,
    length_s: float,
    grade: str = "mems",
    seed: int = 1,
    sigma_mm: float = 1.0,
    late_s: float = 0.0,
    motion: Motion | None = None,
    true_body: BodyModel | None = None,
    imu_hz: float = 200.0,
    frame_hz: float = 50.0,
) -> tuple[Recording, Array, Motion]:
    """A recording of a waving body, true places (M, n, 3), and the motion. `true_body` where the model is wrong."""
    rng, m, real = np.random.default_rng(seed), GRADES[grade], true_body or body
    way = motion or multi_sine(rng)
    errors = InertialErrors(
        m.force_density, m.rate_density, m.force_bias, m.rate_bias, m.force_walk, m.rate_walk, late_s=late_s
    )
    t = np.arange(0.0, length_s, 1.0 / imu_hz)
    frame_t = 0.0013 + np.arange(0.0, length_s - 0.05, 1.0 / frame_hz)
    force, rate = inertial_samples(way, t, real.X_BI, errors, rng)
    truth = way.points(frame_t, real.points_B_mm)
    tilt = Rotation.from_rotvec(rng.normal(0.0, [m.force_bias / 9.8, m.force_bias / 9.8, 0.01]))
    attitude = np.asarray(tilt.as_matrix() @ way.turn(frame_t).as_matrix())
    nothing = np.zeros(0)
    recording = Recording(
        "sim", body, t, force, rate, frame_t, truth + rng.normal(0.0, sigma_mm, truth.shape),
        np.full(truth.shape, sigma_mm), attitude, nothing, np.zeros((0, 3, 3)), np.zeros((0, 3)),
        np.full(len(frame_t), np.nan),
    )  # fmt: skip
    return recording, truth, way
