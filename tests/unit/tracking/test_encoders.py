"""Gaps bridged by encoders: offset, scale and noise of the read-backs against what the image showed before."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from docking.study.tracking import CASES, run
from docking.tracking.encoders import EncoderTracker
from docking.types import Pose
from tests.unit.tracking.moving_body import section


@pytest.mark.parametrize(
    ("seeds", "most_mm", "ratios"),
    [((1,), 0.08, (0.5, 1.6)), pytest.param(range(8), 0.06, (0.8, 1.2), marks=pytest.mark.full)],
)
def test_docking_motion_is_bridged_to_hundredths(
    seeds: Iterable[int], most_mm: float, ratios: tuple[float, float]
) -> None:
    case = next(c for c in CASES if c.methods == ("encoders",))
    gaps = np.array([gap for seed in seeds for gap in run(case, seed)["encoders"]])
    error, _, hold, rms_error, rms_sd = gaps.T
    assert np.median(error) <= most_mm
    assert np.median(error) < 0.02 * np.median(hold)
    assert ratios[0] <= np.sqrt(np.mean(rms_error**2) / np.mean(rms_sd**2)) <= ratios[1]


def test_offset_and_scale_are_learnt() -> None:
    """Exact image, encoders 5 mm off and a thousandth too long: afterwards 300 mm on without image."""
    body = section()
    tracker, rng = EncoderTracker(body), np.random.default_rng(2)
    eye = np.eye(3)
    for k in range(1200):
        t = 0.01 * k
        way = np.array([30.0 * t, 0.0, 0.0])
        tracker.encoders(t, Pose(eye, 1.001 * way + np.array([5.0, -3.0, 2.0])))
        if k % 2 == 0 and t < 10.0:
            noise = rng.normal(0.0, 0.1, (8, 3))
            tracker.points(t, body.names, body.points_B_mm + way + noise, np.tile(0.01 * eye, (8, 1, 1)))
    state = tracker.state()
    assert state is not None
    assert state.source == "image" or state.blind_s > 1.0
    assert np.abs(state.points_W_mm - body.points_B_mm - way).max() < 0.15
    assert state.predicted_sd_mm < 0.2
