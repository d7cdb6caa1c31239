"""The published and the repaired pair: against an independent script, and what the repair mends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.tracking.follow import FollowSettings, make_tracker
from docking.tracking.grades import GRADES
from docking.tracking.recording import Recording
from docking.tracking.replay import every, hidden, judged, play
from docking.tracking.types import BodyModel
from docking.types import Array
from sim.inertial_motion import Motion, multi_sine
from tests.unit.tracking import independent_pair
from tests.unit.tracking.moving_body import record

POINT = BodyModel("P", ("P",), np.zeros((1, 3)))


def median_end_mm(recording: Recording, truth: Array, method: str, grade: str) -> float:
    gaps = every(recording, 10.0, 3.0)
    hide = hidden(recording, gaps)
    settings = FollowSettings(method, GRADES[grade])
    path = play(recording, make_tracker(recording, method, settings, 0.003), hide)
    results = judged(replace(recording, points_W_mm=truth), path, gaps, hide)
    return float(np.median([g.end_error_mm for g in results]))


def independent_end_mm(recording: Recording, truth: Array, grade: str) -> float:
    m, r = GRADES[grade], recording
    quiet = independent_pair.quiet_samples(r.imu_t_s, r.rate_rad_s, r.force_m_s2, (m.force_density, m.rate_density))
    R = independent_pair.attitudes(r.imu_t_s, r.rate_rad_s, r.force_m_s2, r.attitude_WB[0], quiet)
    gaps = every(r, 10.0, 3.0)
    hide = hidden(r, gaps)
    walk = (1000.0 * m.force_walk) ** 2 + 9806.65**2 * (m.rate_density**2 + 0.1 * m.rate_bias**2)
    noise = (float(r.sigma_mm.flat[0]), 1000.0 * m.force_density, walk)
    path = independent_pair.repaired(r.imu_t_s, r.force_m_s2, R, r.frame_t_s, r.points_W_mm[:, 0], hide >= 0, noise)
    ends = [np.flatnonzero(hide == k)[-1] for k in range(len(gaps))]
    return float(np.median(np.linalg.norm(path[ends] - truth[ends, 0], axis=1)))


@pytest.mark.parametrize(
    ("grade", "seeds"),
    [("mems", (1,)), *(pytest.param(g, (1, 2, 3), marks=pytest.mark.full) for g in ("tactical", "mems"))],
)
def test_repaired_pair_is_as_good_as_an_independent_one(grade: str, seeds: tuple[int, ...]) -> None:
    ours, theirs = [], []
    for seed in seeds:
        recording, truth, _ = record(POINT, 31.0, grade, seed)
        ours.append(median_end_mm(recording, truth, "repaired", grade))
        theirs.append(independent_end_mm(recording, truth, grade))
    assert np.mean(ours) == pytest.approx(np.mean(theirs), rel=0.3)
    assert np.mean(ours) < {"tactical": 60.0, "mems": 200.0}[grade]


def _upright(seed: int) -> Motion:
    """Waving without turning: what the printed models are made for."""
    waving = multi_sine(np.random.default_rng(seed))
    return Motion(waving.place, lambda t: Rotation.from_matrix(np.tile(np.eye(3), (len(t), 1, 1))))


def test_published_filters_hold_where_their_models_do() -> None:
    """Bias only, exact start from rest, true attitude: centimetres; and the bias is that of the independent script."""
    recording, truth, _ = record(POINT, 12.0, "tactical", 3, motion=_upright(3))
    calm = replace(recording, rate_rad_s=np.zeros_like(recording.rate_rad_s) + 1e-12 * recording.rate_rad_s,
                   attitude_WB=np.tile(np.eye(3), (len(truth), 1, 1)))  # fmt: skip
    assert median_end_mm(calm, truth, "published", "tactical") < 15.0
    acc = 1000.0 * calm.force_m_s2 + independent_pair.G
    theirs = independent_pair.bias_only(calm.imu_t_s, acc, calm.frame_t_s, calm.points_W_mm[:, 0], 1.0)
    tracker = make_tracker(calm, "published", FollowSettings("published", GRADES["tactical"]))
    play(calm, tracker, np.full(len(truth), -1))
    assert tracker._bias.b == pytest.approx(theirs, abs=0.2)  # type: ignore[attr-defined]
    assert np.abs(theirs).max() > 1.0


def test_a_wrong_start_velocity_breaks_the_printed_pair_and_not_the_repaired_one() -> None:
    motion = multi_sine(np.random.default_rng(9))
    late = Motion(lambda t: motion.place(np.asarray(t) + 6.0), lambda t: motion.turn(np.asarray(t) + 6.0))
    recording, truth, _ = record(POINT, 21.0, "tactical", 9, motion=late)
    printed = median_end_mm(recording, truth, "published", "tactical")
    assert median_end_mm(recording, truth, "repaired", "tactical") < 0.3 * printed


@pytest.mark.parametrize("method", ["published", "repaired"])
def test_pairs_tell_the_tilt_that_their_models_leave_out(method: str) -> None:
    """What they predict at the end of a gap is of the size of what happens, not a fraction of it."""
    recording, truth, _ = record(POINT, 31.0, "mems", 4)
    gaps = every(recording, 10.0, 3.0)
    hide = hidden(recording, gaps)
    tracker = make_tracker(recording, method, FollowSettings(method, GRADES["mems"]), 0.003)
    results = judged(replace(recording, points_W_mm=truth), play(recording, tracker, hide), gaps, hide)
    error, sd = (np.sqrt(np.mean([getattr(g, k) ** 2 for g in results])) for k in ("end_error_mm", "predicted_sd_mm"))
    assert 0.4 < error / sd < 2.0
