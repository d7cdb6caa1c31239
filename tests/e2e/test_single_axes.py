"""Axes beside the positioners at a terminal, over a pseudo-terminal: looked at, moved, refused."""

from __future__ import annotations

import json
import shutil
import signal

import pytest

from docking.cli import call
from docking.config.load import load_cell
from docking.errors import ConfigInvalid
from docking.transcript import read_transcript
from docking.words import tell
from tests.support.dry_cell import CELLS
from tests.support.program import Terminal

pytestmark = [pytest.mark.wires, pytest.mark.timeout(60)]

TABLE = """
[[single_axes]]
name = "platform"
line = "/dev/ttyUSB7"
unit = 3
stroke_mm = [-20.0, 300.0]
v_mm_s = 60.0
a_mm_s2 = 2000.0

[[single_axes]]
name = "gate"
line = "/dev/ttyUSB7"
unit = 4
stroke_mm = [0.0, 900.0]
v_mm_s = 100.0
a_mm_s2 = 2000.0
"""


@pytest.fixture
def cell(tmp_path):
    for suffix in ("job.toml", "sim.toml"):
        shutil.copy(CELLS / f"lab-modbus.{suffix}", tmp_path / f"cell.{suffix}")
    path = tmp_path / "cell.toml"
    path.write_text((CELLS / "lab-modbus.toml").read_text("utf-8") + TABLE, "utf-8")
    return path


def test_they_are_found_with_what_they_lack(cell, capsys, tmp_path):
    transcript = tmp_path / "bytes.txt"
    assert call(["devices", str(cell), "--sim", "--json", "--transcript", str(transcript)]) == 0
    rows = {row["where"]: row for row in json.loads(capsys.readouterr().out)["devices"]}
    for name in ("platform", "gate"):
        row = rows[f"single axis {name}"]
        assert row["state"] == "servo on, homed"
        assert "goes on" in row["watchdog"]
        assert row["round_trip_ms"] > 0.0
        heard = [line for line in read_transcript(transcript) if line.wire == f"single:{name}"]
        asked = [line.data[:2] for line in heard if line.sent]
        assert asked == [bytes((3 + (name == "gate"), 3))] * 5, "reads of its unit and nothing else"
        assert any(not line.sent for line in heard)


def test_one_is_moved_and_says_that_it_is_there(cell, capsys):
    assert call(["single", str(cell), "platform", "--sim", "--json", "--", "-12.5"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == {"axis": "platform", "before_mm": 0.0, "after_mm": -12.5, "speed_mm_s": 60.0}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("platform", "301"), "-20 to 300"),
        (("gate", "10", "--speed", "101"), "0 to 100"),
        (("gate", "10", "--speed", "0"), "above 0 to 100"),
        (("gate", "nan"), "0 to 900"),
        (("A", "10"), "platform, gate"),
    ],
)
def test_what_is_not_in_the_cell_is_refused_before_a_wire_is_opened(words, told, cell, capsys):
    assert call(["single", str(cell), *words, "--yes"]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("unit = 4", "unit = 3", "line and unit"),
        ('name = "gate"', 'name = "A"', "the same name"),
        ('name = "gate"', 'name = "platform"', "the same name"),
        ("v_mm_s = 60.0", "v_mm_s = 0.0", "v_mm_s"),
    ],
)
def test_the_table_is_checked(old, new, told, cell):
    text = cell.read_text("utf-8")
    at = text.index("[[single_axes]]")
    cell.write_text(text[:at] + text[at:].replace(old, new), "utf-8")
    with pytest.raises(ConfigInvalid) as caught:
        load_cell(cell)
    assert told in caught.value.text()


def test_a_positioner_is_never_of_this_kind(cell):
    text = cell.read_text("utf-8").replace('kind = "modbus-tcp"', 'kind = "modbus-drives"')
    cell.write_text(text, "utf-8")
    with pytest.raises(ConfigInvalid):
        load_cell(cell)


@pytest.mark.parametrize("language", ["en", pytest.param("zh", marks=pytest.mark.full)])
def test_who_interrupts_is_told_that_the_axis_goes_on(cell, language):
    with Terminal("single", str(cell), "gate", "900", "--speed", "20", "--sim", language=language) as terminal:
        terminal.see("0.00 mm")
        terminal.interrupt(signal.SIGINT)
        assert terminal.ended() == 4
    assert tell(language, "single_goes_on", name="gate", target_mm=900.0) in terminal.text
    assert "6003" in terminal.text
