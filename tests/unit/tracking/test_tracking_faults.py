"""Faults of the sources: each is named, and no estimate runs away without an alarm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import (
    AttitudeUnknown,
    BadArgument,
    DockingError,
    LeverArmWrong,
    PointsSwapped,
    ReferenceShifted,
    SensorFrozen,
    SensorSaturated,
    TimeJumped,
    TrackingLost,
)
from docking.tracking.grades import GRADES
from docking.tracking.inertial import InertialSettings, InertialTracker
from docking.tracking.inertial_core import Extras
from docking.tracking.recording import Recording
from docking.tracking.replay import Path, play, start_of
from docking.tracking.types import BodyModel
from docking.types import Array, Pose
from tests.unit.tracking.moving_body import record, section

BODY = section()
LENGTH_S = 7.0


def run(recording: Recording, hide_from_s: float = 1e9, **settings: object) -> tuple[list[DockingError], Path]:
    tracker = InertialTracker(
        recording.body,
        GRADES["mems"],
        start_of(recording),
        InertialSettings(**settings),  # type: ignore[arg-type]
    )
    alarms: list[DockingError] = []
    hide = np.where(recording.frame_t_s >= hide_from_s, 0, -1)
    return alarms, play(recording, tracker, hide, alarms.append)


def kinds(alarms: list[DockingError]) -> set[type[DockingError]]:
    return {type(alarm) for alarm in alarms}


def honest(path: Path, truth: Array) -> bool:
    """Whether every error of the second half is within what was predicted."""
    rows = path.t_s > 0.5 * LENGTH_S
    error = np.linalg.norm(path.points_W_mm[rows] - truth[path.frame[rows]], axis=2)
    return bool((error <= 4.0 * path.sd_mm[rows] + 1.0).all())


def test_a_clean_recording_raises_nothing() -> None:
    recording, truth, _ = record(BODY, LENGTH_S)
    alarms, path = run(recording)
    assert alarms == []
    assert honest(path, truth)


def test_swapped_points_are_named_and_not_used() -> None:
    recording, truth, _ = record(BODY, LENGTH_S)
    points = recording.points_W_mm.copy()
    late = recording.frame_t_s > 3.0
    points[np.ix_(late, [1, 6])] = points[np.ix_(late, [6, 1])]
    alarms, path = run(replace(recording, points_W_mm=points))
    assert kinds(alarms) == {PointsSwapped}
    assert "T2 with T7" in alarms[0].text()
    assert honest(path, truth)


def test_a_frozen_inertial_sensor_is_named_and_the_uncertainty_grows() -> None:
    recording, truth, _ = record(BODY, LENGTH_S)
    force, rate = recording.force_m_s2.copy(), recording.rate_rad_s.copy()
    stuck = recording.imu_t_s > 4.0
    first = int(np.argmax(stuck))
    force[stuck], rate[stuck] = force[first], rate[first]
    alarms, path = run(replace(recording, force_m_s2=force, rate_rad_s=rate), hide_from_s=5.0)
    assert SensorFrozen in kinds(alarms)
    assert honest(path, truth)
    assert path.sd_mm[-1].max() > 100.0


def test_a_frozen_camera_is_named_while_the_body_moves() -> None:
    recording, _, _ = record(BODY, LENGTH_S)
    points = recording.points_W_mm.copy()
    points[recording.frame_t_s > 4.0] = points[int(np.argmax(recording.frame_t_s > 4.0))]
    alarms, path = run(replace(recording, points_W_mm=points))
    assert SensorFrozen in kinds(alarms)
    assert any("points" in alarm.where for alarm in alarms)
    del path


@pytest.mark.parametrize("jump_s", [0.5, -0.4])
def test_a_jump_of_the_inertial_clock_is_named(jump_s: float) -> None:
    recording, truth, _ = record(BODY, LENGTH_S)
    t = recording.imu_t_s + np.where(recording.imu_t_s > 3.0, jump_s, 0.0)
    alarms, path = run(replace(recording, imu_t_s=t))
    assert TimeJumped in kinds(alarms)
    error = np.linalg.norm(path.points_W_mm - truth[path.frame], axis=2).max(axis=1)
    assert kinds(alarms) & {TrackingLost, ReferenceShifted} or float(error[path.t_s > 5.0].max()) < 100.0


def test_saturation_is_named_and_bridged_by_the_image() -> None:
    recording, truth, _ = record(BODY, LENGTH_S)
    force = recording.force_m_s2.copy()
    force[(recording.imu_t_s > 3.0) & (recording.imu_t_s < 3.1), 0] = GRADES["mems"].force_range
    alarms, path = run(replace(recording, force_m_s2=force))
    assert kinds(alarms) == {SensorSaturated}
    assert honest(path, truth)


def test_a_wrong_lever_arm_is_named() -> None:
    wrong = section(Pose(np.eye(3), np.array([0.0, 60.0, 0.0])))
    recording, _, _ = record(wrong, LENGTH_S, true_body=BODY)
    alarms, _ = run(recording, extras=Extras(lever_sd_mm=20.0))
    assert LeverArmWrong in kinds(alarms)
    right, _, _ = record(BODY, LENGTH_S)
    assert run(right, extras=Extras(lever_sd_mm=20.0))[0] == []


def test_a_moved_tracker_is_named() -> None:
    recording, _, _ = record(BODY, LENGTH_S)
    points = recording.points_W_mm + np.where(recording.frame_t_s > 4.0, 1.0, 0.0)[:, None, None] * [40.0, -25.0, 10.0]
    alarms, _ = run(replace(recording, points_W_mm=points))
    assert ReferenceShifted in kinds(alarms)
    shift = next(alarm for alarm in alarms if isinstance(alarm, ReferenceShifted))
    assert isinstance(shift.value, float)
    assert shift.value == pytest.approx(48.2, abs=8.0)
    assert TrackingLost in kinds(alarms)


def test_one_point_and_no_attitude_is_refused() -> None:
    body = BodyModel("P", ("P",), np.zeros((1, 3)))
    tracker = InertialTracker(body, GRADES["mems"])
    with pytest.raises(AttitudeUnknown):
        tracker.points(0.0, ("P",), np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(BadArgument):
        tracker.points(0.0, ("Q",), np.zeros((1, 3)), np.eye(3)[None])


def test_a_fault_that_stands_is_told_once_whatever_other_sources_do() -> None:
    """A moving camera says nothing about a frozen inertial sensor."""
    recording, _, _ = record(BODY, LENGTH_S)
    force, rate = recording.force_m_s2.copy(), recording.rate_rad_s.copy()
    stuck = recording.imu_t_s > 4.0
    force[stuck], rate[stuck] = force[np.argmax(stuck)], rate[np.argmax(stuck)]
    alarms, _ = run(replace(recording, force_m_s2=force, rate_rad_s=rate))
    assert [type(alarm) for alarm in alarms].count(SensorFrozen) == 1


def test_an_inertial_sensor_that_falls_silent_is_told_once_and_bridges_nothing() -> None:
    """Holding its last sample would carry the body away, and say that it knows where."""
    recording, truth, _ = record(BODY, LENGTH_S)
    here = recording.imu_t_s < 4.0
    cut = {key: getattr(recording, key)[here] for key in ("imu_t_s", "force_m_s2", "rate_rad_s")}
    alarms, path = run(replace(recording, **cut), hide_from_s=5.0)
    assert kinds(alarms) == {TimeJumped}
    assert len(alarms) == 1
    assert honest(path, truth)
    assert path.sd_mm[-1].max() > 100.0


def test_a_clock_that_stutters_is_told_once() -> None:
    recording, _, _ = record(BODY, LENGTH_S)
    rows = np.repeat(np.arange(len(recording.imu_t_s)), np.where(recording.imu_t_s > 3.0, 2, 1))
    twice = {key: getattr(recording, key)[rows] for key in ("imu_t_s", "force_m_s2", "rate_rad_s")}
    alarms, _ = run(replace(recording, **twice))
    assert [type(alarm) for alarm in alarms] == [TimeJumped]


def test_knocks_too_short_for_the_samples_make_less_certain_and_do_not_lose_the_body() -> None:
    """Twice a second one sample shows 60 m/s^2 of a shock that is over before the next: 0.3 m/s that nobody moved."""
    recording, truth, _ = record(BODY, LENGTH_S)
    force = recording.force_m_s2.copy()
    rows = np.arange(400, len(force), 100)
    force[rows] += 60.0 * np.random.default_rng(2).choice([-1.0, 1.0], (len(rows), 3))
    alarms, path = run(replace(recording, force_m_s2=force), hide_from_s=6.0)
    assert alarms == []
    assert honest(path, truth)
    calm = run(recording, hide_from_s=6.0)[1]
    assert path.sd_mm[-1].max() > 3.0 * calm.sd_mm[-1].max()
