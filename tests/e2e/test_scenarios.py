"""Scenario files: every one of the examples ends as it says, everything unknown is named with what there is."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.assemble.requests import RunRequest
from docking.assemble.runs import dry_run
from docking.assemble.scenarios import runner_of
from docking.assemble.simulated import make_far_end, truth_of, virtual_wires
from docking.cli import call
from docking.errors import ConfigInvalid
from docking.journal import read
from sim.canopen.faults import DriveFaults
from sim.fault_book import FaultBook
from sim.scenario import load_scenario
from sim.virtual_time import run_virtual
from tests.support.dry_cell import CELLS, DryCell, files, run_dry
from tests.support.rigid_figure import path_gap_mm

SCENARIOS = sorted((CELLS.parent / "scenarios").glob("*.toml"))
QUICK = {
    "lab-can": ("crane-moves-in", "emergency-stop", "sensor-broken", "axis-jams"),
    "lab-modbus": ("gate-opened", "inputs-silent"),
}


def cases() -> list[Any]:
    return [
        pytest.param(name, path, id=f"{name}-{path.stem}", marks=[] if path.stem in quick else [pytest.mark.full])
        for name, quick in QUICK.items()
        for path in SCENARIOS
    ]


def run(scenario: Path, name: str, folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Summary and journal of a dry run."""
    journal = folder / "run.jsonl"
    request = RunRequest(CELLS / f"{name}.toml", None, 1, None, journal, "en", scenario)
    return dry_run(request, lambda text: None), read(journal)


@pytest.mark.parametrize(("name", "path"), cases())
def test_every_example_ends_as_it_says(name, path, tmp_path):
    summary, records = run(path, name, tmp_path)
    scenario = load_scenario(path)
    assert scenario.expected is not None
    assert summary["outcome"] == scenario.expected.outcome, summary["alarms"]
    assert summary["scenario"] == {"name": scenario.name, "as_expected": True}
    told = [r["body"] for r in records if r["kind"] == "scenario"]
    assert [(t["device"], t["fault"]) for t in told if t["what"] == "begins"] == [
        (e.device, e.fault) for e in scenario.event
    ]


def test_an_event_happens_at_its_place_on_the_path_of_the_stage_it_names(tmp_path):
    text = (
        'schema_version = 1\nname = "n"\n'
        '[[event]]\nat_state = "move"\nstage = "approach-3"\ns = 0.4\ndevice = "gate"\nfault = "press"\n'
    )
    path = tmp_path / "s.toml"
    path.write_text(text)
    _, records = run(path, "lab-can", tmp_path)
    moved = [r["body"] for r in records if r["kind"] == "moved"]
    assert [body["result"] for body in moved] == ["done", "fault"]
    plan = [r["body"] for r in records if r["kind"] == "plan"][-1]
    assert plan["stage"] == "approach-3"
    begins_s = next(r["t_mono_s"] for r in records if r["kind"] == "scenario")
    trace = moved[1]["trace"]
    at = int(np.argmin(np.abs(np.array(trace["t_s"]) - begins_s)))
    axis = max(plan["displacement_mm"], key=lambda name: abs(plan["displacement_mm"][name]))
    # The way that the fastest axis has behind it, by the journal's own read-backs every 0.1 s.
    went = [row - trace["position_mm"][axis][0] for row in trace["position_mm"][axis]]
    assert went[at] / plan["displacement_mm"][axis] == pytest.approx(0.4, abs=0.06)


def test_a_fallen_permissive_stops_all_axes_on_the_path_and_leaves_them_off(tmp_path):
    def scenario(run: DryCell) -> None:
        run.on_move(lambda plan: run.loop.call_later(0.5 * plan.duration_s, run.far.world.hold, "area_clear", False))

    cell = run_dry("lab-can", 1, tmp_path, scenario)
    assert cell.alarms() == [(2143, "area_clear")]
    assert cell.left_on == []
    assert cell.drift_mm == 0.0
    plan = cell.plans[0]
    way = plan.displacement_mm
    share = float((cell.rest_mm - plan.q_mm[0]) @ way / (way @ way))
    assert 0.3 < share < 0.95
    assert path_gap_mm(plan.q_mm, cell.rest_mm).max() <= 0.02
    assert cell.figure_gap_mm(cell.setpoints_mm()[1], plan).max() <= 0.002


@pytest.mark.parametrize("step", [True, False])
def test_letting_the_enabling_device_go_stops_a_move_that_a_person_asked_for(step, tmp_path):
    def scenario(run: DryCell) -> None:
        procedure = run.controller.procedure
        if step:
            procedure.known.settings = dataclasses.replace(procedure.known.settings, enabling=("enabling",))
        run.on_move(lambda plan: run.loop.call_later(0.5 * plan.duration_s, run.far.world.hold, "enabling", False))

    cell = run_dry("lab-can", 1, tmp_path, scenario)
    assert cell.alarms() == ([(2143, "enabling")] if step else [])
    assert cell.state.value == ("fault" if step else "docked")


def test_the_component_that_is_warmer_than_stated_is_fitted_by_its_sensor(tmp_path):
    """2 K over the stated temperature: 23e-6/K over 0.9 m are 41 um, which the sensor takes out of the fit."""

    def scenario(run: DryCell) -> None:
        run.far.plant.heat("component", 2.0)

    cell = run_dry("lab-can", 2, tmp_path, scenario)
    rows = {row["part"]: row for row in cell.records("temperature")}
    true_c = cell.far.plant.temperatures_c(cell.ended_at_s)["component"]
    assert abs(rows["component"]["used_c"] - true_c) < 3.0 * rows["component"]["used_sigma_k"]
    assert rows["component"]["used_c"] > 21.0
    assert rows["mate"]["used_c"] < 21.0
    assert cell.state.value == "docked"


