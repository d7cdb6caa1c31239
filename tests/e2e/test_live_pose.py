"""The part followed in the moves of a docking: what the encoders do not see stops the move, a lost view does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.state import State
from tests.support.rigid_figure import path_gap_mm
from tests.support.tracked_cell import TrackedCell, run_tracked

X_AXES = ("A.X", "B.X", "C.X", "D.X")


def at(stage: str, s: float, device: str, fault: str, **more: Any) -> dict[str, Any]:
    return {"at_state": "move", "stage": stage, "s": s, "device": device, "fault": fault, **more}


def test_a_slip_that_the_encoders_do_not_see_stops_the_move_on_its_path(tmp_path: Path) -> None:
    slip = [at("align", 0.4, axis, "slip", values={"by_mm": -0.8}) for axis in X_AXES]
    run = run_tracked(3, tmp_path, slip)
    assert run.state is State.FAULT
    (alarm,) = run.records("alarm")
    assert alarm["code"] == 2151
    assert alarm["where"] in {f.name for f in run.job.component.features}
    assert alarm["value"] == pytest.approx(0.8, abs=0.15)
    assert "(-0.8" in alarm["message"] or "(-0.7" in alarm["message"] or "(-0.9" in alarm["message"]
    (moved,) = run.records("moved")
    assert moved["result"] == "fault"
    _, table = run.setpoints_mm()
    # Every set-point of the stop is a place of the planned path, to the rounding of the drives
    assert path_gap_mm(run.plans[-1].q_mm, table[-300:]).max() < 2e-3
    assert run.drift_mm < 1e-3


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> TrackedCell:
    """Three seconds without a view in the first move, swapped tools in the second, a camera that repeats itself in the
    third."""
    return run_tracked(
        5,
        tmp_path_factory.mktemp("disturbed"),
        [
            at("align", 0.1, "camera", "occluded", for_s=3.0),
            at("approach-3", 0.2, "camera", "swapped", values={"value": {"nose": "tail", "tail": "nose"}}, for_s=1.0),
            at("dock", 0.2, "camera", "stale"),
        ],
    )


def test_a_lost_view_of_three_seconds_is_bridged_by_the_read_backs(disturbed: TrackedCell) -> None:
    assert disturbed.state is State.DOCKED
    gap = np.array([row for row in disturbed.seen if row[0] == 1 and row[2] > 0.3])
    assert gap[:, 2].max() > 2.7
    assert np.median(gap[:, 3]) <= 0.06
    assert np.quantile(gap[:, 3], 0.9) <= 0.1
    assert gap[:, 4].max() < 0.3


def test_swapped_tools_and_a_frozen_camera_are_named_and_not_believed(disturbed: TrackedCell) -> None:
    found = {alarm["code"]: alarm for alarm in disturbed.records("alarm")}
    assert set(found) == {3054, 3051}
    assert "nose with tail" in found[3054]["message"]
    assert "points" in found[3051]["where"]
    late = np.array([row[3] for row in disturbed.seen if row[0] == 3])
    assert late.max() < 0.15


def test_without_read_backs_a_lost_view_stops_the_move_when_the_pose_is_no_longer_known(tmp_path: Path) -> None:
    run = run_tracked(3, tmp_path, [at("align", 0.2, "camera", "occluded")], method="ins", predicted_sd_mm=2.0)
    assert run.state is State.FAULT
    assert run.alarms() == [(2152, "live pose")]
    rows = np.array(run.seen)
    # It went on blind for a while, and was stopped before the true error came near to what it was said to be at most.
    assert 0.1 < rows[:, 2].max() < 3.0
    assert "inertial" in run.records("alarm")[0]["message"]
