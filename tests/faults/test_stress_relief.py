"""A part left strained by a stop is relieved, step by step as a supervisor asks; all unmodelled errors are on."""

from __future__ import annotations

import asyncio
import itertools

import numpy as np
import pytest

from docking.assemble.relieving import tare_of
from docking.assemble.runs import Files
from docking.errors import BadArgument
from docking.operators import AutomaticOperator
from docking.state import Event, State
from tests.support.dry_cell import DryCell, files, run_dry
from tests.support.strained_cell import ReliefCase, Strained, relieved, warp_mm

SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(2, 13))]


class Declining(AutomaticOperator):
    """Says no to the first plan."""

    async def confirm(self, plan, shown) -> Event:
        return Event.DECLINED


def assert_single_axes_moved_slowly(case: ReliefCase) -> None:
    """Every step moves an axis by 0.05 mm at most, at 0.1 mm/s at most, and each was asked for and intended before."""
    for plan in case.bodies("plan"):
        assert plan["kind"] == "relief"
        assert max(map(abs, plan["displacement_mm"].values())) <= 0.05 * (1.0 + 1e-9)
    times_mm = np.array(case.position_mm)
    assert np.abs(np.diff(times_mm, axis=0)).max() <= 0.1 * 0.1 + 0.002, "an axis went faster than 0.1 mm/s"
    order = [kind for kind, _ in case.records if kind in ("confirm", "intent", "moved")]
    assert order == ["confirm", "intent", "moved"] * (len(order) // 3) + ["confirm"] * (len(order) % 3)
    assert all(body["supervisor"] == "A. Smith" for body in case.bodies("confirm"))


@pytest.mark.parametrize("seed", SEEDS)
def test_one_and_a_half_kilonewton_of_warp_are_brought_under_a_fifth(seed, tmp_path):
    case = relieved(Strained("fuselage-can", seed, warp_mm("fuselage-can", "B.Z", 1500.0)), tmp_path / "r.jsonl")
    assert case.state is State.IDLE, case.alarms()
    assert 1400.0 < case.internal_n[case.step_starts[0]] < 1700.0
    assert case.far.plant.true_internal_force_n() < 200.0
    assert case.worst_rise() <= 0.05
    assert max(case.internal_n) <= 1.05 * case.internal_n[case.step_starts[0]]
    assert_single_axes_moved_slowly(case)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_laboratory_dummy_is_relieved_on_either_bus(name, seed, tmp_path):
    """A tenth of the forces of the full-size cell, less where a ball would lift; 5 um of an axis are 10 N here."""
    case = relieved(Strained(name, seed, warp_mm(name, "B.Z", 50.0)), tmp_path / "r.jsonl")
    assert case.state is State.IDLE, case.alarms()
    assert case.internal_n[case.step_starts[0]] > 40.0
    assert case.far.plant.true_internal_force_n() < 20.0
    rises = [
        np.max(case.ball_n[a:b], axis=0) - case.ball_n[a]
        for a, b in itertools.pairwise([*case.step_starts, len(case.ball_n)])
    ]
    assert np.max(rises) <= 20.0, "over what axes coming to rest anew explain"
    assert_single_axes_moved_slowly(case)


def test_two_axes_that_stand_off_sideways_and_down_are_relieved_together(tmp_path):
    offsets = {"A.X": 0.06, "C.Z": -0.15}
    case = relieved(Strained("fuselage-can", 3, offsets), tmp_path / "r.jsonl")
    assert case.state is State.IDLE, case.alarms()
    assert case.internal_n[case.step_starts[0]] > 900.0
    assert case.far.plant.true_internal_force_n() < 250.0
    assert case.worst_rise() <= 0.05


def test_without_a_weighing_before_the_operator_is_told_what_the_load_cells_cannot_tell(tmp_path):
    strained = Strained("fuselage-can", 2, warp_mm("fuselage-can", "B.Z", 1500.0), tared=False)
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.IDLE, case.alarms()
    assert any("ABSOLUTE" in text for text in case.said)
    sigma_n = case.bodies("strain")[-1]["sigma_n"]
    assert 150.0 < sigma_n < 300.0
    assert case.far.plant.true_internal_force_n() < 200.0 + 2.0 * sigma_n
    assert case.worst_rise() <= 0.05


def test_nothing_moves_in_a_part_that_is_not_strained(tmp_path):
    case = relieved(Strained("lab-can", 4, {}), tmp_path / "r.jsonl")
    assert case.state is State.IDLE
    assert not case.bodies("plan")
    assert not case.bodies("intent")


@pytest.mark.parametrize("steps", [0, 2])
def test_it_moves_only_as_long_as_the_supervisor_asks(steps, tmp_path):
    strained = Strained("lab-can", 1, warp_mm("lab-can", "B.Z", 50.0), steps=steps)
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.RECOVER
    assert len(case.bodies("intent")) == steps
    assert case.bodies("confirm")[-1]["go"] is False


@pytest.mark.parametrize("event", [Event.HOLD, Event.ABORT])
def test_letting_go_in_a_step_stops_it(event, tmp_path):
    strained = Strained(
        "fuselage-can",
        1,
        warp_mm("fuselage-can", "B.Z", 1500.0),
        while_moving=lambda case: case.controller.post(event),
    )
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.RECOVER
    (moved,), (plan,) = case.bodies("moved"), case.bodies("plan")
    assert moved["result"] == "stopped"
    assert 0.0 < moved["path_time_s"] < plan["duration_s"]


def test_a_ball_whose_force_rises_stops_the_step(tmp_path):
    """The load cell of a ball shows 900 N more while a step runs: the guard stops it on its way."""

    def push(case: ReliefCase) -> None:
        case.far.plant.misread_force("A.Z", 900.0)

    strained = Strained("fuselage-can", 1, warp_mm("fuselage-can", "B.Z", 1500.0), while_moving=push)
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.FAULT
    assert case.alarms() == [(2131, "ball A")]
    (moved,), (plan,) = case.bodies("moved"), case.bodies("plan")
    assert moved["result"] == "stopped"
    assert moved["path_time_s"] < plan["duration_s"]


def test_a_ball_whose_force_rises_after_the_step_ends_it(tmp_path):
    """The step is over and its guard with it when the load cell of a ball shows 900 N more: seen by the weighing."""

    def push_later(case: ReliefCase) -> None:
        asyncio.get_running_loop().call_later(1.2, case.far.plant.misread_force, "A.Z", 900.0)

    strained = Strained("fuselage-can", 1, warp_mm("fuselage-can", "B.Z", 1500.0), while_moving=push_later)
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.FAULT
    assert case.alarms() == [(2131, "ball A")]
    (moved,), (plan,) = case.bodies("moved"), case.bodies("plan")
    assert moved["result"] == "done"
    assert plan["duration_s"] < 1.2


def test_an_axis_that_does_not_give_ends_it(tmp_path):
    """The load cells show strain that no step takes away: a cell that stands still at a wrong value."""

    def hold_reading(case: ReliefCase) -> None:
        plant = case.far.plant
        start = case.strained.__dict__.setdefault("reading", plant.true_axis_forces_n())
        for axis, was, now in zip(plant.axes, start, plant.true_axis_forces_n(), strict=True):
            plant.misread_force(axis, float(was - now))

    strained = Strained(
        "fuselage-can", 1, warp_mm("fuselage-can", "B.Z", 1000.0), each=hold_reading, while_moving=hold_reading
    )
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.FAULT
    assert case.alarms()[0][0] in (2131, 2132)
    assert len(case.bodies("intent")) <= 10


@pytest.mark.parametrize(("tared", "push_n"), [(True, 300.0), (False, 1500.0)])
def test_a_part_that_touches_something_is_not_pulled_against_it(tared, push_n, tmp_path):
    """The same push sideways at every ball is neither weight nor strain. Nothing moves."""

    def leaning(case: ReliefCase) -> None:
        for axis in ("A.Y", "B.Y", "C.Y", "D.Y"):
            case.far.plant.misread_force(axis, push_n)

    strained = Strained("fuselage-can", 1, warp_mm("fuselage-can", "B.Z", 1500.0), tared=tared, before=leaning)
    case = relieved(strained, tmp_path / "r.jsonl")
    assert case.state is State.FAULT
    assert case.alarms()[0][0] == 2133
    assert not case.bodies("intent")


def test_the_weighing_of_the_run_before_is_found_in_its_journal(tmp_path):
    """A docking that the operator declines has weighed the part; the journal of another part has not."""
    cell, job = files("lab-can")

    def declined(run: DryCell) -> None:
        run.controller.procedure.operator = Declining([].append)
        run.journal.write("run_started", started)

    started = {"part_number": job.part_number, "serial_number": job.serial_number, "axes": list(cell.axis_names)}
    run = run_dry("lab-can", 1, tmp_path, declined)
    assert run.plans == []
    tare = tare_of(run.journal_path, Files(cell, job, tmp_path))
    weight_n = 9.80665 * job.component.mass_kg
    assert tare.weighing.force_n[2::3].sum() == pytest.approx(weight_n, rel=0.03)
    assert tare.weighing.position_mm == pytest.approx(run.rest_mm, abs=0.02)
    assert 0.0 <= tare.age_h < 0.1
    other = job.model_copy(update={"serial_number": "another"})
    with pytest.raises(BadArgument, match="no weighing of this part"):
        tare_of(run.journal_path, Files(cell, other, tmp_path))
