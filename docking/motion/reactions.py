"""Which reaction answers which trigger in which mode: the one table, and the document made of it."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum, IntEnum

from docking.motion.triggers import Trigger


class Mode(Enum):
    """What the axes are doing when a trigger comes."""

    OFF = "off"
    STANDING = "standing"
    MOVING = "moving"
    STOPPING = "stopping"


class Reaction(IntEnum):
    """What is done, in the order of severity: the most severe one asked for is the one in force."""

    NONE = 0
    REJ = 1
    NOGO = 2
    PPS = 3
    FAST_PPS = 4
    SQS = 5
    SBT = 6
    HW = 7


WORDS: dict[Reaction, tuple[str, str, str]] = {
    Reaction.NONE: ("nothing", "-", "Nothing to do."),
    Reaction.REJ: ("rejected", "-", "The request is dropped and counted; nothing moves."),
    Reaction.NOGO: ("no start", "-", "The axes hold; nothing starts until the cause is gone and reset."),
    Reaction.PPS: (
        "path-preserving stop",
        "2",
        "Path time slows to zero along a smooth curve: every axis stays on the planned rigid path, the drives hold.",
    ),
    Reaction.FAST_PPS: (
        "fast path-preserving stop",
        "2",
        "As above, but in a straight line of time, as hard as the quick-stop deceleration of the axes allows.",
    ),
    Reaction.SQS: (
        "synchronous quick stop",
        "2",
        "Every drive ramps down by itself, all in one time: their decelerations (6085h) are set in proportion to the"
        " planned speeds before each move. The drives hold.",
    ),
    Reaction.SBT: (
        "stop, brakes, torque off",
        "1",
        "Quick stop; when the axes are seen at rest, at the latest when the ramp should be over, the brakes close and"
        " are confirmed, then the torque goes off.",
    ),
    Reaction.HW: (
        "hardware chain",
        "0 or 1",
        "The host stops SYNC and heartbeat at once: the drives' own watchdogs and the safety relay that hears the same"
        " heartbeat act.",
    ),
}
"""Reaction -> (name, stop category of IEC 60204-1, what happens)."""

_N, _P, _F, _S, _B, _H = (
    Reaction.NOGO,
    Reaction.PPS,
    Reaction.FAST_PPS,
    Reaction.SQS,
    Reaction.SBT,
    Reaction.HW,
)

_POWERED: dict[Trigger, tuple[Reaction, Reaction, Reaction]] = {
    # trigger: (standing, moving, stopping). What may be a jam is answered fast: every cycle that the others go on
    # strains the part. What no set-point can lead any more is answered by the drives.
    Trigger.FOLLOWING_ERROR: (_N, _F, _F),
    Trigger.COUPLING: (_N, _F, _F),
    Trigger.PREDICTED_FORCE: (_N, _F, _F),
    Trigger.PREDICTED_WARP: (_N, _F, _F),
    Trigger.MEASURED_FORCE: (_N, _F, _F),
    Trigger.MEASURED_WARP: (_N, _F, _F),
    Trigger.OVERLOAD: (_N, _F, _F),
    Trigger.UNDERLOAD: (_N, _F, _F),
    Trigger.STUCK: (_N, _F, _F),
    Trigger.DRIFT: (_B, _B, _B),
    Trigger.LIMIT_SWITCH: (_N, _P, _P),
    Trigger.ENCODER_JUMP: (_S, _S, _S),
    Trigger.PASSIVE_AXIS: (_N, _F, _F),
    Trigger.FEEDBACK_MISSING: (_N, _F, _F),
    Trigger.ALL_MISSING: (_S, _S, _S),
    Trigger.FORCE_MISSING: (_N, _F, _F),
    Trigger.DRIVE_WARNING: (_N, _P, _P),
    Trigger.DRIVE_FAULT: (_S, _S, _S),
    Trigger.AXIS_OFF: (_S, _S, _S),
    Trigger.NODE_RESTARTED: (_S, _S, _S),
    Trigger.HEARTBEAT_LOST: (_S, _S, _S),
    Trigger.FOREIGN_SENDER: (_S, _S, _S),
    Trigger.LINK_LOST: (_H, _H, _H),
    Trigger.TICK_LATE: (_N, _P, _P),
    Trigger.LEASE_LOST: (_N, _P, _P),
    Trigger.EMERGENCY_STOP: (_B, _B, _B),
    Trigger.PERMISSIVE_LOST: (_N, _P, _P),
    Trigger.PROTECTIVE_STOP: (_N, _P, _P),
    Trigger.INPUTS_SILENT: (_N, _P, _P),
    Trigger.BRAKE: (_N, _F, _F),
    Trigger.LIVE_DEVIATION: (_N, _P, _P),
    Trigger.POSE_UNCERTAIN: (_N, _P, _P),
    Trigger.OPERATOR_STOP: (Reaction.REJ, _P, _P),
    Trigger.DEFECT: (_S, _S, _S),
    Trigger.STOP_OVERDUE: (_S, _S, _S),
    Trigger.QUICK_STOP_OVERDUE: (_H, _H, _H),
}


def _rows() -> Iterator[tuple[tuple[Trigger, Mode], Reaction]]:
    for trigger, (standing, moving, stopping) in _POWERED.items():
        # Without power nothing can be stopped: only the start is refused.
        yield (trigger, Mode.OFF), Reaction.REJ if trigger is Trigger.OPERATOR_STOP else Reaction.NOGO
        yield (trigger, Mode.STANDING), standing
        yield (trigger, Mode.MOVING), moving
        yield (trigger, Mode.STOPPING), stopping


REACTIONS: dict[tuple[Trigger, Mode], Reaction] = dict(_rows())
"""The reaction to every trigger in every mode."""

REQUESTS = frozenset({Trigger.OPERATOR_STOP})
"""Triggers that nobody has to reset: what was asked for is over when the axes stand."""


_HEAD = """\
# Stops: which trigger leads to which reaction

