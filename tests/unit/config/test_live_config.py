"""`[live]`: the reference cell with it is clean; what it needs is asked for."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from docking.assemble.live import live_settings
from docking.config import CellFile
from docking.config.check import check_cell, check_job
from docking.config.load import load_cell, load_job
from docking.live.settings import tracker_at_rest
from docking.types import Pose

CELL = Path(__file__).parents[3] / "sim" / "cells" / "lab-can-tracked.toml"


def changed(**keys: Any) -> dict[str, Any]:
    table = tomllib.loads(CELL.read_text())
    return {**table, **keys}


def problem(table: dict[str, Any]) -> str:
    with pytest.raises(ValidationError) as raised:
        CellFile.model_validate_json(json.dumps(table))
    return str(raised.value)


def test_the_reference_cell_is_clean_and_its_points_are_tools_and_targets() -> None:
    cell = load_cell(CELL)
    job = load_job(CELL.with_name("lab-can-tracked.job.toml"), cell)
    assert check_cell(cell) + check_job(cell, job) == []
    assert cell.live is not None
    settings = live_settings(cell, job, cell.live)
    assert settings.body.names == ("nose", "tail", *(t.name for t in job.component.targets))
    assert settings.tools == {"nose", "tail"}
    assert settings.chosen == "encoders"
    assert tracker_at_rest(settings, Pose.identity()).method == "encoders"


def test_live_without_a_camera_or_an_inertial_method_without_its_sensor_is_refused() -> None:
    table = changed()
    del table["camera"]
    assert "[live] needs a [camera]" in problem(table)
    table = changed()
    table["live"]["method"] = "ins"
    CellFile.model_validate_json(json.dumps(table))
    del table["inertial"]
    assert "needs an [inertial] sensor" in problem(table)


def test_names_of_live_points_do_not_repeat() -> None:
    table = changed()
    table["live"]["points"] *= 2
    assert "names repeat" in problem(table)
