"""The state table against the rules of the cell, told again here as plain text and searched as a graph."""

from __future__ import annotations

import itertools
from collections import deque
from pathlib import Path

import pytest

from docking.errors import EventRefused
from docking.state import FINAL, TABLE, Effect, Event, Situation, State, diagram, page, step

ROOT = Path(__file__).parents[3]

EXPECTED = """
OFFLINE           LOAD                 STANDBY
STANDBY           CONNECT              STANDBY           CONNECT
STANDBY           CONNECTED            DISABLED
STANDBY           ABORT                RECOVER
DISABLED          ENABLE               DISABLED          ENABLE
DISABLED          ENABLED              IDLE
DISABLED          ABORT                RECOVER
IDLE              START_SEATED         MEASURE_FRAME     LOCATE
IDLE              START_EMPTY          HOMING            HOME
IDLE              ABORT                RECOVER
HOMING            HOMED                HOMED
HOMED             MEASURE_FRAME        MEASURE_FRAME     LOCATE
MEASURE_FRAME     FRAME_MEASURED       MEASURE           MEASURE
MEASURE_FRAME     FRAME_MEASURED_EMPTY BALL_ENTRY        ENTER_BALLS
MEASURE_FRAME     ABORT                RECOVER
BALL_ENTRY        BALLS_ENTERED        LOCK_BALLS        LOCK_BALLS
LOCK_BALLS        BALLS_LOCKED         MEASURE           MEASURE
MEASURE           MEASURED             FIT               FIT
MEASURE           UNSEEN               BLOCKED           OFFER
MEASURE           ABORT                RECOVER
BLOCKED           AGAIN                MEASURE           MEASURE
BLOCKED           RETREAT              RETREAT           PLAN_RETREAT
BLOCKED           ABORT                RECOVER
FIT               UNSEEN               BLOCKED           OFFER
FIT               FITTED               VERIFY            JUDGE
FIT               MEASURE_MORE         MEASURE           MEASURE
FIT               ABORT                RECOVER
VERIFY            LIFT_NEEDED          LIFT              LIFT
VERIFY            LEVEL_NEEDED         LEVEL             LEVEL
VERIFY            MOVE_NEEDED          PLAN              PLAN
LIFT              PLANNED              CONFIRM           ASK
LIFT              ABORT                RECOVER
LEVEL             PLANNED              CONFIRM           ASK
LEVEL             ABORT                RECOVER
TAKE_LOAD         LOAD_TAKEN           MEASURE           MEASURE
TAKE_LOAD         ABORT                RECOVER
VERIFY            MEASURE_MORE         MEASURE           MEASURE
VERIFY            ACCEPTED             DOCKED
VERIFY            NOT_ACCEPTED         OUT_OF_TOLERANCE
VERIFY            ABORT                RECOVER
PLAN              PLANNED              CONFIRM           ASK
PLAN              ABORT                RECOVER
CONFIRM           CONFIRMED            MOVE              MOVE
CONFIRM           DECLINED             RECOVER
CONFIRM           STALE                MEASURE           MEASURE
CONFIRM           RETREAT              RETREAT           PLAN_RETREAT
CONFIRM           ABORT                RECOVER
RETREAT           PLANNED              CONFIRM_RETREAT   ASK_BACK
RETREAT           ABORT                RECOVER
CONFIRM_RETREAT   CONFIRMED            MOVE              MOVE
CONFIRM_RETREAT   DECLINED             RECOVER
CONFIRM_RETREAT   ABORT                RECOVER
MOVE              HOLD                 PAUSED            HOLD
MOVE              MOVED                SETTLE            SETTLE
MOVE              ABORT                STOPPING          STOP
PAUSED            RESUME               MOVE              RESUME
PAUSED            MOVED                SETTLE            SETTLE
PAUSED            ABORT                STOPPING          STOP
STOPPING          STOPPED              RECOVER
STOPPING          MOVED                RECOVER
SETTLE            SETTLED              MEASURE           MEASURE
SETTLE            LIFTED               TAKE_LOAD         TAKE_LOAD
SETTLE            RETREAT              RETREAT           PLAN_RETREAT
SETTLE            ABORT                RECOVER
IDLE              START_RELIEF         RELIEVE           WEIGH
RELIEVE           STEP_ASKED           RELIEF_STEP       STEP
RELIEVE           RELEASED             RECOVER
RELIEVE           RELIEVED             IDLE
RELIEVE           ABORT                RECOVER
RELIEF_STEP       MOVED                RELIEVE           WEIGH
RELIEF_STEP       STOPPED              RECOVER
RELIEF_STEP       HOLD                 STOPPING          STOP
RELIEF_STEP       ABORT                STOPPING          STOP
FAULT             RESET                RECOVER
RECOVER           ENABLE               DISABLED          ENABLE
DOCKED            CLOSE                STANDBY
OUT_OF_TOLERANCE  CLOSE                STANDBY
"""
"""state, event, next state, what is done on entering it; `FAULTED` leads to FAULT from every state but FAULT."""

