"""`docking home` at a terminal, over real wires: refused under a component, done where nothing rests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from docking.cli import call
from tests.support.dry_cell import CELLS

pytestmark = [pytest.mark.wires, pytest.mark.timeout(60)]


def cell_with(folder: Path, table: str, name: str = "lab-can") -> str:
    for suffix in ("job.toml", "sim.toml"):
        shutil.copy(CELLS / f"{name}.{suffix}", folder / f"cell.{suffix}")
    path = folder / "cell.toml"
    path.write_text((CELLS / f"{name}.toml").read_text("utf-8") + table, "utf-8")
    return str(path)


def test_positioners_under_a_component_are_not_homed(tmp_path, capsys):
    assert call(["home", cell_with(tmp_path, "\n[homing]\nmethod = 17\n"), "--sim"]) == 1
    assert "2137: A.Z" in capsys.readouterr().err


def test_a_group_is_homed_and_said_axis_by_axis(tmp_path, capsys):
    # A limit that the weight does not reach stands for a positioner without load.
    cell = cell_with(tmp_path, "\n[homing]\nmethod = 37\nfree_n = 5000.0\n")
    assert call(["home", cell, "--sim", "--positioner", "B", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["axis"] for row in report["homed"]] == ["B.X", "B.Y", "B.Z"]
    assert all(abs(row["after_mm"]) < 1e-3 < abs(row["before_mm"]) for row in report["homed"])
    assert report["not_homed"] == []


@pytest.mark.parametrize(
    ("name", "table", "more", "told"),
    [
        ("lab-can", "", (), "homing: missing"),
        ("lab-can", "\n[homing]\n", ("--positioner", "Q"), "A, B, C, D"),
        ("lab-modbus", "", (), "PLCs home their axes themselves"),
    ],
)
def test_what_cannot_be_homed_is_a_matter_of_the_files(name, table, more, told, tmp_path, capsys):
    assert call(["home", cell_with(tmp_path, table, name), "--sim", *more]) == 2
    assert told in capsys.readouterr().err


def test_without_load_cells_somebody_has_to_say_that_nothing_rests_there(tmp_path, capsys):
    cell = Path(cell_with(tmp_path, "\n[homing]\n"))
    text = cell.read_text("utf-8").replace("load_cell = true\n", "")
    cut = text.index("[load_cells]") if "[load_cells]" in text else len(text)
    end = text.index("\n[", cut + 1) if cut < len(text) else len(text)
    cell.write_text(text[:cut] + text[end:], "utf-8")
    assert call(["home", str(cell), "--sim"]) == 1
    assert "--free" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["home"], ["single", "platform", "10"], ["devices", "--prove-watchdogs"]], ids=lambda a: a[0]
)
def test_a_cell_that_cannot_be_read_is_told_before_anybody_is_asked(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call([arguments[0], "nowhere.toml", *arguments[1:]]) == 2
    said = capsys.readouterr()
    assert "4001" in said.err
    assert "[y/N]" not in said.err + said.out
