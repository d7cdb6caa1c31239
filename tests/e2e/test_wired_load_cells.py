"""Load cells on I/O modules: the cells dock with them, a torn wire stops them by name, wrong files are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.assemble.requests import RunRequest
from docking.assemble.runs import dry_run
from docking.config.load import load_cell
from docking.config.wired_forces import as_axes_know_it
from docking.errors import ConfigInvalid, LoadCellBroken
from docking.journal import read
from tests.support.weighed_cell import weighed_files

IN_MOVE = 'schema_version = 1\nname = "n"\n[[event]]\nat_state = "move"\nstage = "dock"\ns = 0.5\n'
LAB = pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])


def run(folder: Path, name: str, event: str = "") -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Summary and journal of a dry run, with an event at half of the last move."""
    scenario = None
    if event:
        scenario = folder / "scenario.toml"
        scenario.write_text(IN_MOVE + event, "utf-8")
    journal = folder / "run.jsonl"
    request = RunRequest(weighed_files(folder, name), None, 1, None, journal, "en", scenario)
    return dry_run(request, lambda text: None), read(journal)


@LAB
def test_a_cell_docks_with_its_forces_from_modules(tmp_path: Path, name: str) -> None:
    summary, records = run(tmp_path, name)
    assert summary["outcome"] == "docked", summary["alarms"]
    assert summary["true_max_feature_error_mm"] <= summary["tolerance_mm"]
    identities = [str(record["body"]) for record in records if "force_A" in str(record["body"])]
    assert identities, "the modules are in the journal with the other devices"


TORN, HIGH = 'fault = "broken"\n', 'fault = "current"\nvalues = { ma = 20.9 }\n'


@pytest.mark.parametrize(
    ("name", "fault", "said"),
    [
        ("lab-can", TORN, "0.00 mA"),
        ("lab-modbus", HIGH, "20.90 mA"),
        pytest.param("lab-can", HIGH, "20.90 mA", marks=pytest.mark.full),
        pytest.param("lab-modbus", TORN, "0.00 mA", marks=pytest.mark.full),
    ],
)
def test_a_current_that_means_no_force_stops_the_move_by_name(tmp_path: Path, name: str, fault: str, said: str) -> None:
    summary, _ = run(tmp_path, name, 'device = "cell_B"\n' + fault)
    assert summary["outcome"] == "fault"
    alarm = summary["alarms"][0]
    assert alarm["code"] == LoadCellBroken.code, alarm
    assert "cell_B" in alarm["message"]
    assert "B.X" in alarm["message"]
    assert said in alarm["message"]


@pytest.mark.full
def test_a_silent_module_stops_the_move(tmp_path: Path) -> None:
    summary, _ = run(tmp_path, "lab-can", 'device = "force_C"\nfault = "silent"\n')
    assert summary["outcome"] == "fault"
    assert "cell_C" in summary["alarms"][0]["message"]


def test_the_axes_themselves_are_not_asked_for_forces(tmp_path: Path) -> None:
    cell = load_cell(weighed_files(tmp_path, "lab-can"))
    assert all(p.load_cell for p in cell.positioners)
    assert not any(p.load_cell for p in as_axes_know_it(cell).positioners)
    assert np.array(cell.load_cells.range_n if cell.load_cells else []).tolist() == [200.0, 200.0, 500.0]


@pytest.mark.parametrize(
    ("old", "fresh", "said"),
    [
        ('positioner = "B", module', 'positioner = "A", module', "inputs.forces[1].positioner"),
        ('positioner = "B", module', 'positioner = "Q", module', "is no positioner with load_cell"),
        ('module = "force_B"', 'module = "io1"', "load cells need their own module"),
        ('module = "force_B"', 'module = "force_A"', "channel"),
        ('module = "force_B"', 'module = "gone"', "is not a module"),
    ],
)
def test_wrong_wiring_is_refused(tmp_path: Path, old: str, fresh: str, said: str) -> None:
    path = weighed_files(tmp_path, "lab-can")
    text = path.read_text("utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, fresh), "utf-8")
    with pytest.raises(ConfigInvalid) as refused:
        load_cell(path)
    assert said in str(refused.value)