ALL = list(itertools.product(State, Event))


def expected() -> dict[tuple[State, Event], tuple[State, tuple[Effect, ...]]]:
    rows = {}
    for line in EXPECTED.strip().splitlines():
        state, event, target, *effects = line.split()
        rows[State[state], Event[event]] = State[target], tuple(Effect[e] for e in effects)
    rows |= {(s, Event.FAULTED): (State.FAULT, ()) for s in State if s is not State.FAULT}
    return rows


def after(*events: Event, start: Situation | None = None) -> Situation:
    situation = start or Situation()
    for event in events:
        situation, _ = step(situation, event)
    return situation


E = Event
TO_FIT = (E.LOAD, E.CONNECTED, E.ENABLED, E.START_SEATED, E.FRAME_MEASURED, E.MEASURED)
TO_MOVE = (*TO_FIT, E.FITTED, E.MOVE_NEEDED, E.PLANNED, E.CONFIRMED)


@pytest.mark.parametrize(("state", "event"), ALL, ids=lambda v: v.value)
def test_every_pair_leads_where_the_rules_say_or_is_refused(state, event):
    want = expected().get((state, event))
    before = Situation(state, position_known=False)
    if want is None:
        with pytest.raises(EventRefused) as refused:
            step(before, event)
        said = refused.value.text()
        assert state.value in said
        assert event.value in said
        for possible in (e.value for s, e in expected() if s is state):
            assert possible in said
        return
    situation, effects = step(before, event)
    assert (situation.state, effects) == want


def test_every_state_can_be_reached_and_left():
    rows = expected()
    reached = {State.OFFLINE} | {target for target, _ in rows.values()}
    assert reached == set(State)
    assert all(any(s is state for s, _ in rows) for state in State), "a state without a way out"


def reachable(start: Situation, *, without: set[Event] = frozenset()) -> set[Situation]:
    """All situations that any events but `without` can lead to."""
    seen, open_ends = {start}, deque([start])
    while open_ends:
        situation = open_ends.popleft()
        for event in set(Event) - without:
            try:
                following, _ = step(situation, event, "cause" if event is Event.FAULTED else None)
            except EventRefused:
                continue
            if following not in seen:
                seen.add(following)
                open_ends.append(following)
    return seen


@pytest.mark.parametrize("missing", [E.MEASURED, E.FITTED, E.PLANNED, E.CONFIRMED])
@pytest.mark.parametrize("origin", [State.FAULT, State.RECOVER, State.OFFLINE])
def test_nothing_moves_without_measuring_fitting_planning_and_a_confirmation(origin, missing):
    states = {s.state for s in reachable(Situation(origin), without={missing, E.RETREAT})}
    assert State.MOVE not in states
    assert missing in (E.MEASURED, E.FITTED) or State.MOVE not in {
        s.state for s in reachable(Situation(origin), without={missing})
    }, "a retreat needs no fit, but a plan and a confirmation"
    assert State.MOVE in {s.state for s in reachable(Situation(origin))}


@pytest.mark.parametrize("missing", [E.MEASURED, E.FITTED, E.PLANNED, E.CONFIRMED])
def test_a_second_move_needs_all_four_again(missing):
    settled = after(*TO_MOVE, E.MOVED)
    assert State.MOVE not in {s.state for s in reachable(settled, without={missing, E.RETREAT})}


def test_a_lift_is_planned_confirmed_and_weighed_before_anything_else_moves():
    lifted = after(*TO_FIT, E.FITTED, E.LIFT_NEEDED, E.PLANNED, E.CONFIRMED, E.MOVED, E.LIFTED)
    assert (lifted.state, lifted.position_known) == (State.TAKE_LOAD, False)
    weighed = {s.state for s in reachable(lifted, without={E.LOAD_TAKEN})}
    assert State.MOVE not in weighed - {s.state for s in reachable(Situation(State.RECOVER), without={E.LOAD_TAKEN})}
    level = after(E.LOAD_TAKEN, E.MEASURED, E.FITTED, E.LEVEL_NEEDED, start=lifted)
    assert (level.state, level.position_known) == (State.LEVEL, True)


def test_a_further_move_back_is_planned_and_confirmed_like_the_first():
    settled = after(*TO_MOVE, E.MOVED)
    for missing in (E.PLANNED, E.CONFIRMED):
        assert State.MOVE not in {s.state for s in reachable(settled, without={missing})}


