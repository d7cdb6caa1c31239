"""One unmodelled error alone at five times its size: refused or named, never a false docking."""

from __future__ import annotations

from pathlib import Path

import pytest

from docking.assemble.runs import RunRequest, dry_run_files, load_files
from docking.assemble.simulated import truth_of

CELLS = Path(__file__).parents[2] / "sim" / "cells"
CELL = CELLS / "lab-can.toml"
FUSELAGE = CELLS / "fuselage-can.toml"
ALWAYS = {"misalignment": 1.0, "instrument_noise": 1.0}


@pytest.mark.parametrize(
    ("error", "code"),
    [
        ("feature_transfer", 3013),
        ("calibration", 5007),
        ("seating", None),
        ("temperature", None),
        ("nominal_nests", None),
        ("sag", None),
        ("station_drift", None),
        ("ball_clearance", None),
    ],
)
def test_five_times_one_error_is_never_docked_falsely(error: str, code: int | None) -> None:
    request = RunRequest(CELL, None, 2, None, None, "en")
    truth = truth_of(CELL).only(error, 5.0).scaled(ALWAYS)
    summary = dry_run_files(load_files(request), truth, request, lambda text: None)
    if summary["outcome"] == "docked":
        assert summary["true_max_feature_error_mm"] <= summary["tolerance_mm"]
    else:
        assert summary["alarms"], "an outcome other than docked names its reason"
    if code is not None:
        assert code in [alarm["code"] for alarm in summary["alarms"]]


def test_a_base_turned_by_half_a_degree_stops_on_force() -> None:
    request = RunRequest(FUSELAGE, None, 1, None, None, "en")
    truth = truth_of(FUSELAGE).scaled({"uncalibrated_base": 1.0})
    summary = dry_run_files(load_files(request), truth, request, lambda text: None)
    assert summary["outcome"] == "fault"
    assert summary["alarms"][0]["code"] == 2111
