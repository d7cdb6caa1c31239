"""A real sensor in a real hand (BROAD): ratios between the methods, since nobody knows the sensor's errors.

CI takes the first part of the slow translation; `--full` takes all three trials whole.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.recordings import read_recording
from docking.tracking.choice import choose
from docking.tracking.follow import FollowSettings, follow, make_tracker
from docking.tracking.grades import GRADES
from docking.tracking.inertial import InertialTracker
from docking.tracking.recording import Recording
from docking.tracking.replay import GapResult, every, hidden, judged, play, smoothed_path, start_of
from docking.tracking.time_offset import find_time_offset
from tests.support.shared_data import shared_data
from tests.unit.tracking import independent_pair

FOLDER = shared_data("broad")
TRANSLATION, ROTATION, TAPPING = (
    "10_undisturbed_slow_translation_A",
    "03_undisturbed_slow_rotation_C",
    "24_disturbed_tapping_A",
)
GRADE = GRADES["consumer"]
SAMPLE_S = 7 / 2000.0


def trial(name: str, length_s: float = 1e9) -> Recording:
    """A trial up to `length_s`, the lag of its inertial stamps taken off."""
    whole = read_recording([FOLDER / f"{name}.mat"])
    rows = whole.frame_t_s <= length_s
    names = ("frame_t_s", "points_W_mm", "sigma_mm", "attitude_WB", "moving")
    cut = replace(whole, **{key: getattr(whole, key)[rows] for key in names})
    return replace(cut, imu_t_s=cut.imu_t_s - find_time_offset(whole).late_s)


def median(results: list[GapResult], key: str, moving: bool = True) -> float:
    return float(np.median([getattr(g, key) for g in results if g.moving is moving]))


def by(recording: Recording, method: str) -> list[GapResult]:
    gaps = every(recording, 10.0, 3.0)
    hide = hidden(recording, gaps)
    tracker = make_tracker(recording, method, FollowSettings(method))
    return judged(recording, play(recording, tracker, hide), gaps, hide)


def independent(recording: Recording) -> float:
    """Median end error in motion of the independent repaired pair."""
    r, gaps = recording, every(recording, 10.0, 3.0)
    hide = hidden(r, gaps)
    begin = int(np.argmax(np.isfinite(r.attitude_WB).all(axis=(1, 2))))
    samples = slice(int(np.searchsorted(r.imu_t_s, r.frame_t_s[begin])) - 1, None)
    t, force, rate = r.imu_t_s[samples], r.force_m_s2[samples], r.rate_rad_s[samples]
    quiet = independent_pair.quiet_samples(t, rate, force, (GRADE.force_density, GRADE.rate_density))
    R = independent_pair.attitudes(t, rate, force, r.attitude_WB[begin], quiet)
    walk = (1000.0 * GRADE.force_walk) ** 2 + 9806.65**2 * (GRADE.rate_density**2 + 0.1 * GRADE.rate_bias**2)
    image = r.points_W_mm[begin:, 0]
    lost = ~np.isfinite(image).all(axis=1)
    noise = (1.0, 1000.0 * GRADE.force_density, walk)
    path = independent_pair.repaired(t, force, R, r.frame_t_s[begin:], image, (hide[begin:] >= 0) | lost, noise)
    error = np.linalg.norm(path - image, axis=1)
    ends = [np.flatnonzero((hide[begin:] == k) & ~lost) for k in range(len(gaps))]
    return float(np.median([error[e[-1]] for e in ends if len(e) and r.moving[begin + e].max() > 0.0]))


@pytest.mark.parametrize(
    ("name", "length_s"),
    [
        (TRANSLATION, 62.0),
        *(pytest.param(n, 1e9, marks=pytest.mark.full) for n in (TRANSLATION, ROTATION, TAPPING)),
    ],
)
def test_navigation_pair_and_smoother(name: str, length_s: float) -> None:
    recording = trial(name, length_s)
    gaps = every(recording, 10.0, 3.0)
    hide = hidden(recording, gaps)
    settings = FollowSettings()
    tracker = make_tracker(recording, "ins-smoothed", settings)
    assert isinstance(tracker, InertialTracker)
    causal = play(recording, tracker, hide)
    ins = judged(recording, causal, gaps, hide)
    smooth = judged(recording, smoothed_path(recording, tracker, causal), gaps, hide)
    pair = by(recording, "repaired")
    figures = {
        "ins": median(ins, "end_error_mm"),
        "pair": median(pair, "end_error_mm"),
        "independent pair": independent(recording),
        "hold": median(ins, "hold_last_mm"),
        "rest": median(ins, "end_error_mm", moving=False),
        "smoother": median(smooth, "max_error_mm") / median(ins, "max_error_mm"),
    }
    print(name, {key: round(value, 3) for key, value in figures.items()})
    assert figures["rest"] <= 1.0
    assert figures["pair"] == pytest.approx(figures["independent pair"], rel=0.3)
    if name == TRANSLATION:
        assert figures["ins"] <= 0.5 * figures["pair"]
        assert figures["ins"] <= 0.25 * figures["hold"]
        assert figures["smoother"] <= 0.15


@pytest.mark.parametrize("name", [TRANSLATION, ROTATION, TAPPING])
def test_the_sensor_is_late_by_more_than_a_sample(name: str) -> None:
    """The three trials agree on 1.2 samples by the turning rate, knocks included, whatever is put on top."""
    recording = read_recording([FOLDER / f"{name}.mat"])
    found = find_time_offset(recording)
    assert found.correlation > 0.999
    assert found.late_s == pytest.approx(1.18 * SAMPLE_S, abs=0.1 * SAMPLE_S)
    later = replace(recording, imu_t_s=recording.imu_t_s + 0.1)
    assert find_time_offset(later).late_s == pytest.approx(found.late_s + 0.1, abs=1e-4)


def test_auto_takes_the_coupled_form_and_says_why() -> None:
    recording = trial(TRANSLATION, 40.0)
    chosen = choose(recording, GRADE, 3.0)
    assert chosen.method == "ins"
    assert chosen.coupled_sd_mm < 0.9 * chosen.decoupled_sd_mm
    answer = follow(replace(recording, imu_t_s=recording.imu_t_s), [], FollowSettings("auto", time_offset=False))
    assert answer.as_json()["choice"]["method"] == answer.method == "ins"
    assert start_of(recording) is not None
