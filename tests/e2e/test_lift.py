"""The laboratory dummy is lifted off its stand, weighed and levelled before it is aligned and docked; virtual time."""

from __future__ import annotations

import json

import numpy as np
import pytest

from docking.cli import call
from docking.errors import ConfigInvalid
from docking.state import Event, State
from tests.e2e.test_retreat import Person
from tests.support.dry_cell import CELLS, DryCell, run_dry
from tests.support.program import cell_copy

JOB = "lab-can-lift"
UP = np.array([0.0, 0.0, 1.0])


def tilt_deg(run: DryCell) -> float:
    """True tilt of the component, which is level when docked."""
    return float(np.degrees(np.arccos(min(1.0, run.far.plant.component_pose_W().R[2, 2]))))


def test_the_part_is_lifted_weighed_levelled_and_docked(tmp_path):
    tilts, heights = [], []

    def scenario(run: DryCell) -> None:
        def hear(kind: str, body: dict) -> None:
            if kind == "moved":
                tilts.append(tilt_deg(run))
                heights.append(float(run.far.plant.component_pose_W().t_mm[2]))

        run.journal.hooks.append(hear)
        run.on_move(lambda plan: heights.append(float(run.far.plant.component_pose_W().t_mm[2])))

    run = run_dry("lab-can", 1, tmp_path, scenario, JOB)
    assert run.state is State.DOCKED, run.alarms()
    assert [plan.kind for plan in run.plans][:4] == ["lift", "level", "align", "approach"]
    lift, level = run.plans[:2]
    assert heights[1] - heights[0] == pytest.approx(10.0, abs=0.05)
    assert tilts[0] > 0.1
    assert tilts[1] < 0.02, "level before it is aligned"
    for plan in (lift, level):
        assert plan.bounds is not None
        assert np.abs(np.diff(plan.q_mm, axis=0)).max() / plan.period_s <= 5.0 * (1 + 1e-6)
        assert run.figure_gap_mm(plan.q_mm, plan).max() < 1e-6
    states = run.states()
    at = states.index("lift")
    before, after = ["measure", "fit", "verify"], ["confirm", "move", "settle"]
    assert states[at - 3 : at] == before
    assert states[at + 1 : at + 5] == [*after, "take-load"]
    assert states[at + 5 : at + 12] == [*before, "level", *after]
    (load,) = run.records("load")
    assert load["mass_kg"] == pytest.approx(60.0, abs=0.6 + 3.0 * load["mass_sigma_kg"])
    assert run.records("confirm")[0]["go"]
    first = run.records("features")[0]
    assert (first["stage"], first["when"]) == ("align", "before")


@pytest.mark.full
@pytest.mark.parametrize("seed", range(2, 8))
def test_it_docks_with_every_seed(seed, tmp_path):
    run = run_dry("lab-can", seed, tmp_path, lambda run: None, JOB)
    assert run.state is State.DOCKED, run.alarms()


def test_another_part_is_told_by_its_weight_and_goes_nowhere(tmp_path):
    def scenario(run: DryCell) -> None:
        run.far.plant.misread_force("A.Z", 40.0)

    run = run_dry("lab-can", 1, tmp_path, scenario, JOB)
    assert run.state is State.FAULT
    assert run.alarms() == [(2135, "mass in kg, off the job's")]
    assert [plan.kind for plan in run.plans] == ["lift"]
    assert run.drift_mm < 0.005


def test_the_first_correction_may_be_as_large_after_the_lift_as_without(tmp_path):
    """Seed 3 begins farther beside the station than a later one may be corrected by at 16 mm."""

    def scenario(run: DryCell) -> None:
        run.controller.procedure.operator = Person([].append, [], {4: Event.DECLINED})

    run = run_dry("lab-can", 3, tmp_path, scenario, JOB)
    assert run.alarms() == []
    assert [plan.kind for plan in run.plans] == ["lift", "level", "align"]
    assert float(np.linalg.norm(run.plans[2].correction.shift_mm)) > 0.2 * 16.0


def test_docking_plan_shows_lift_and_level(capsys):
    arguments = ["plan", str(CELLS / "lab-can.toml"), str(CELLS / f"{JOB}.job.toml"), "--from", "1,0,0,0.2,-0.1,0"]
    assert call([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    lift, level, align = told["stages"][:3]
    assert [s["stage"] for s in (lift, level, align)] == ["lift", "level", "align"]
    assert (lift["kind"], lift["asked_mm_s"]) == ("lift", 5.0)
    assert [lift["displacement_mm"][f"{p}.Z"] for p in "ABCD"] == pytest.approx([10.0] * 4, abs=0.01)
    turned = np.array(level["correction"]["rotvec_deg"])
    assert turned == pytest.approx([-0.2, 0.1, 0.0], abs=1e-3)
    assert np.abs(align["correction"]["rotvec_deg"]).max() < 1e-3
    assert call(arguments) == 0
    assert "lift: stand-off 16 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([(".toml", "load_cell = true", "load_cell = false")], "positioner A has no load_cell"),
        ([(".job.toml", 'start = "seated"', 'start = "seated"\nlift_mm = 24.5')], "would stand at"),
        ([(".job.toml", 'start = "seated"', 'start = "seated"\nlift_mm = -1.0')], "lift_mm"),
        ([(".job.toml", 'start = "seated"', 'start = "empty"\nlift_mm = 10.0')], "homing and ball entry"),
    ],
)
def test_a_lift_that_the_cell_cannot_make_is_refused_by_the_check(changes, said, tmp_path, capsys):
    lifted = (
        [] if "lift_mm" in changes[0][2] else [(".job.toml", 'start = "seated"', 'start = "seated"\nlift_mm = 10.0')]
    )
    cell = cell_copy(tmp_path, "lab-can", *changes, *lifted)
    assert call(["check", str(cell), "--json"]) == ConfigInvalid.exit_code
    assert said in capsys.readouterr().out
