"""`docking devices`, `docking monitor`, `--transcript` and wired permissives at a terminal, over real wires."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from docking.cli import call
from docking.errors import catalogue
from docking.transcript import read_transcript
from docking.words import tell
from tests.support.dry_cell import CELLS
from tests.support.program import Terminal, cell_copy, quick_cell, served
from tests.support.weighed_cell import weighed_files

pytestmark = [pytest.mark.wires, pytest.mark.timeout(120)]

CRANE_BUSY = """
schema_version = 1
name = "the crane is in the way at first"

[[event]]
at_s = 0.0
device = "crane_free"
fault = "drop"
for_s = 25.0
"""


def told(capsys) -> dict:
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("name", "count", "skew"), [("lab-can", 14, False), ("lab-modbus", 6, True)])
def test_every_device_of_a_simulated_cell_answers(name, count, skew, capsys, tmp_path):
    path = tmp_path / "bytes.txt"
    assert call(["devices", str(CELLS / f"{name}.toml"), "--sim", "--json", "--transcript", str(path)]) == 0
    report = told(capsys)
    assert report["ok"]
    assert report["missing"] == []
    assert len(report["devices"]) == count
    assert all(row["answers"] and row["serial"] and row["round_trip_ms"] > 0.0 for row in report["devices"])
    assert (report["start_skew_ms"] is not None) is skew
    lines = read_transcript(path)
    assert {line.wire.partition(":")[0] for line in lines} == {"tracker", "modbus" if skew else "can"}
    assert any(line.sent for line in lines)
    assert any(not line.sent for line in lines)


def test_the_sensors_beside_the_tracker_are_asked_too_and_heard_at_both_ends(capsys, tmp_path):
    cell = CELLS / "lab-can-tracked.toml"
    near, far = tmp_path / "near.txt", tmp_path / "far.txt"
    with served(cell, tmp_path, "--transcript", str(far)) as wires:
        there = ["--sim", "--wires", str(wires), "--json", "--transcript", str(near)]
        assert call(["devices", str(cell), *there]) == 0
    for wire in ("tracker", "camera", "inertial"):
        for sent in (True, False):
            ends = [
                b"".join(line.data for line in read_transcript(path) if line.wire == wire and line.sent is sent)
                for path in (near, far)
            ]
            # The sensor streams from the moment it has power; the driver has opened its port later.
            assert ends[0]
            assert ends[1].endswith(ends[0]) or (not sent and ends[0] in ends[1]), wire
    rows = {row["where"]: row for row in told(capsys)["devices"]}
    assert rows["camera"]["vendor"] == "NDI"
    assert rows["inertial sensor"]["vendor"] == "VectorNav"
    assert all(rows[name]["serial"] and rows[name]["address"] for name in ("camera", "inertial sensor"))


def test_missing_sensors_are_named_with_what_to_do(capsys, monkeypatch, tmp_path):
    ports = [(".toml", f"/dev/ttyUSB{n}", str(tmp_path / f"port{n}")) for n in range(3)]
    bus = (".toml", 'interface = "socketcan"', 'interface = "docking-unix"')
    cell = cell_copy(tmp_path, "lab-can-tracked", *ports, bus)
    for name in ("nose", "tail"):
        shutil.copy(CELLS / f"lab-can-tracked.{name}.rom", tmp_path)
    for language in ("en", "zh"):
        monkeypatch.setenv("DOCKING_LANGUAGE", language)
        assert call(["devices", str(cell), "--json"]) == 1
        report = told(capsys)
        assert report["missing"] == ["tracker", "camera", "inertial sensor", "bus"]
        remedy = catalogue(language)["1001"]["remedy"]
        assert {(row["problem"]["code"], row["problem"]["remedy"]) for row in report["devices"]} == {(1001, remedy)}
        assert call(["devices", str(cell)]) == 1
        text = capsys.readouterr().out
        assert text.count(f"-> {remedy}") == 4
        assert tell(language, "not_in_order", names="tracker, camera, inertial sensor, bus") in text


def test_served_devices_are_proved_and_monitored(capsys, tmp_path):
    cell = CELLS / "lab-can.toml"
    with served(cell, tmp_path) as wires:
        there = ["--sim", "--wires", str(wires), "--json"]
        assert call(["devices", str(cell), *there, "--prove"]) == 0
        proved = told(capsys)
        assert proved["bring_up"] is None
        assert proved["start_skew_ms"] >= 0.0
        assert call(["monitor", str(cell), *there, "--seconds", "0.3"]) == 0
        values = told(capsys)
    assert [row["axis"] for row in values["axes"]][:3] == ["A.X", "A.Y", "A.Z"]
    assert {row["state"] for row in values["axes"]} == {"switch on disabled"}
    assert values["inputs"]["crane_free"] is True
    assert values["inputs"]["e_stop"] is False
    assert 15.0 < values["temperatures_c"]["component_sensor"] < 25.0


def test_a_cell_without_its_devices_is_told_by_name_with_exit_1(capsys, tmp_path):
    text = (CELLS / "lab-can.toml").read_text().replace("/dev/ttyUSB0", str(tmp_path / "no-port"))
    cell = tmp_path / "lab-can.toml"
    cell.write_text(text.replace('interface = "socketcan"', 'interface = "docking-unix"'))
    assert call(["devices", str(cell), "--json"]) == 1
    report = told(capsys)
    assert report["missing"] == ["tracker", "bus"]
    assert {row["problem"]["code"] for row in report["devices"]} == {1001}
    assert call(["monitor", str(cell), "--seconds", "0.2"]) == 1
    assert "1001" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_load_cells_on_modules_are_monitored(name, capsys, tmp_path):
    """A commissioning engineer puts a known weight on a ball: 60 kg are on four of them."""
    assert call(["monitor", str(weighed_files(tmp_path, name)), "--sim", "--seconds", "0.2", "--json"]) == 0
    forces = {row["axis"]: row["force_n"] for row in told(capsys)["axes"]}
    assert all(force is not None for force in forces.values())
    weights = [force for axis, force in forces.items() if axis.endswith("Z")]
    assert min(weights) > 80.0
    assert sum(weights) == pytest.approx(60.0 * 9.80665, abs=15.0)
    assert max(abs(force) for axis, force in forces.items() if not axis.endswith("Z")) < 20.0


@pytest.mark.full
@pytest.mark.parametrize("seconds", ["nan", "0"])
def test_a_time_that_is_none_is_refused(seconds, capsys):
    assert call(["monitor", str(CELLS / "lab-can.toml"), "--sim", "--seconds", seconds]) == 2
    assert "4004" in capsys.readouterr().err


def test_a_wired_permissive_is_waited_for_and_never_asked(tmp_path):
    cell: Path = quick_cell(tmp_path, "lab-can")
    scenario = tmp_path / "busy.toml"
    scenario.write_text(CRANE_BUSY)
    with (
        served(cell, tmp_path, "--scenario", str(scenario)) as wires,
        Terminal("run", str(cell), "--sim", "--wires", str(wires), "--step") as terminal,
    ):
        terminal.see("waiting for 'crane_free'")
        terminal.see("g = .*> \n")
        terminal.type("a")
        assert terminal.ended() == 4, terminal.text
    assert "is 'crane_free' given" not in terminal.text
    assert terminal.text.count("waiting for 'crane_free'") == 1
