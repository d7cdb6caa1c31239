"""What may happen when: states, events, one table, and a pure `step`.

The table is the documentation: `python -m docking.state > docs/state-diagram.md` renders it. An event that the table
does not list for a state is refused with the reason and the list of what is possible.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from enum import Enum

from docking.errors import EventRefused


class State(Enum):
    """Where the cell stands. The order is the order of a docking."""

    OFFLINE = "offline"
    STANDBY = "standby"
    DISABLED = "disabled"
    IDLE = "idle"
    HOMING = "homing"
    HOMED = "homed"
    MEASURE_FRAME = "measure-frame"
    BALL_ENTRY = "ball-entry"
    LOCK_BALLS = "lock-balls"
    MEASURE = "measure"
    BLOCKED = "blocked"
    FIT = "fit"
    VERIFY = "verify"
    LIFT = "lift"
    TAKE_LOAD = "take-load"
    LEVEL = "level"
    PLAN = "plan"
    CONFIRM = "confirm"
    RETREAT = "retreat"
    CONFIRM_RETREAT = "confirm-retreat"
    MOVE = "move"
    PAUSED = "paused"
    SETTLE = "settle"
    DOCKED = "docked"
    OUT_OF_TOLERANCE = "out-of-tolerance"
    RELIEVE = "relieve"
    RELIEF_STEP = "relief-step"
    STOPPING = "stopping"
    FAULT = "fault"
    RECOVER = "recover"


class Event(Enum):
    """What happened, or what somebody asks for."""

    LOAD = "load"
    CONNECT = "connect"
    CONNECTED = "connected"
    ENABLE = "enable"
    ENABLED = "enabled"
    START_SEATED = "start-seated"
    START_EMPTY = "start-empty"
    HOMED = "homed"
    MEASURE_FRAME = "measure-frame"
    FRAME_MEASURED = "frame-measured"
    FRAME_MEASURED_EMPTY = "frame-measured-empty"
    BALLS_ENTERED = "balls-entered"
    BALLS_LOCKED = "balls-locked"
    MEASURED = "measured"
    UNSEEN = "unseen"
    AGAIN = "again"
    RETREAT = "retreat"
    FITTED = "fitted"
    LIFT_NEEDED = "lift-needed"
    LEVEL_NEEDED = "level-needed"
    MOVE_NEEDED = "move-needed"
    MEASURE_MORE = "measure-more"
    ACCEPTED = "accepted"
    NOT_ACCEPTED = "not-accepted"
    PLANNED = "planned"
    CONFIRMED = "confirmed"
    DECLINED = "declined"
    STALE = "stale"
    MOVED = "moved"
    HOLD = "hold"
    RESUME = "resume"
    ABORT = "abort"
    STOPPED = "stopped"
    SETTLED = "settled"
    LIFTED = "lifted"
    LOAD_TAKEN = "load-taken"
    START_RELIEF = "start-relief"
    STEP_ASKED = "step-asked"
    RELEASED = "released"
    RELIEVED = "relieved"
    FAULTED = "faulted"
    RESET = "reset"
    CLOSE = "close"


class Effect(Enum):
    """What the cell does on entering a state; every effect answers with an event."""

    CONNECT = "connect"
    ENABLE = "enable"
    HOME = "home"
    LOCATE = "locate station and mate"
    ENTER_BALLS = "bring the sockets under the balls"
    LOCK_BALLS = "lock the balls"
    MEASURE = "measure the component"
    FIT = "fit the pose"
    JUDGE = "compare with the stage's goal"
    LIFT = "plan the lift"
    TAKE_LOAD = "weigh the lifted part and compare it with the job"
    LEVEL = "plan the levelling"
    PLAN = "plan and check the move"
    OFFER = "ask whether to measure again or to retreat"
    PLAN_RETREAT = "plan the way back"
    ASK = "show the plan and ask"
    ASK_BACK = "show the way back and ask once for all of it"
    MOVE = "run the plan"
    HOLD = "hold on the path"
    RESUME = "go on along the path"
    STOP = "stop on the path"
    SETTLE = "wait until at rest"
    WEIGH = "weigh the strain and ask for one step"
    STEP = "run one step of the relief"


@dataclass(frozen=True)
class Situation:
    """The whole state of the machine: the state, whether the pose is known, and the first cause of a fault."""

    state: State = State.OFFLINE
    position_known: bool = False
    cause: str | None = None


@dataclass(frozen=True)
class Transition:
    """One row of the table."""

    target: State
    effects: tuple[Effect, ...] = ()


S, E, F = State, Event, Effect

TABLE: dict[tuple[State, Event], Transition] = {
    (S.OFFLINE, E.LOAD): Transition(S.STANDBY),
    (S.STANDBY, E.CONNECT): Transition(S.STANDBY, (F.CONNECT,)),
    (S.STANDBY, E.CONNECTED): Transition(S.DISABLED),
    (S.DISABLED, E.ENABLE): Transition(S.DISABLED, (F.ENABLE,)),
    (S.DISABLED, E.ENABLED): Transition(S.IDLE),
    (S.IDLE, E.START_SEATED): Transition(S.MEASURE_FRAME, (F.LOCATE,)),
    (S.IDLE, E.START_EMPTY): Transition(S.HOMING, (F.HOME,)),
    (S.HOMING, E.HOMED): Transition(S.HOMED),
    (S.HOMED, E.MEASURE_FRAME): Transition(S.MEASURE_FRAME, (F.LOCATE,)),
    (S.MEASURE_FRAME, E.FRAME_MEASURED_EMPTY): Transition(S.BALL_ENTRY, (F.ENTER_BALLS,)),
    (S.BALL_ENTRY, E.BALLS_ENTERED): Transition(S.LOCK_BALLS, (F.LOCK_BALLS,)),
    (S.LOCK_BALLS, E.BALLS_LOCKED): Transition(S.MEASURE, (F.MEASURE,)),
    (S.MEASURE_FRAME, E.FRAME_MEASURED): Transition(S.MEASURE, (F.MEASURE,)),
    (S.MEASURE, E.MEASURED): Transition(S.FIT, (F.FIT,)),
    (S.MEASURE, E.UNSEEN): Transition(S.BLOCKED, (F.OFFER,)),
    (S.FIT, E.UNSEEN): Transition(S.BLOCKED, (F.OFFER,)),
    (S.BLOCKED, E.AGAIN): Transition(S.MEASURE, (F.MEASURE,)),
    (S.BLOCKED, E.RETREAT): Transition(S.RETREAT, (F.PLAN_RETREAT,)),
    (S.FIT, E.FITTED): Transition(S.VERIFY, (F.JUDGE,)),
    (S.FIT, E.MEASURE_MORE): Transition(S.MEASURE, (F.MEASURE,)),
    (S.VERIFY, E.LIFT_NEEDED): Transition(S.LIFT, (F.LIFT,)),
    (S.VERIFY, E.LEVEL_NEEDED): Transition(S.LEVEL, (F.LEVEL,)),
    (S.VERIFY, E.MOVE_NEEDED): Transition(S.PLAN, (F.PLAN,)),
    (S.VERIFY, E.MEASURE_MORE): Transition(S.MEASURE, (F.MEASURE,)),
    (S.VERIFY, E.ACCEPTED): Transition(S.DOCKED),
    (S.VERIFY, E.NOT_ACCEPTED): Transition(S.OUT_OF_TOLERANCE),
    (S.LIFT, E.PLANNED): Transition(S.CONFIRM, (F.ASK,)),
    (S.LEVEL, E.PLANNED): Transition(S.CONFIRM, (F.ASK,)),
    (S.PLAN, E.PLANNED): Transition(S.CONFIRM, (F.ASK,)),
    (S.CONFIRM, E.CONFIRMED): Transition(S.MOVE, (F.MOVE,)),
    (S.CONFIRM, E.DECLINED): Transition(S.RECOVER),
    (S.CONFIRM, E.STALE): Transition(S.MEASURE, (F.MEASURE,)),
    (S.CONFIRM, E.RETREAT): Transition(S.RETREAT, (F.PLAN_RETREAT,)),
    (S.RETREAT, E.PLANNED): Transition(S.CONFIRM_RETREAT, (F.ASK_BACK,)),
    (S.CONFIRM_RETREAT, E.CONFIRMED): Transition(S.MOVE, (F.MOVE,)),
    (S.CONFIRM_RETREAT, E.DECLINED): Transition(S.RECOVER),
    (S.MOVE, E.HOLD): Transition(S.PAUSED, (F.HOLD,)),
    (S.MOVE, E.MOVED): Transition(S.SETTLE, (F.SETTLE,)),
    (S.MOVE, E.ABORT): Transition(S.STOPPING, (F.STOP,)),
    (S.PAUSED, E.RESUME): Transition(S.MOVE, (F.RESUME,)),
    (S.PAUSED, E.MOVED): Transition(S.SETTLE, (F.SETTLE,)),
    (S.PAUSED, E.ABORT): Transition(S.STOPPING, (F.STOP,)),
    (S.STOPPING, E.STOPPED): Transition(S.RECOVER),
    (S.STOPPING, E.MOVED): Transition(S.RECOVER),
    (S.SETTLE, E.SETTLED): Transition(S.MEASURE, (F.MEASURE,)),
    (S.SETTLE, E.LIFTED): Transition(S.TAKE_LOAD, (F.TAKE_LOAD,)),
    (S.SETTLE, E.RETREAT): Transition(S.RETREAT, (F.PLAN_RETREAT,)),
    (S.TAKE_LOAD, E.LOAD_TAKEN): Transition(S.MEASURE, (F.MEASURE,)),
    (S.IDLE, E.START_RELIEF): Transition(S.RELIEVE, (F.WEIGH,)),
    (S.RELIEVE, E.STEP_ASKED): Transition(S.RELIEF_STEP, (F.STEP,)),
    (S.RELIEVE, E.RELEASED): Transition(S.RECOVER),
    (S.RELIEVE, E.RELIEVED): Transition(S.IDLE),
    (S.RELIEF_STEP, E.MOVED): Transition(S.RELIEVE, (F.WEIGH,)),
    (S.RELIEF_STEP, E.STOPPED): Transition(S.RECOVER),
    (S.RELIEF_STEP, E.HOLD): Transition(S.STOPPING, (F.STOP,)),
    (S.RELIEF_STEP, E.ABORT): Transition(S.STOPPING, (F.STOP,)),
    (S.FAULT, E.RESET): Transition(S.RECOVER),
    (S.RECOVER, E.ENABLE): Transition(S.DISABLED, (F.ENABLE,)),
    (S.DOCKED, E.CLOSE): Transition(S.STANDBY),
    (S.OUT_OF_TOLERANCE, E.CLOSE): Transition(S.STANDBY),
}

AT_REST = frozenset(
    {
        *(S.STANDBY, S.DISABLED, S.IDLE, S.MEASURE_FRAME, S.MEASURE, S.BLOCKED, S.FIT, S.VERIFY, S.PLAN, S.CONFIRM),
        *(S.LIFT, S.TAKE_LOAD, S.LEVEL, S.RETREAT, S.CONFIRM_RETREAT, S.SETTLE, S.RELIEVE),
    }
)
"""States with nothing moving, from which the operator can leave at once."""

TABLE |= {(state, E.ABORT): Transition(S.RECOVER) for state in AT_REST}
TABLE |= {(state, E.FAULTED): Transition(S.FAULT) for state in S if state is not S.FAULT}

POSE_UNKNOWN_IN = frozenset(
    {
        *(S.OFFLINE, S.STANDBY, S.DISABLED, S.MOVE, S.RELIEVE, S.RELIEF_STEP),
        *(S.STOPPING, S.FAULT, S.RECOVER),
    }
)
"""Entering one of these revokes the knowledge of the pose; only a fit restores it."""

FINAL = frozenset({S.DOCKED, S.OUT_OF_TOLERANCE, S.RECOVER, S.FAULT})
"""Where a run ends; going on from here is a decision of a person."""


def step(situation: Situation, event: Event, cause: str | None = None) -> tuple[Situation, tuple[Effect, ...]]:
    """The next situation and what to do; raises EventRefused for a pair that the table does not list.

    A fault keeps its first cause until a reset; a fault, a move and a restart revoke `position_known`.
    """
    row = TABLE.get((situation.state, event))
    if row is None:
        possible = ", ".join(sorted(e.value for s, e in TABLE if s is situation.state)) or "nothing"
        raise EventRefused(f"state {situation.state.value}", f"possible here: {possible}", value=event.value)
    known = (situation.position_known or event is Event.FITTED) and row.target not in POSE_UNKNOWN_IN
    kept = situation.cause if situation.cause is not None else cause
    if event is Event.RESET:
        kept = None
    return replace(situation, state=row.target, position_known=known, cause=kept), row.effects


def diagram() -> str:
    """The table as a Mermaid state diagram; the fault and abort rows are folded into one note each."""
    lines = ["stateDiagram-v2", "    direction TB", f"    [*] --> {S.OFFLINE.name}"]
    for (state, event), row in TABLE.items():
        if event is E.FAULTED or (event is E.ABORT and state in AT_REST):
            continue
        lines.append(f"    {state.name} --> {row.target.name}: {event.value}")
    lines.append(f"    note right of {S.FAULT.name}: faulted leads here from every state")
    folded = ", ".join(s.name for s in S if s in AT_REST)
    lines.append(f"    note right of {S.RECOVER.name}: abort leads here from {folded}")
    return "\n".join(lines) + "\n"


def page() -> str:
    """`docs/state-diagram.md`: the diagram, what revokes the pose, and where a run ends."""
    revoking = ", ".join(f"`{s.name}`" for s in S if s in POSE_UNKNOWN_IN)
    final = ", ".join(f"`{s.name}`" for s in S if s in FINAL)
    return (
        "# States of the docking cell\n\n"
        "Generated from `TABLE` in `docking/state.py` by `python -m docking.state > docs/state-diagram.md`.\n"
        "An event that is not drawn at a state is refused there, with the list of what is possible.\n\n"
        f"```mermaid\n{diagram()}```\n\n"
        f"The pose of the component is unknown from entering any of {revoking} until the next `fitted`.\n"
        f"A run ends in {final}; going on from there is a decision of a person.\n"
        "The first cause of a fault is kept until `reset`.\n"
    )


if __name__ == "__main__":
    sys.stdout.write(page())
