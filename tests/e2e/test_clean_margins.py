"""No monitor trips in a clean docking, with every unmodelled error at main-study size; how near each one came."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from docking.assemble.runs import RunRequest, dry_run_files, load_files
from docking.assemble.simulated import truth_of
from docking.motion.monitors import Watch

CELLS = Path(__file__).parents[2] / "sim" / "cells"
NEAREST = 0.8
"""Fraction of its limit that no monitor passes: the ratio of limits to what is healthy is 1.25 at the least."""
ALWAYS = {
    "ball_pair", "ball_residual", "ball_rms", "command_against_encoder", "encoder_jump", "following_error",
    "measured_force", "measured_warp", "measured_whole_force", "measured_whole_warp", "overload",
    "predicted_force", "predicted_warp", "rating", "standstill", "stuck", "underload",
}  # fmt: skip
FOLLOWING = {"passive_axis", "passive_place"}
FULL = [
    pytest.param(name, seed, marks=pytest.mark.full)
    for name, seeds in (
        ("lab-can", range(3, 21)),
        ("fuselage-can", range(1, 6)),
        ("follower-can", range(2, 6)),
        ("follower-force-can", range(1, 4)),
    )
    for seed in seeds
]


@pytest.mark.parametrize(("name", "seed"), [("lab-can", 1), ("lab-can", 2), ("follower-can", 1), *FULL])
def test_no_monitor_trips_in_a_clean_docking(name: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Watch] = []
    begin = Watch.__init__

    def remembered(watch: Watch, *settings: Any) -> None:
        begin(watch, *settings)
        made.append(watch)

    monkeypatch.setattr(Watch, "__init__", remembered)
    path = CELLS / f"{name}.toml"
    request = RunRequest(path, None, seed, None, None, "en")
    summary = dry_run_files(load_files(request), truth_of(path), request, lambda text: None)
    assert summary["outcome"] == "docked", summary["alarms"]
    assert summary["alarms"] == []
    (watch,) = made
    margins = watch.margins()
    assert set(margins) >= ALWAYS | (FOLLOWING if name.startswith("follower") else set())
    # Silence is allowed for whole cycles only: one of two is half the limit already.
    near = {monitor: value for monitor, value in margins.items() if not (value <= NEAREST)}
    assert not near
