"""`docking home` at a terminal, over real wires: refused under a component, done where nothing rests."""

from __future__ import annotations

import io
import json
import shutil
import signal
from pathlib import Path

import pytest

from docking.cli import call
from docking.config.load import load_cell
from docking.words import LANGUAGES, tell
from tests.support.dry_cell import CELLS
from tests.support.program import Terminal, cell_copy, served
from tests.support.weighed_cell import weighed_files

pytestmark = [pytest.mark.wires, pytest.mark.timeout(60)]

ASKED = "y = "
PLATFORM = """
[[single_axes]]
name = "platform"
line = "/dev/no-such-line"
unit = 3
stroke_mm = [-20.0, 300.0]
v_mm_s = 60.0
a_mm_s2 = 2000.0
"""


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
    assert ASKED not in said.err + said.out


@pytest.mark.parametrize(
    "arguments",
    [
        ["home", "lab-can-free", "--positioner", "Q"],
        ["home", "lab-can"],
        ["single", "lab-modbus", "nobody", "10"],
        ["devices", "lab-modbus", "--prove-watchdogs"],
    ],
    ids=" ".join,
)
def test_what_is_not_in_the_cell_is_told_before_anybody_is_asked(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert call([arguments[0], str(CELLS / f"{arguments[1]}.toml"), *arguments[2:]]) == 2
    assert ASKED not in capsys.readouterr().err


@pytest.fixture
def nowhere(tmp_path: Path) -> str:
    """The shipped cell with ports that no computer has, and an axis beside it."""
    cell = cell_copy(tmp_path, "lab-can-free", (".toml", "socketcan", "docking-unix"), (".toml", "can0", "no-such-bus"))
    cell.write_text(cell.read_text("utf-8") + PLATFORM, "utf-8")
    return str(cell)


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("answer", ["y", "YES", "是", "n", "", "yy", "j"])
@pytest.mark.parametrize("command", ["home", "single", "devices"])
def test_only_a_yes_lets_it_begin(
    command: str,
    answer: str,
    language: str,
    nowhere: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is there to begin with: the port that is missing shows that it was tried."""
    monkeypatch.setenv("DOCKING_LANGUAGE", language)
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{answer}\n"))
    more = {"home": ["--positioner", "B"], "single": ["platform", "10"], "devices": ["--prove-watchdogs"]}[command]
    code = call([command, nowhere, *more])
    out, err = capsys.readouterr()
    facts = {"names": "B", "name": "platform", "target_mm": 10.0}
    key = {"home": "home_question", "single": "single_question", "devices": "silence_question"}[command]
    assert tell(language, "confirmed", question=tell(language, key, **facts)) in err + out
    begun = answer in ("y", "YES", "是")
    assert code == (1 if begun else 4)
    assert ("1001" in err + out) is begun
    assert ("6003" in err) is not begun


# the shipped cell ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("language", [pytest.param("en", marks=pytest.mark.full), "zh"])
def test_the_shipped_cell_without_a_part_is_homed(
    language: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOCKING_LANGUAGE", language)
    group = ["--positioner", "A", "--positioner", "D"]
    assert call(["home", str(CELLS / "lab-can-free.toml"), "--sim", "--json", *group]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    axes = [f"{name}.{axis}" for name in "AD" for axis in "XYZ"]
    assert [row["axis"] for row in report["homed"]] == axes
    assert all(abs(row["after_mm"]) < 2e-3 < abs(row["before_mm"]) for row in report["homed"])
    assert report["not_homed"] == [f"{name}.{axis}" for name in "BC" for axis in "XYZ"]
    assert err.splitlines() == [tell(language, "bringing_up"), tell(language, "homing", axes=", ".join(axes))]


@pytest.mark.parametrize("free", [(), ("--free",)], ids=["", "said to be free"])
def test_the_shipped_cell_with_its_part_is_refused_whatever_is_said(
    free: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = cell_copy(tmp_path, "lab-can-free", (".sim.toml", "part_on_balls = false", "part_on_balls = true"))
    assert call(["home", str(cell), "--sim", "--yes", *free]) == 1
    out, err = capsys.readouterr()
    assert "2137: A." in err
    assert out.splitlines() == [tell("en", "bringing_up")], "nobody is told that axes move"


@pytest.mark.parametrize("free", [(), ("--free",)], ids=["", "said to be free"])
def test_load_cells_on_modules_show_a_part_too(
    free: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = weighed_files(tmp_path, "lab-can-free")
    assert load_cell(cell).inputs.weighing  # type: ignore[union-attr]
    truth = tmp_path / "weighed.sim.toml"
    alone = ["home", str(cell), "--sim", "--positioner", "B", *free]
    assert call(alone) == 0
    truth.write_text(truth.read_text("utf-8").replace("part_on_balls = false", "part_on_balls = true"), "utf-8")
    capsys.readouterr()
    assert call(alone) == 1
    assert "2137: B." in capsys.readouterr().err


def test_the_keyboard_halts_the_group_and_an_open_gate_refuses_it(tmp_path: Path) -> None:
    cell = cell_copy(tmp_path, "lab-can-free", (".toml", "speed_mm_s = [5.0, 1.0]", "speed_mm_s = [0.2, 0.1]"))
    scenario = tmp_path / "gate.toml"
    gate = 'schema_version = 1\nname = "gate"\n[[event]]\nat_s = 0.0\ndevice = "gate"\nfault = "press"\n'
    scenario.write_text(gate, "utf-8")
    with Terminal("home", str(cell), "--sim") as terminal:
        terminal.see("HOMING A.X")
        terminal.interrupt(signal.SIGINT)
        assert terminal.ended() == 1
        assert "2136" in terminal.text
        assert "interrupted" in terminal.text
    with (
        served(cell, tmp_path, "--scenario", str(scenario)) as wires,
        Terminal("home", str(cell), "--sim", "--wires", str(wires), language="zh") as terminal,
    ):
        assert terminal.ended() == 1
        assert "2137" in terminal.text
        assert "gate" in terminal.text
        assert "正在回零" not in terminal.text
