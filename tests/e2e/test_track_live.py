"""`docking track CELL --live`: the pose of the part by simulated devices on real wires, and what is refused."""

from __future__ import annotations

import json

import pytest

from docking.assemble.simulated import truth_of
from docking.cli import call
from docking.config.load import load_cell, load_job
from sim.plant import Plant
from tests.support.dry_cell import CELLS

TRACKED = CELLS / "lab-can-tracked.toml"


def test_the_pose_shown_is_that_of_the_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["track", str(TRACKED), "--live", "--sim", "--seconds", "0.6", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    cell = load_cell(TRACKED)
    job = load_job(CELLS / "lab-can-tracked.job.toml", cell)
    true = Plant(cell, job, truth_of(TRACKED), 1).component_pose_W()
    # The read-backs are the reference: the cell file is calibrated to about 0.1 mm, and the balls sink under the load.
    assert shown["pose"][:3] == pytest.approx(true.t_mm.tolist(), abs=0.5)
    assert shown["method"] == "encoders"
    assert shown["source"] == "image"
    assert shown["seen"] == shown["points"] == 10
    assert shown["deviation_mm"] < 0.3
    assert 0.0 < shown["predicted_sd_mm"] < 0.1
    assert shown["alarms"] == []


def test_cells_without_live_and_options_without_it_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["track", str(CELLS / "lab-can.toml"), "--live", "--sim"]) == 2
    assert "[live]" in capsys.readouterr().err
    assert call(["track", "a.csv", "--seconds", "3"]) == 2
    assert "--live" in capsys.readouterr().err
    assert call(["track", str(TRACKED), str(TRACKED), "--live"]) == 2
    assert "one CELL" in capsys.readouterr().err


def test_a_cell_without_live_is_said_to_be_no_recording(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["track", str(TRACKED)]) == 2
    assert "--live" in capsys.readouterr().err
