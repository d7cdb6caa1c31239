"""P13: dynamic positioning. A filter step against filterpy's; a live body against real time, a share of one core."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np

from docking.tracking.axis_filters import ThreeStateFilters, polynomial_noise, transition
from docking.tracking.grades import GRADES
from docking.tracking.inertial import InertialTracker
from docking.tracking.types import BodyModel, Start
from docking.types import Pose
from sim.inertial_motion import InertialErrors, inertial_samples, multi_sine
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side

STEPS = 300
"""Filter steps a turn: one alone is too short for the clock."""
POINTS, FRAME_HZ, IMU_HZ = 10, 60.0, 400.0
DT_S = 0.02


def measure(sizes: Sizes) -> list[Metric]:
    return [*_steps(sizes), _live(sizes)]


def _steps(sizes: Sizes) -> list[Metric]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from filterpy.kalman import KalmanFilter
    peers = [KalmanFilter(dim_x=3, dim_z=1) for _ in range(3)]
    phi, q = transition(DT_S), polynomial_noise(DT_S, 10.0)
    for peer in peers:
        peer.H, peer.R = np.array([[1.0, 0.0, 0.0]]), np.eye(1)
    mine = ThreeStateFilters(np.zeros((3, 3)), np.eye(3), lambda dt: polynomial_noise(dt, 10.0))
    z = np.random.default_rng(1).normal(size=(STEPS, 3))
    columns = z[:, :, None, None]

    def product() -> None:
        for row in z:
            mine.predict(DT_S)
            mine.update(row, 1.0)

    def peer() -> None:
        for row in columns:
            for k, one in enumerate(peers):
                one.predict(F=phi, Q=q)
                one.update(row[k])

    works: dict[str, Callable[[], object]] = {"product": product, "peer": peer}
    times = side_by_side(works, 3 * sizes.repeats)
    a, b = (1e6 * float(np.median(times[name])) / STEPS for name in ("product", "peer"))
    ratio = median_ratio(times["product"], times["peer"])
    what = "predict and update, three axes"
    return [Metric("P13", what, f"{a:.1f} us", f"{b:.1f} us filterpy", ratio, 1.0, at_least=False)]


def _live(sizes: Sizes) -> Metric:
    """Ten points at 60 Hz and an inertial sensor at 400 Hz, a state asked for after every frame, frames 20 ms late."""
    length_s = 0.5 if sizes.repeats == 1 else 5.0
    rng, m = np.random.default_rng(2), GRADES["mems"]
    motion = multi_sine(rng)
    body = BodyModel("body", tuple(f"T{k}" for k in range(POINTS)), rng.uniform(-800.0, 800.0, (POINTS, 3)))
    t, frame_t = np.arange(0.0, length_s, 1.0 / IMU_HZ), np.arange(0.0, length_s, 1.0 / FRAME_HZ)
    errors = InertialErrors(m.force_density, m.rate_density, m.force_bias, m.rate_bias, m.force_walk, m.rate_walk)
    force, rate = inertial_samples(motion, t, Pose.identity(), errors, rng)
    seen = motion.points(frame_t, body.points_B_mm) + rng.normal(0.0, 1.0, (len(frame_t), POINTS, 3))
    cov = np.tile(np.eye(3), (POINTS, 1, 1))
    shares = []
    for _ in range(sizes.repeats):
        tracker = InertialTracker(body, m, Start(motion.turn(frame_t[:1]).as_matrix()[0]))
        begun, frame = time.process_time(), 0
        for k, now in enumerate(t.tolist()):
            tracker.imu(now, force[k], rate[k])
            while frame < len(frame_t) and frame_t[frame] + 0.02 <= now:
                tracker.points(float(frame_t[frame]), body.names, seen[frame], cov)
                tracker.state(now)
                frame += 1
        shares.append((time.process_time() - begun) / length_s)
    share = float(np.median(shares))
    what = "10 points at 60 Hz, 20 ms late, inertial 400 Hz"
    return Metric("P13", what, f"{100.0 * share:.1f} % of a core", "real time", share, 0.2, at_least=False)
