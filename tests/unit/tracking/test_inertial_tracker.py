"""The 15-state navigation: late and mixed-up frames, honest covariance, time offset, lever arm, smoother, rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.tracking.follow import FollowSettings, follow
from docking.tracking.grades import GRADES
from docking.tracking.inertial import InertialSettings, InertialTracker
from docking.tracking.inertial_core import Extras
from docking.tracking.recording import Gap
from docking.tracking.replay import every, hidden, judged, play, smoothed_path, start_of
from docking.tracking.smoothing import Tape
from docking.tracking.time_offset import find_time_offset
from docking.tracking.types import BodyModel, TrackedState, Tracker
from docking.types import Array, Pose
from tests.unit.tracking.moving_body import record, section

POINT = BodyModel("P", ("P",), np.zeros((1, 3)))
MOUNT = Pose(Rotation.from_euler("xyz", [0.4, -0.2, 2.0]).as_matrix(), np.array([150.0, -80.0, 60.0]))


def test_late_and_swapped_frames_end_where_frames_in_order_do() -> None:
    recording, _, _ = record(section(MOUNT), 4.0, imu_hz=170.0, frame_hz=37.0)
    r = recording

    def push(tracker: Tracker, m: int) -> None:
        names = r.body.names if m % 5 else r.body.names[:2]
        k = len(names)
        tracker.points(float(r.frame_t_s[m]), names, r.points_W_mm[m, :k], np.tile(np.eye(3), (k, 1, 1)))

    def run(delays: Array) -> TrackedState:
        tracker = InertialTracker(r.body, GRADES["mems"], start_of(r))
        arrivals = sorted(range(len(delays)), key=lambda m: r.frame_t_s[m] + delays[m])
        push(tracker, arrivals.pop(0))
        for k, t in enumerate(r.imu_t_s.tolist()):
            while arrivals and r.frame_t_s[arrivals[0]] + delays[arrivals[0]] <= t:
                push(tracker, arrivals.pop(0))
            tracker.imu(t, r.force_m_s2[k], r.rate_rad_s[k])
        assert not arrivals
        assert tracker.dropped <= 1
        state = tracker.state(float(r.imu_t_s[-1]))
        assert state is not None
        return state

    count = int(np.searchsorted(r.frame_t_s, 3.6))
    rng = np.random.default_rng(1)
    late = np.where(np.arange(count) == 0, 0.0, rng.uniform(0.0, 0.15, count))
    a, b = run(np.zeros(count)), run(late)
    assert b.points_W_mm == pytest.approx(a.points_W_mm, abs=0.05)
    assert b.cov == pytest.approx(a.cov, rel=0.02, abs=1e-9)


@pytest.mark.parametrize(("grade", "share"), [("tactical", 0.99), ("mems", 0.8)])
def test_gaps_of_three_seconds_end_within_two_centimetres(grade: str, share: float) -> None:
    """The study's figures with few runs: share of gaps, and measured against predicted sd."""
    end, sd = [], []
    for seed in (11, 12):
        recording, truth, _ = record(POINT, 31.0, grade, seed)
        gaps = every(recording, 10.0, 3.0)
        hide = hidden(recording, gaps)
        tilt = GRADES[grade].force_bias / 9.8
        tracker = InertialTracker(POINT, GRADES[grade], start_of(recording, tilt, 0.01))
        for gap in judged(replace(recording, points_W_mm=truth), play(recording, tracker, hide), gaps, hide):
            end.append(gap.end_error_mm)
            sd.append(gap.predicted_sd_mm)
            assert gap.hold_last_mm > 4.0 * gap.end_error_mm or gap.hold_last_mm < 60.0
    assert np.mean(np.array(end) <= 20.0) >= share - 0.2  # six gaps
    ratio = np.sqrt(np.mean(np.square(end)) / np.mean(np.square(sd)))
    assert 0.65 <= ratio <= 1.35