Made by `python -m docking.motion.arbiter > docs/stop-reactions.md` out of the table that the program runs by.

**This program is a functional layer, not a safety function: it may never be the only thing that stops a load. The
emergency stop is hard-wired and depends on neither software nor network.**

## Reactions

In the order of severity; the most severe one that was asked for is in force. Stop categories are those of IEC 60204-1.

| code | reaction | stop category | what happens |
|---|---|---|---|
"""

_RULES = """
A stop on the path that has not ended within its own duration and two cycles becomes a synchronous quick stop; a quick
stop that has not ended 100 ms after its ramp opens the hardware chain. No axis is ever stopped alone.

Every fault stays until it is reset: by a person who may, once the cause is gone, with a press that begins after that
(a key that is held counts once). A reset never moves anything. The first cause is kept, later ones are listed behind
it; a drive that sends an emergency message and is in fault soon after is one cause, the fault. After the hardware chain
has been opened, and after an error of the program itself, the controller has to be started again.

An axis whose encoder jumped or whose node restarted has lost its reference: nothing is enabled until a supervisor has
acknowledged, by the reset, that it was referenced anew.

Before a move starts the load cells are judged: where they show a strained part, or another force than when the plan was
loaded, the start is refused without any reaction; a held move whose forces change while it is held is not resumed.

## Harder than a smooth stop, and why

A smooth stop would do for a finding that strains nothing. These are answered harder:

| trigger | reaction in motion | reason |
|---|---|---|
"""

HARDER: dict[Trigger, str] = {
    Trigger.FOLLOWING_ERROR: "may be the beginning of a jam, which must not wait for the slow ramp",
    Trigger.FEEDBACK_MISSING: "an axis that is not seen may be a jammed one",
    Trigger.STUCK: "every cycle that the others go on squeezes the part",
    Trigger.COUPLING: "the part is being squeezed already",
    Trigger.PASSIVE_AXIS: "a jammed guide or a ball out of its socket is a jam",
    Trigger.FORCE_MISSING: "a load cell that shows nothing may be hiding an overload",
    Trigger.LINK_LOST: "no drive can be reached, a refused frame included: only the drives' own watchdogs stop them",
}
"""Triggers that a path-preserving stop would answer, were they not what they may be."""

_TABLE = """
## Triggers

Modes: *off* without power, *standing* enabled and at rest, *moving* while a plan is played, *stopping* while a reaction
is under way.

| trigger | """


def document() -> str:
    """The published table as Markdown."""
    reactions = "".join(f"| {r.name} | {n} | {category} | {text} |\n" for r, (n, category, text) in WORDS.items())
    modes = " | ".join(mode.value for mode in Mode)
    rows = "".join(
        f"| {trigger.value} | " + " | ".join(REACTIONS[trigger, mode].name for mode in Mode) + " |\n"
        for trigger in Trigger
    )
    harder = "".join(
        f"| {trigger.value} | {REACTIONS[trigger, Mode.MOVING].name} | {why} |\n" for trigger, why in HARDER.items()
    )
    return f"{_HEAD}{reactions}{_RULES}{harder}{_TABLE}{modes} |\n|---|---|---|---|---|\n{rows}"
