"""One unmodelled error alone at five times its size: refused or named, never a false docking."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

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


def run_with_turned_bases(plausibility_mm: float) -> dict[str, Any]:
    request = RunRequest(FUSELAGE, None, 1, None, None, "en")
    files = load_files(request)
    limits = files.cell.limits.model_copy(update={"frame_plausibility_mm": plausibility_mm})
    files = replace(files, cell=files.cell.model_copy(update={"limits": limits}))
    truth = truth_of(FUSELAGE).scaled({"uncalibrated_base": 1.0})
    return dry_run_files(files, truth, request, lambda text: None)


def test_bases_turned_by_half_a_degree_are_refused_before_anything_moves() -> None:
    summary = run_with_turned_bases(plausibility_mm=0.5)
    assert (summary["outcome"], summary["moves"]) == ("refused", 0)
    assert summary["alarms"][0]["code"] == 5007


def test_bases_turned_by_half_a_degree_stop_on_force_where_the_first_check_is_blinded() -> None:
    summary = run_with_turned_bases(plausibility_mm=10.0)
    assert summary["outcome"] == "fault"
    assert summary["alarms"][0]["code"] in (2103, 2111, 2126)
