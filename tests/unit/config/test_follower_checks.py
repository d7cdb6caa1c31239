"""An axis that holds a force: what the files must say for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from docking.config import CellFile, JobFile
from docking.config.build import positioners_from
from docking.config.cell import AxisConfig
from docking.config.check import check_cell, check_files, check_job
from docking.config.findings import errors_of
from docking.config.load import load_cell, load_job

CELLS = Path(__file__).parents[3] / "sim" / "cells"
PATH = CELLS / "follower-force-can.toml"
KEY = "positioners[3].axes[2].force_n"


def files() -> tuple[CellFile, JobFile]:
    cell = load_cell(PATH)
    return cell, load_job(CELLS / "follower-force-can.job.toml", cell)


def with_axis(cell: CellFile, *, positioner: dict[str, Any] | None = None, **axis: Any) -> CellFile:
    """The cell with D, or D.Z, changed."""
    d = cell.positioners[3]
    changed = d.model_copy(update={"axes": (*d.axes[:2], d.axes[2].model_copy(update=axis)), **(positioner or {})})
    return cell.model_copy(update={"positioners": (*cell.positioners[:3], changed)})


def told(cell: CellFile) -> list[str]:
    return [f.text for f in errors_of(check_cell(cell)) if f.key == KEY]


def test_the_cell_differs_from_its_sister_by_one_axis_only() -> None:
    cell, job = files()
    sister = load_cell(CELLS / "follower-can.toml")
    assert job == load_job(CELLS / "follower-can.job.toml", sister)
    as_sister = with_axis(cell, driven=True, force_n=None).model_copy(update={"name": "follower-can"})
    assert as_sister == sister
    assert [n for n, on in zip(cell.axis_names, cell.driven, strict=True) if on] == [
        "A.X", "A.Y", "A.Z", "B.Y", "B.Z", "C.Z",
    ]  # fmt: skip
    assert sum(cell.powered) == 7
    assert check_cell(cell) + check_job(cell, job) == []
    positioners = positioners_from(cell, job)
    assert positioners.held_n[11] == 13400.0
    assert positioners.held_tolerance_n[11] == pytest.approx(268.0)


def test_an_axis_with_a_force_is_not_driven() -> None:
    axis = files()[0].positioners[3].axes[2].model_dump()
    with pytest.raises(ValidationError, match="driven = false"):
        AxisConfig.model_validate({**axis, "driven": True})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"direction": (0.0, 0.1736, 0.9848)}, "leans 10 deg"),
        ({"direction": (0.0, 0.0, -1.0)}, "leans 180 deg"),
        ({"force_n": 49500.0}, "rated_n is 50000"),
        ({"positioner": {"load_cell": False}}, "load cell"),
    ],
)
def test_what_the_axis_must_be(change: dict[str, Any], words: str) -> None:
    cell, _ = files()
    assert told(cell) == []
    (text,) = told(with_axis(cell, **change))
    assert "D.Z" in text
    assert words in text


def test_only_a_bus_with_torque_mode() -> None:
    cell, _ = files()
    other = load_cell(CELLS / "fuselage-modbus.toml").bus
    assert any("modbus-tcp" in text for text in told(cell.model_copy(update={"bus": other})))


@pytest.mark.parametrize("force_n", [22300.0, 1500.0])
def test_a_force_that_lets_the_part_tip_is_refused(force_n: float) -> None:
    """22.3 kN under D leave A with 1.2 kN; with 1.5 kN under D its own ball is the light one, tolerance included."""
    cell, job = files()
    errors = errors_of(check_job(with_axis(cell, force_n=force_n), job))
    assert any("tip" in f.text for f in errors)


def test_check_says_which_axis_holds_what() -> None:
    text = check_files(PATH).text
    for words in (
        "12, 6 driven, redundancy 0",
        "passive: B.X, C.X, C.Y, D.X, D.Y;",
        "D.Z holds 13400 N +- 2 %",
        "13.40",
    ):
        assert words in text