def test_a_retreat_leads_back_to_a_measurement_or_farther_back():
    blocked = after(*TO_MOVE, E.MOVED, E.SETTLED, E.UNSEEN)
    assert (blocked.state, blocked.position_known) == (State.BLOCKED, False)
    back = after(E.RETREAT, E.PLANNED, E.CONFIRMED, start=blocked)
    assert back.state is State.MOVE
    settled = after(E.MOVED, start=back)
    measured = after(E.SETTLED, start=settled)
    assert (measured.state, measured.position_known) == (State.MEASURE, False)


@pytest.mark.parametrize("missing", [E.START_RELIEF, E.STEP_ASKED, E.ENABLED])
def test_no_single_axis_moves_unless_somebody_asks_for_the_step(missing):
    stepping = {s.state for s in reachable(Situation(), without={missing})}
    assert State.RELIEF_STEP not in stepping
    after_a_step = after(E.LOAD, E.CONNECTED, E.ENABLED, E.START_RELIEF, E.STEP_ASKED, E.MOVED)
    assert State.RELIEF_STEP not in {s.state for s in reachable(after_a_step, without={E.STEP_ASKED})}
    assert not any(s.position_known for s in reachable(after_a_step, without={E.FITTED}))


def test_a_paused_move_is_resumed_without_a_plan_but_a_stopped_one_is_not():
    paused = after(*TO_MOVE, E.HOLD)
    assert after(E.RESUME, start=paused).state is State.MOVE
    stopping = after(E.ABORT, start=paused)
    assert State.MOVE not in {s.state for s in reachable(stopping, without={E.CONFIRMED})}


def test_wherever_a_move_is_planned_or_confirmed_the_pose_is_known():
    for situation in reachable(Situation()):
        if situation.state in (State.VERIFY, State.PLAN, State.CONFIRM, State.DOCKED, State.OUT_OF_TOLERANCE):
            assert situation.position_known, situation
        if situation.state in (State.MOVE, State.PAUSED, State.STOPPING, State.SETTLE, State.FAULT, State.RECOVER):
            assert not situation.position_known, situation


def test_only_a_fit_makes_the_pose_known():
    for situation in reachable(Situation(), without={E.FITTED}):
        assert not situation.position_known, situation
    for state, event in expected():
        situation, _ = step(Situation(state, position_known=False), event)
        assert situation.position_known == (event is E.FITTED), (state, event)


@pytest.mark.parametrize("ending", [(E.FAULTED,), (E.ABORT,)])
def test_a_fault_or_a_stop_at_rest_revokes_the_pose(ending):
    verifying = after(*TO_FIT, E.FITTED)
    assert verifying.position_known
    assert not after(*ending, start=verifying).position_known


def test_a_move_revokes_the_pose_until_the_next_fit():
    moving = after(*TO_MOVE)
    assert not moving.position_known
    measured = after(E.MOVED, E.SETTLED, E.MEASURED, start=moving)
    assert not measured.position_known
    assert after(E.FITTED, start=measured).position_known


def test_the_first_cause_is_kept_until_the_reset():
    faulted, _ = step(after(*TO_MOVE), E.FAULTED, "axis B.Y lags")
    assert faulted.cause == "axis B.Y lags"
    with pytest.raises(EventRefused):
        step(faulted, E.FAULTED, "and the tracker is silent")
    recovering = after(E.RESET, start=faulted)
    assert recovering.cause is None
    again, _ = step(recovering, E.FAULTED, "node 4 is silent")
    assert again.cause == "node 4 is silent"


def test_a_run_ends_only_where_a_person_decides():
    assert set(FINAL) == {State.DOCKED, State.OUT_OF_TOLERANCE, State.RECOVER, State.FAULT}
    leaving = {event for (state, event) in expected() if state in FINAL}
    assert leaving == {E.CLOSE, E.RESET, E.ENABLE, E.FAULTED}


def test_step_changes_nothing_but_its_result():
    before = Situation(State.FIT, position_known=False, cause=None)
    step(before, E.FITTED)
    assert before == Situation(State.FIT, position_known=False, cause=None)


def test_the_diagram_draws_every_row_once():
    drawn = diagram()
    for (state, event), (target, _) in expected().items():
        arrow = f"    {state.name} --> {target.name}: {event.value}\n"
        folded = event is E.FAULTED or (event is E.ABORT and target is State.RECOVER)
        assert drawn.count(arrow) == (0 if folded else 1), arrow
    abort_note = next(line for line in drawn.splitlines() if "abort leads here" in line)
    for state, event in expected():
        if event is E.ABORT and TABLE[state, event].target is State.RECOVER:
            assert state.name in abort_note


def test_the_page_in_the_docs_is_the_table():
    assert (ROOT / "docs" / "state-diagram.md").read_text("utf-8") == page()
