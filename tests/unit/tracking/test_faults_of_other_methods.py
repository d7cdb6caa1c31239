"""Faults of the sources where encoders or the decoupled pairs follow: each is named, and what is told stays honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.errors import (
    DockingError,
    PointsSwapped,
    ReferenceShifted,
    SensorFrozen,
    TimeJumped,
    TrackingLost,
)
from docking.tracking.encoders import EncoderTracker
from docking.tracking.follow import FollowSettings, make_tracker
from docking.tracking.grades import GRADES
from docking.tracking.recording import Recording
from docking.tracking.replay import Path, play
from docking.types import Array
from sim.inertial_motion import Motion
from tests.unit.tracking.moving_body import record, section

BODY, SMALL = section(), section(points=5)
BEGIN_S, LENGTH_S, SIGMA_MM = 4.0, 8.0, 0.1
LEFT_MM = {"published": 100.0, "repaired": 15.0}
"""How far off two points may be after a second without image."""
MOVED = np.array([40.0, -25.0, 10.0])


def docking(speed_mm_s: float = 8.0) -> tuple[Recording, Array]:
    """A straight approach: frames at 20 Hz, read-backs at 100 Hz 3 mm off, a thousandth too long, with 0.01 mm noise;
    and the true places (M, n, 3)."""
    rng = np.random.default_rng(5)
    t, frame_t = np.arange(0.0, LENGTH_S, 0.01), 0.003 + np.arange(0.0, LENGTH_S - 0.05, 0.05)
    way = np.array([speed_mm_s, -0.3 * speed_mm_s, 0.0])
    truth = BODY.points_B_mm + (way * frame_t[:, None])[:, None]
    shift = 1.001 * way * t[:, None] + [3.0, -2.0, 1.0]
    return Recording(
        "docking", BODY, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), frame_t,
        truth + rng.normal(0.0, SIGMA_MM, truth.shape), np.full(truth.shape, SIGMA_MM),
        np.full((len(frame_t), 3, 3), np.nan), t, np.tile(np.eye(3), (len(t), 1, 1)),
        shift + (rng.normal(0.0, 0.01, shift.shape) if speed_mm_s else 0.0), np.full(len(frame_t), np.nan),
    ), truth  # fmt: skip


def followed(recording: Recording, hide_from_s: float = 1e9) -> tuple[list[DockingError], Path]:
    alarms: list[DockingError] = []
    hide = np.where(recording.frame_t_s >= hide_from_s, 0, -1)
    return alarms, play(recording, EncoderTracker(recording.body), hide, alarms.append)


def kinds(alarms: list[DockingError]) -> set[type[DockingError]]:
    return {type(alarm) for alarm in alarms}


def honest(path: Path, truth: Array, from_s: float = 0.0) -> bool:
    """Whether every error is within four times what was predicted."""
    rows = path.t_s >= from_s
    error = np.linalg.norm(path.points_W_mm[rows] - truth[path.frame[rows]], axis=2)
    return bool((error <= 4.0 * path.sd_mm[rows] + 0.05).all())


def late(recording: Recording) -> NDArray[np.bool_]:
    return np.asarray(recording.frame_t_s > BEGIN_S)


def swap(recording: Recording) -> Recording:
    points = recording.points_W_mm.copy()
    points[np.ix_(late(recording), [1, 4])] = points[np.ix_(late(recording), [4, 1])]
    return replace(recording, points_W_mm=points)


def repeat(recording: Recording) -> Recording:
    """The camera gives one frame again and again."""
    points = recording.points_W_mm.copy()
    points[late(recording)] = points[np.argmax(late(recording))]
    return replace(recording, points_W_mm=points)


def move(recording: Recording) -> Recording:
    moved = recording.points_W_mm + np.where(late(recording), 1.0, 0.0)[:, None, None] * MOVED
    return replace(recording, points_W_mm=moved)


@pytest.mark.parametrize("speed_mm_s", [8.0, 0.0])
def test_sound_encoders_and_camera_raise_nothing(speed_mm_s: float) -> None:
    recording, truth = docking(speed_mm_s)
    alarms, path = followed(recording, 6.0)
    assert alarms == []
    assert honest(path, truth, 1.0)
    assert path.sd_mm[-1].max() < 0.1


def test_swapped_points_do_not_turn_the_body() -> None:
    recording, truth = docking()
    alarms, path = followed(swap(recording))
    assert kinds(alarms) == {PointsSwapped}
    assert "T2 with T5" in alarms[0].text()
    assert honest(path, truth, 1.0)


def test_a_camera_that_repeats_itself_is_named_and_bridged() -> None:
    recording, truth = docking()
    alarms, path = followed(repeat(recording))
    assert [(type(alarm), alarm.where) for alarm in alarms] == [(SensorFrozen, "box points")]
    error = np.linalg.norm(path.points_W_mm - truth[path.frame], axis=2)
    assert error[path.t_s > BEGIN_S].max() < 0.25


@pytest.mark.parametrize("speed_mm_s", [8.0, 0.0])
def test_a_moved_tracker_is_named_whether_the_axes_move_or_stand(speed_mm_s: float) -> None:
    recording, truth = docking(speed_mm_s)
    alarms, path = followed(move(recording))
    assert [type(alarm) for alarm in alarms] == [ReferenceShifted, TrackingLost]
    assert alarms[0].value == pytest.approx(float(np.linalg.norm(MOVED)), abs=0.5)
    assert honest(path, truth + MOVED, BEGIN_S + 1.2)  # begun anew where the points are seen


@pytest.mark.parametrize("speed_mm_s", [8.0, 2.0, 0.5])
def test_encoders_that_stand_still_while_the_body_moves_are_named_and_not_believed(speed_mm_s: float) -> None:
    recording, truth = docking(speed_mm_s)
    place = recording.encoder_t_mm.copy()
    stuck = recording.encoder_t_s > BEGIN_S
    place[stuck] = place[np.argmax(stuck)]
    alarms, path = followed(replace(recording, encoder_t_mm=place), hide_from_s=6.5)
    assert (SensorFrozen, "box encoders") in [(type(alarm), alarm.where) for alarm in alarms]
    assert ReferenceShifted not in kinds(alarms)
    assert honest(path, truth, 6.45)
    assert path.sd_mm[-1].max() > 15.0


def test_encoders_that_come_back_are_believed_again() -> None:
    recording, truth = docking()
    place = recording.encoder_t_mm.copy()
    stuck = (recording.encoder_t_s > BEGIN_S) & (recording.encoder_t_s < 5.5)
    place[stuck] = place[np.argmax(stuck)]
    alarms, path = followed(replace(recording, encoder_t_mm=place), hide_from_s=6.5)
    assert [(type(alarm), alarm.where) for alarm in alarms] == [(SensorFrozen, "box encoders")]
    assert honest(path, truth, 5.6)
    assert path.sd_mm[-1].max() < 0.5


@pytest.mark.parametrize("jump_s", [0.5, -0.5])
def test_a_jump_of_the_read_backs_clock_is_named(jump_s: float) -> None:
    recording, _ = docking()
    t = recording.encoder_t_s + np.where(recording.encoder_t_s > BEGIN_S, jump_s, 0.0)
    alarms, _ = followed(replace(recording, encoder_t_s=t))
    assert TimeJumped in kinds(alarms)
    assert next(a for a in alarms if isinstance(a, TimeJumped)).where == "box encoders"


def test_read_backs_twice_a_second_are_no_jumps() -> None:
    recording, _ = docking()
    names = ("encoder_t_s", "encoder_R", "encoder_t_mm")
    slow = replace(recording, **{name: getattr(recording, name)[::50] for name in names})
    assert TimeJumped not in kinds(followed(slow)[0])


def test_read_backs_that_end_bridge_nothing() -> None:
    recording, truth = docking()
    here = recording.encoder_t_s < BEGIN_S
    cut = replace(
        recording,
        encoder_t_s=recording.encoder_t_s[here],
        encoder_R=recording.encoder_R[here],
        encoder_t_mm=recording.encoder_t_mm[here],
    )
    alarms, path = followed(cut, hide_from_s=5.0)
    assert [(type(alarm), alarm.where) for alarm in alarms] == [(TimeJumped, "box encoders")]
    assert honest(path, truth, 1.0)
    assert path.sd_mm[-1].max() > 15.0


def paired(recording: Recording, method: str, hide_from_s: float = 1e9) -> tuple[list[DockingError], Path]:
    alarms: list[DockingError] = []
    hide = np.where(recording.frame_t_s >= hide_from_s, 0, -1)
    tracker = make_tracker(recording, method, FollowSettings(method, GRADES["mems"]))
    return alarms, play(recording, tracker, hide, alarms.append)


@pytest.mark.parametrize("method", ["published", "repaired"])
def test_the_pairs_name_what_is_wrong_with_the_points(method: str) -> None:
    recording, truth, _ = record(SMALL, 5.4, frame_hz=25.0)
    alarms, sound = paired(recording, method)
    assert alarms == []
    alarms, path = paired(swap(recording), method)
    assert kinds(alarms) == {PointsSwapped}
    assert "T2 with T5" in alarms[0].text()
    error, usual = (np.linalg.norm(p.points_W_mm - truth[p.frame], axis=2) for p in (path, sound))
    others = [0, 2, 3]
    assert error[:, others].max() < 1.3 * usual[:, others].max()
    ends = np.flatnonzero(path.t_s < BEGIN_S + 1.0)[-1]
    assert error[ends, [1, 4]].max() < LEFT_MM[method]  # they were taken for each other across a metre and more
    alarms, path = paired(repeat(recording), method)
    assert [(type(alarm), alarm.where) for alarm in alarms] == [(SensorFrozen, "box points")]
    assert not path.states[-1].seen.any()


@pytest.mark.parametrize("method", ["published", "repaired"])
def test_a_step_is_the_trackers_and_a_frame_that_errs_is_not(method: str) -> None:
    recording, _, _ = record(SMALL, 5.4, frame_hz=25.0)
    alarms, _ = paired(move(recording), method)
    assert kinds(alarms) == {ReferenceShifted}
    assert alarms[0].value == pytest.approx(float(np.linalg.norm(MOVED)), abs=3.0)
    points = recording.points_W_mm.copy()
    points[100] += MOVED
    assert paired(replace(recording, points_W_mm=points), method)[0] == []


@pytest.mark.parametrize("method", ["published", "repaired"])
def test_the_pairs_tell_a_sensor_that_falls_silent(method: str) -> None:
    recording, truth, _ = record(SMALL, 5.4, frame_hz=25.0)
    here = recording.imu_t_s < 3.0
    cut = {key: getattr(recording, key)[here] for key in ("imu_t_s", "force_m_s2", "rate_rad_s")}
    alarms, path = paired(replace(recording, **cut), method, hide_from_s=BEGIN_S)
    assert [(type(alarm), alarm.where) for alarm in alarms] == [(TimeJumped, "box inertial sensor")]
    assert honest(path, truth, BEGIN_S)


def test_a_quick_move_that_the_sensor_feels_is_no_step_of_the_tracker() -> None:
    """20 mm within 30 ms, between two frames."""

    def place(t_s: Array) -> Array:
        s = np.clip((np.asarray(t_s) - 2.0063) / 0.03, 0.0, 1.0)
        return np.asarray((20.0 * s**3 * (10.0 - 15.0 * s + 6.0 * s * s))[:, None] * np.array([1.0, 0.0, 0.0]))

    motion = Motion(place, lambda t: Rotation.from_matrix(np.tile(np.eye(3), (len(t), 1, 1))))
    recording, _, _ = record(SMALL, 3.0, frame_hz=25.0, imu_hz=400.0, motion=motion)
    assert paired(recording, "repaired")[0] == []
    still = replace(recording, force_m_s2=np.tile(recording.force_m_s2.mean(axis=0), (len(recording.imu_t_s), 1)))
    assert kinds(paired(still, "repaired")[0]) == {ReferenceShifted}