def test_many_points_show_attitude_and_bridge_a_gap_without_a_stated_start() -> None:
    body = section(MOUNT)
    recording, truth, motion = record(body, 11.0, "mems", 21)
    blank = replace(recording, attitude_WB=np.full_like(recording.attitude_WB, np.nan))
    hide = hidden(blank, [Gap(8.0, 2.0)])
    tracker = InertialTracker(body, GRADES["mems"])
    path = play(blank, tracker, hide)
    results = judged(replace(blank, points_W_mm=truth), path, [Gap(8.0, 2.0)], hide)
    assert results[0].end_error_mm < 15.0
    state = tracker.state()
    assert state is not None
    R = motion.turn(np.array([state.t_s])).as_matrix()[0]
    turn = Rotation.from_matrix(state.X_WB.R @ R.T).as_rotvec()
    com = motion.points(np.array([state.t_s]), body.com_B_mm[None])[0, 0]
    error = np.concatenate([turn, state.com_W_mm - com])
    assert error @ np.linalg.solve(state.cov, error) < 25.0
    assert np.linalg.norm(state.com_W_mm - com) < 3.0
    assert np.linalg.norm(turn) < 3e-3


def test_a_late_sensor_is_found_before_and_in_the_filter() -> None:
    for late in (0.007, -0.06):
        recording, _, _ = record(POINT, 14.0, "mems", 5, late_s=late, imu_hz=285.7, frame_hz=47.6)
        unknown = np.full_like(recording.attitude_WB, np.nan)
        assert find_time_offset(recording).late_s == pytest.approx(late, abs=0.0003)
        answer = follow(recording, [], FollowSettings("ins", GRADES["mems"]))
        assert answer.time_offset_s == pytest.approx(late, abs=0.0007)
    assert find_time_offset(replace(recording, attitude_WB=unknown)).late_s == pytest.approx(late, abs=0.001)
    still = replace(recording, points_W_mm=recording.points_W_mm[:1] + 0.0 * recording.points_W_mm, attitude_WB=unknown)
    assert find_time_offset(still).late_s == 0.0


def test_the_state_is_where_the_body_is_although_the_stamps_are_late() -> None:
    """The lag found within the filter is no error of the state, for points far from the sensor too."""
    body = section(MOUNT)
    recording, truth, _ = record(body, 9.0, "mems", 14, late_s=0.008)
    assert find_time_offset(recording).late_s == pytest.approx(0.008, abs=0.003)
    settings = InertialSettings(extras=Extras(time_sd_s=0.01))
    path = play(recording, InertialTracker(body, GRADES["mems"], None, settings), np.full(len(truth), -1))
    late = path.t_s > 5.0
    error = np.linalg.norm(path.points_W_mm[late] - truth[path.frame[late]], axis=2)
    assert float(np.sqrt(np.mean(error**2))) < 0.8


def test_a_lever_arm_is_estimated() -> None:
    real = BodyModel("P", ("P",), np.array([[80.0, -50.0, 30.0]]))
    recording, _, _ = record(POINT, 25.0, "mems", 6, true_body=real)
    settings = InertialSettings(extras=Extras(lever_sd_mm=100.0), lever_limit_mm=float("inf"))
    tracker = InertialTracker(POINT, GRADES["mems"], start_of(recording), settings)
    play(recording, tracker, np.full(len(recording.frame_t_s), -1))
    navigation = tracker.navigation()
    assert navigation is not None
    assert navigation.lever_mm == pytest.approx(real.points_B_mm[0], abs=4.0)


def test_the_smoother_knows_what_came_after_the_gap() -> None:
    recording, truth, _ = record(POINT, 21.0, "mems", 7)
    gaps = [*every(recording, 10.0, 3.0)[:1], Gap(15.0, 3.0)]
    hide = hidden(recording, gaps)
    tracker = InertialTracker(POINT, GRADES["mems"], start_of(recording), tape=Tape())
    causal = play(recording, tracker, hide)
    known = replace(recording, points_W_mm=truth)
    before = judged(known, causal, gaps, hide)
    after = judged(known, smoothed_path(recording, tracker, causal), gaps, hide)
    assert np.mean([g.max_error_mm for g in after]) <= 0.25 * np.mean([g.max_error_mm for g in before])
    assert all(g.max_error_mm < 6.0 for g in after)


