"""The line of sight is blocked: the operator clears it, or retreats without a fit; virtual time, whole cell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.operators import AutomaticOperator
from docking.state import Event, State
from tests.support.dry_cell import DryCell, run_dry


class Person(AutomaticOperator):
    """Answers what is listed: to a blocked view, and to the question for go."""

    def __init__(self, say, blocked: list[Event], confirm: dict[int, Event]) -> None:
        super().__init__(say)
        self._blocked, self._confirm, self.asked = blocked, confirm, 0
        self.retreatable: list[bool] = []
        self.places: list[tuple[str, ...]] = []
        self.moves = 1
        self.offered: list[bool] = []

    async def blocked(self, error, *, retreatable: bool) -> Event:
        self.retreatable.append(retreatable)
        return self._blocked.pop(0)

    async def how_far(self, places: tuple[str, ...]) -> int:
        self.places.append(places)
        return self.moves

    async def confirm(self, plan, shown: dict[str, Any]) -> Event:
        self.asked += 1
        self.offered.append(shown["retreatable"])
        return self._confirm.get(self.asked, Event.CONFIRMED)


def blocked_view(run: DryCell, after_moves: int, until: str) -> None:
    """No component target is seen from the end of a move on until a record of kind or state `until`."""
    instrument, shoot = run.far.instrument, run.far.instrument.shoot
    state = {"blocked": after_moves == 0, "moves": 0}

    def seen(name: str, *rest: Any, **more: Any) -> Any:
        hidden = state["blocked"] and name.startswith("J")
        return shoot("nothing there" if hidden else name, *rest, **more)

    def hear(kind: str, body: dict[str, Any]) -> None:
        if kind == "moved":
            state["moves"] += 1
            state["blocked"] = state["moves"] == after_moves
        if kind == until and state["moves"] >= after_moves:
            state["blocked"] = False

    instrument.shoot = seen  # type: ignore[method-assign]
    run.journal.hooks.append(hear)


def docked(name: str, folder: Path, person: Person, scenario: Any) -> DryCell:
    def prepare(run: DryCell) -> None:
        run.controller.procedure.operator = person
        scenario(run)

    return run_dry(name, 1, folder, prepare)


def since_last(run: DryCell, kind: str, before: int) -> list[str]:
    """Kinds of the records from the last `kind` before record `before` up to it."""
    kinds = [record["kind"] for record in run.all_records()[:before]]
    return kinds[len(kinds) - 1 - kinds[::-1].index(kind) :]


@pytest.mark.parametrize(
    ("name", "to_the_end"),
    [
        ("lab-can", False),
        pytest.param("lab-can", True, marks=pytest.mark.full),
        pytest.param("lab-modbus", True, marks=pytest.mark.full),
    ],
)
def test_a_retreat_reverses_the_last_move_without_a_fit_and_measures_again(name, to_the_end, tmp_path):
    person = Person([].append, [Event.RETREAT], {} if to_the_end else {5: Event.DECLINED})
    run = docked(name, tmp_path, person, lambda run: blocked_view(run, 2, "unseen"))
    assert run.state is (State.DOCKED if to_the_end else State.RECOVER), run.alarms()
    assert person.retreatable == [True]
    kinds = [plan.kind for plan in run.plans]
    assert kinds[:4] == ["align", "approach", "retreat", kinds[3]]
    assert "approach" in kinds[3:]
    there, back = run.plans[1], run.plans[2]
    assert back.q_mm[0] == pytest.approx(there.q_mm[-1], abs=1e-3)
    assert back.q_mm[-1] == pytest.approx(there.q_mm[0], abs=1e-3)
    assert run.figure_gap_mm(back.q_mm, back).max() < 1e-6
    states = run.states()
    at = states.index("blocked")
    assert states[at : at + 8] == [
        *("blocked", "retreat", "confirm-retreat", "move", "settle", "measure", "fit", "verify"),
    ]
    (unseen,) = run.records("unseen")
    assert unseen["answer"] == "retreat"
    records = run.all_records()
    retreated = [i for i, r in enumerate(records) if r["kind"] == "intent"][2]
    assert "fit" not in since_last(run, "moved", retreated)
    next_move = [i for i, r in enumerate(records) if r["kind"] == "intent"][3]
    assert "fit" in since_last(run, "moved", next_move)
    assert [r["kind"] for r in records].count("tare") == 1


def test_a_view_that_is_cleared_is_measured_again_without_any_move(tmp_path):
    person = Person([].append, [Event.AGAIN], {2: Event.DECLINED})
    run = docked("lab-can", tmp_path, person, lambda run: blocked_view(run, 1, "unseen"))
    assert run.state is State.RECOVER
    assert run.states().count("blocked") == 1
    assert [plan.kind for plan in run.plans].count("retreat") == 0


def test_nobody_there_means_a_fault_with_the_cause_of_the_measurement(tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: blocked_view(run, 1, "never"))
    assert run.state is State.FAULT
    assert [code for code, _ in run.alarms()] == [3001]
    assert len(run.plans) == 1
    assert run.drift_mm < 0.005


def test_before_the_first_move_there_is_nothing_to_go_back_to(tmp_path):
    person = Person([].append, [Event.RETREAT], {})

    run = docked("lab-can", tmp_path, person, lambda run: blocked_view(run, 0, "never"))
    assert person.retreatable == [False]
    assert run.state is State.FAULT
    assert run.alarms() == [(6002, "retreat")]
    assert run.plans == []


def test_the_operator_may_go_back_instead_of_on_as_far_as_the_component_came(tmp_path):
    """Asked for the second move the operator retreats; there is no way farther back than where the component began."""
    person = Person([].append, [], {2: Event.RETREAT, 4: Event.DECLINED})
    run = docked("lab-can", tmp_path, person, lambda run: None)
    assert run.state is State.RECOVER
    assert [plan.kind for plan in run.plans] == ["align", "retreat"]
    assert np.abs(run.plans[1].q_mm[-1] - run.plans[0].q_mm[0]).max() < 1e-3
    assert person.offered == [False, True, False, False]


def test_the_speed_is_set_for_the_rest_of_the_run_and_changes_no_path(tmp_path):
    """Half the speed from the middle of the first move on: every later move takes twice its time, on the same table."""

    def slow_down(run: DryCell) -> None:
        first = [True]

        def begin(plan: Any) -> None:
            if first.pop() if first else False:
                run.loop.call_later(0.5 * plan.duration_s, run.controller.override, 50.0)

        run.on_move(begin)

    run = docked("lab-can", tmp_path, Person([].append, [], {3: Event.DECLINED}), slow_down)
    assert run.state is State.RECOVER, run.alarms()
    assert {"verb": "override", "percent": 50.0} in run.records("command")
    for number, (plan, moved) in enumerate(zip(run.plans, run.records("moved"), strict=True)):
        t_s = moved["trace"]["t_s"]
        took_s = t_s[-1] - t_s[0]
        assert took_s == pytest.approx((1.5 if number == 0 else 2.0) * plan.duration_s, rel=0.1)
        assert moved["max_consistency_residual_mm"] < 0.1