# unknown names ---------------------------------------------------------------------------------------------------
def problems(text: str, tmp_path: Path, name: str = "lab-can", *, with_cell: bool = True) -> str:
    path = tmp_path / "scenario.toml"
    path.write_text('schema_version = 1\nname = "n"\n' + text)

    async def main() -> str:
        cell, job = files(name)
        far = make_far_end(cell, job, truth_of(CELLS / f"{name}.toml"), 1)
        await virtual_wires(cell, far)
        try:
            runner_of(load_scenario(path), path, cell, far, lambda what, event: None, job if with_cell else None)
        except ConfigInvalid as error:
            return str(error)
        finally:
            await far.close()
        return ""

    return run_virtual(main)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ('at_s = 1\ndevice = "A.Q"\nfault = "stuck"', ("event[0].device", "'A.Q'", "A.X", "tracker", "crane_free")),
        ('at_s = 1\ndevice = "A.X"\nfault = "stick"', ("event[0].fault", "'stick'", "stuck", "lose_read_back")),
        ('at_s = 1\ndevice = "A.X"\nfault = "warn"', ("needs the value code",)),
        ('at_s = 1\ndevice = "A.X"\nfault = "warn"\nvalues = { cod = 1 }', ("'cod'", "it takes code")),
        ('at_s = 1\ndevice = "A.X"\nfault = "warn"\nvalues = { code = "x" }', ("wrong type",)),
        ('at_s = 1\ndevice = "A.X"\nfault = "restart"\nfor_s = 1.0', ("for_s", "nothing takes")),
        ('at_state = "moving"\ndevice = "A.X"\nfault = "stuck"', ("at_state", "'moving'", "move, paused")),
        ('at_state = "move"\nstage = "aline"\ndevice = "A.X"\nfault = "stuck"', ("'aline'", "align, approach-3, dock")),
        ('device = "A.X"\nfault = "stuck"', ("either at_s or at_state",)),
        ('at_s = 1\nat_state = "move"\ndevice = "A.X"\nfault = "stuck"', ("either at_s or at_state",)),
        ('at_s = 1\ns = 0.5\ndevice = "A.X"\nfault = "stuck"', ("belong to at_state",)),
        ('at_s = -1\ndevice = "A.X"\nfault = "stuck"', ("event[0].at_s",)),
        ('at_s = 1\ndevice = "A.X"\nfault = "stuck"\nfor = 1', ("event[0].for",)),
    ],
)
def test_what_is_wrong_is_named_with_what_there_is(event, words, tmp_path):
    told = problems(f"[[event]]\n{event}\n", tmp_path)
    for word in words:
        assert word in told, told


def test_without_a_cell_in_reach_only_times_count(tmp_path):
    told = problems('[[event]]\nat_state = "move"\ndevice = "A.X"\nfault = "stuck"\n', tmp_path, with_cell=False)
    assert "only at_s counts" in told


def test_all_problems_of_a_file_come_at_once(tmp_path):
    two = '[[event]]\nat_s = 1\ndevice = "Q"\nfault = "x"\n[[event]]\nat_s = 1\ndevice = "A.X"\nfault = "y"\n'
    told = problems(two, tmp_path)
    assert "event[0].device" in told
    assert "event[1].fault" in told


def test_every_hook_of_the_devices_is_in_the_book():
    """A hook that is added to drives or trackers cannot be forgotten here."""

    async def main() -> dict[str, dict[str, Any]]:
        cell, job = files("lab-can")
        far = make_far_end(cell, job, truth_of(CELLS / "lab-can.toml"), 1)
        await virtual_wires(cell, far)
        fields = {field.name for field in dataclasses.fields(far.devices[0].faults)}
        book = FaultBook(cell, far.plant, far.world, far.devices).devices
        await far.close()
        assert fields <= set(book["tracker"])
        return book

    book = run_virtual(main)
    hooks = {name for name in vars(DriveFaults) if not name.startswith("_")} - {"shown_mm"}
    named = set(book["A.X"]) | set(book["bus"])
    assert hooks <= named


def test_a_cell_that_is_not_simulated_takes_no_scenario(tmp_path, capsys):
    for name in ("lab-can.toml", "lab-can.job.toml"):
        shutil.copy(CELLS / name, tmp_path / name)
    scenario = str(SCENARIOS[0])
    for command in ("dry-run", "sim"):
        assert call([command, str(tmp_path / "lab-can.toml"), "--scenario", scenario]) == 2
        told = capsys.readouterr().err
        assert "is not simulated" in told
        assert "lab-can.sim.toml" in told


def test_an_unknown_name_ends_a_dry_run_with_2_and_one_json_object(tmp_path, capsys):
    path = tmp_path / "s.toml"
    path.write_text('schema_version = 1\nname = "n"\n[[event]]\nat_s = 1\ndevice = "A.Q"\nfault = "stuck"\n')
    assert call(["dry-run", str(CELLS / "lab-can.toml"), "--scenario", str(path), "--json"]) == 2
    body = json.loads(capsys.readouterr().out)
    assert "A.Q" in body["error"]["problems"][0]
