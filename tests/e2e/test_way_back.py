"""Several moves back with one confirmation: blocked view, a mate in the way, a force that rises; virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.state import Event, State
from docking.types import Pose
from tests.e2e.test_retreat import Person, blocked_view
from tests.support.dry_cell import DryCell, run_dry

FORWARD = ["lift", "level", "align", "approach", "approach"]
"""The moves of the lifted laboratory dummy as far as 3 mm before its mate."""


def blocked_at_3_mm(folder: Path, moves: int, scenario: Callable[[DryCell], None], more: int = 0) -> DryCell:
    """View blocked 3 mm before the mate; `moves` back; then `more` further moves are confirmed, and no others."""
    heard: list[str] = []
    person = Person(heard.append, [Event.RETREAT], {len(FORWARD) + 2 + more: Event.DECLINED})
    person.moves, person.heard = moves, heard  # type: ignore[attr-defined]

    def prepare(run: DryCell) -> None:
        run.controller.procedure.operator = person
        blocked_view(run, len(FORWARD), "retreat")
        scenario(run)

    run = run_dry("lab-can", 1, folder, prepare, "lab-can-lift")
    run.person = person  # type: ignore[attr-defined]
    return run


def when_blocked(run: DryCell, call: Callable[[], None]) -> None:
    run.journal.hooks.append(lambda kind, body: call() if kind == "unseen" else None)


def kinds(run: DryCell) -> list[str]:
    return [plan.kind for plan in run.plans]


def test_back_to_the_stand_off_with_one_confirmation_and_no_fit(tmp_path):
    run = blocked_at_3_mm(tmp_path, 2, lambda run: None)
    assert run.state is State.RECOVER, run.alarms()
    assert run.person.places == [("approach-8", "align", "level", "lift", "start")]
    assert kinds(run) == [*FORWARD, "retreat", "retreat"]
    assert run.records("retreat") == [{"moves": 2, "to": "align"}]
    for back, there in zip(run.plans[5:], (run.plans[4], run.plans[3]), strict=True):
        np.testing.assert_allclose(back.q_mm[[0, -1]], there.q_mm[[-1, 0]], atol=1e-3)
        assert run.figure_gap_mm(back.q_mm, back).max() < 1e-6
        assert back.bounds is not None
        assert back.bounds.clearance_mm > 0.0, "the way back was checked against the mate"
    assert run.person.asked == len(FORWARD) + 2, "one question for the whole way back, one for the next move"
    gone = [c for c in run.records("confirm") if "further" in c]
    assert [(c["go"], len(c["further"])) for c in gone] == [(True, 1), (True, 0)]
    states = run.states()
    at = states.index("blocked")
    again = ["retreat", "confirm-retreat", "move", "settle"]
    assert states[at + 1 : at + 11] == [*again, *again, "measure", "fit"]
    assert run.drift_mm < 0.005


@pytest.mark.full
def test_all_the_way_back_ends_where_the_part_was_seated(tmp_path):
    """Lowered again, it would be lifted again: the lift is asked for anew."""
    run = blocked_at_3_mm(tmp_path, 5, lambda run: None)
    assert kinds(run) == [*FORWARD, *["retreat"] * 5]
    np.testing.assert_allclose(run.plans[-1].q_mm[-1], run.plans[0].q_mm[0], atol=1e-3)
    assert run.controller.procedure.progress.plan.kind == "lift"


@pytest.mark.full
def test_after_a_way_back_the_part_is_docked(tmp_path):
    run = blocked_at_3_mm(tmp_path, 4, lambda run: None, more=99)
    assert run.state is State.DOCKED, run.alarms()
    assert kinds(run)[: len(FORWARD) + 4] == [*FORWARD, *["retreat"] * 4]


def moved_mate(run: DryCell, shift_mm: list[float]) -> None:
    """The mate is pushed aside for good, and stands where it then is."""
    drifting = run.far.plant._mate_pose
    at = drifting.at
    drifting.at = lambda elapsed_s: Pose(at(elapsed_s).R, at(elapsed_s).t_mm + shift_mm)  # type: ignore[method-assign]


def hooked(run: DryCell) -> None:
    """The mate reaches behind the rear edge of the dummy, 8 mm behind where it stood at the first station."""
    known = run.controller.procedure.known
    mate = known.settings.plan.mate
    rear = float(mate.edges_C_mm[:, :, 0].min() - mate.face_C_mm[0]) - 16.0
    hook = np.array([[[rear - 40.0, 200.0, -160.0], [rear - 8.0, 400.0, 160.0]]])
    guarded = replace(mate, boxes_M_mm=np.concatenate([mate.boxes_M_mm, hook]))
    known.settings = replace(known.settings, plan=replace(known.settings.plan, mate=guarded))


@pytest.mark.parametrize("shift_mm", [pytest.param(0.0, marks=pytest.mark.full), 12.0])
def test_a_mate_that_moved_into_the_way_is_found_and_refused(shift_mm, tmp_path):
    def scenario(run: DryCell) -> None:
        hooked(run)
        when_blocked(run, lambda: moved_mate(run, [shift_mm, 0.0, 0.0]) if shift_mm else None)

    run = blocked_at_3_mm(tmp_path, 2, scenario)
    if shift_mm == 0.0:
        assert kinds(run) == [*FORWARD, "retreat", "retreat"]
        return
    assert run.state is State.FAULT
    ((code, where),) = run.alarms()
    assert (code, where) == (5013, "box 1 of the mate")
    assert kinds(run) == FORWARD
    assert run.drift_mm < 0.005


@pytest.mark.full
def test_a_mate_that_is_not_seen_either_counts_where_it_was(tmp_path):
    def scenario(run: DryCell) -> None:
        shoot = run.far.instrument.shoot
        dark: list[bool] = []
        when_blocked(run, lambda: dark.append(True))
        run.on_move(lambda plan: dark.clear())
        run.far.instrument.shoot = lambda name, *rest, **more: shoot(  # type: ignore[method-assign]
            "nothing there" if dark and name.startswith("M") else name, *rest, **more
        )

    run = blocked_at_3_mm(tmp_path, 2, scenario)
    assert kinds(run) == [*FORWARD, "retreat", "retreat"]


@pytest.mark.parametrize("axis", [pytest.param("C.Z", marks=pytest.mark.full), "B.Y"])
def test_a_force_that_rises_on_the_way_back_stops_it_on_the_path(axis, tmp_path):
    def scenario(run: DryCell) -> None:
        def catch(plan: Any) -> None:
            if plan.kind == "retreat":
                run.loop.call_later(0.5 * plan.duration_s, run.far.plant.misread_force, axis, 70.0)

        run.on_move(catch)

    run = blocked_at_3_mm(tmp_path, 2, scenario)
    assert run.state is State.FAULT
    assert run.alarms() == [(2131, f"ball {axis[0]}")]
    assert kinds(run) == [*FORWARD, "retreat"]
    moved = run.records("moved")[-1]
    assert moved["result"] == "stopped"
    assert 0.3 < moved["path_time_s"] / run.plans[-1].duration_s < 0.95
    assert run.figure_gap_mm(run.setpoints_mm()[1], run.plans[-1]).max() <= 0.002
    assert run.drift_mm < 0.005


class Slower:
    """The motion side on a computer that has become slow: no move faster than this."""

    def __init__(self, motion: Any, speed_limit_mm_s: float) -> None:
        self._motion, self.speed_limit_mm_s = motion, speed_limit_mm_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._motion, name)


@pytest.mark.full
def test_a_move_back_that_is_not_as_it_was_shown_is_asked_for_again(tmp_path):
    """The permitted speed falls after the first of three moves back: the second is asked for by itself."""

    def scenario(run: DryCell) -> None:
        known = run.controller.procedure.known

        def slow(kind: str, body: dict[str, Any]) -> None:
            if kind == "moved" and kinds(run)[-1:] == ["retreat"]:
                known.motion = Slower(run.controller.procedure.motion, 0.5)

        run.journal.hooks.append(slow)

    run = blocked_at_3_mm(tmp_path, 3, scenario, more=1)
    assert kinds(run) == [*FORWARD, "retreat", "retreat"]
    assert [len(c["further"]) for c in run.records("confirm") if "further" in c] == [2, 0]
    assert any("not the one that was shown" in text for text in run.person.heard)
    assert np.abs(np.diff(run.plans[-1].q_mm, axis=0)).max() / run.plans[-1].period_s <= 0.5 * (1 + 1e-6)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "after", "moves"),
    [("fuselage-can", 4, 3), ("follower-can", 4, 3), ("lab-modbus", 2, 1), ("lab-modbus", 2, 2)],
)
def test_every_kind_of_cell_goes_back_from_10_mm_to_its_stand_off(name, after, moves, tmp_path):
    person = Person([].append, [Event.RETREAT], {after + 2: Event.DECLINED})
    person.moves = moves

    def prepare(run: DryCell) -> None:
        run.controller.procedure.operator = person
        blocked_view(run, after, "retreat")

    run = run_dry(name, 1, tmp_path, prepare)
    assert run.state is State.RECOVER, run.alarms()
    assert kinds(run)[after:] == ["retreat"] * moves
    assert run.plans[-1].q_mm[-1] == pytest.approx(run.plans[after - moves].q_mm[0], abs=0.05)


@pytest.mark.full
def test_a_way_back_that_is_declined_moves_nothing(tmp_path):
    run = blocked_at_3_mm(tmp_path, 3, lambda run: None, more=-1)
    assert run.state is State.RECOVER
    assert kinds(run) == FORWARD