def test_the_smoother_says_how_far_off_it_is() -> None:
    """In gaps its error in units of its own sd has the size of one; later data make no state less certain."""
    off, filtered, smooth = [], [], []
    for seed in (7, 17, 27):
        recording, truth, _ = record(POINT, 21.0, "mems", seed)
        gaps = [Gap(7.0, 3.0), Gap(15.0, 3.0)]
        hide = hidden(recording, gaps)
        tracker = InertialTracker(POINT, GRADES["mems"], start_of(recording), tape=Tape())
        causal = play(recording, tracker, hide)
        path = smoothed_path(recording, tracker, causal)
        blind = hide[path.frame] >= 0
        error = np.linalg.norm(path.points_W_mm[blind] - truth[path.frame[blind]], axis=2)
        off.append(error / path.sd_mm[blind])
        filtered.append(causal.sd_mm[blind])
        smooth.append(path.sd_mm[blind])
    assert np.all(np.concatenate(smooth) <= 1.001 * np.concatenate(filtered))
    assert np.concatenate(smooth).max() < 0.25 * np.concatenate(filtered).max()
    assert 0.5 <= float(np.sqrt(np.mean(np.concatenate(off) ** 2))) <= 1.5  # six gaps, two bends of the error in each


def test_rest_is_held_and_creeping_is_not_taken_for_rest_when_said_so() -> None:
    recording, truth, _ = record(POINT, 14.0, "mems", 8)
    t = recording.imu_t_s
    rng, m = np.random.default_rng(3), GRADES["mems"]
    R = recording.attitude_WB[0]
    noise = [rng.normal(0.0, d * np.sqrt(200.0), (len(t), 3)) for d in (m.force_density, m.rate_density)]
    place = np.zeros_like(truth)
    at_rest = replace(
        recording, force_m_s2=R.T @ [0.0, 0.0, 9.80665] + noise[0] + 0.01, rate_rad_s=noise[1] + 2e-4,
        points_W_mm=place + rng.normal(0.0, 1.0, place.shape), attitude_WB=np.tile(R, (len(place), 1, 1)),
    )  # fmt: skip
    gap = [Gap(10.0, 3.0)]

    def end(source: object, shown: Array, **options: bool) -> float:
        hide = hidden(at_rest, gap)
        used = replace(at_rest, points_W_mm=shown + rng.normal(0.0, 1.0, shown.shape))
        answer = follow(used, gap, FollowSettings("ins", m, time_offset=False, extras=Extras(), **options))
        return judged(replace(used, points_W_mm=shown), answer.path, gap, hide)[0].end_error_mm

    assert end(at_rest, place) < 1.0
    assert follow(at_rest, [], FollowSettings("ins", m)).time_offset_s == 0.0  # at rest no lag shows
    creeping = place + np.array([8.0, 0.0, 0.0]) * at_rest.frame_t_s[:, None, None]
    assert end(at_rest, creeping, rest=False) < 12.0


def test_the_lag_that_was_found_is_taken_off_before_the_gap_is_bridged() -> None:
    """Left on, 60 ms would be some ten centimetres a metre a second; on the wrong side, twice that."""
    recording, truth, _ = record(POINT, 9.0, "mems", 5, late_s=-0.06)
    gap = [Gap(6.5, 2.0)]
    answer = follow(recording, gap, FollowSettings("ins", GRADES["mems"], extras=Extras()))
    known = replace(answer.recording, points_W_mm=truth)
    (end,) = judged(known, answer.path, gap, hidden(known, gap))
    assert end.end_error_mm < 25.0
    assert answer.alarms == []
    assert answer.recording.imu_t_s[0] == pytest.approx(0.06, abs=0.001)


def test_a_lag_beyond_what_was_looked_for_is_none_that_was_found() -> None:
    recording, _, _ = record(POINT, 9.0, "mems", 5, late_s=0.45)
    assert find_time_offset(recording).late_s == 0.0
    assert find_time_offset(recording, reach_s=0.6).late_s == pytest.approx(0.45, abs=0.002)
