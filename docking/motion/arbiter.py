"""The fault arbiter: triggers in, the reaction in force out. Pure: time comes in, nothing is waited for or sent.

`python -m docking.motion.arbiter` prints the table of reactions for the documents.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import Enum

from docking.errors import AxisUnreferenced, BadArgument, DockingError, EventRefused, StopOverdue
from docking.motion.reactions import REACTIONS, REQUESTS, WORDS, Mode, Reaction, document
from docking.motion.triggers import Finding, Trigger

__all__ = ["REACTIONS", "Arbiter", "Mode", "Reaction", "Role"]

RELEASE_S = 0.5
"""Presses of reset that follow each other faster are one press, held."""


class Role(Enum):
    """Who asks for a reset."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    SUPERVISOR = "supervisor"
    ENGINEER = "engineer"

    @staticmethod
    def named(name: str) -> Role:
        """The role of that name. Raises BadArgument."""
        try:
            return Role(name)
        except ValueError:
            roles = ", ".join(role.value for role in Role)
            raise BadArgument("reset", "no such role", value=name, limit=roles) from None


OPERATORS_OWN = frozenset({Trigger.LEASE_LOST, Trigger.PERMISSIVE_LOST, Trigger.PROTECTIVE_STOP, Trigger.TICK_LATE})
"""Causes outside drives and part: an operator may reset them, all others need a supervisor."""

LASTING = frozenset(
    {
        Trigger.FOLLOWING_ERROR,
        Trigger.STUCK,
        Trigger.COUPLING,
        Trigger.PREDICTED_FORCE,
        Trigger.PREDICTED_WARP,
        Trigger.AXIS_OFF,
    }
)
"""Causes that last as long as the command they are judged against; enabling anew commands every axis to where it is."""

UNREFERENCING = frozenset({Trigger.ENCODER_JUMP, Trigger.NODE_RESTARTED})
"""Causes after which the position of the axis is not known until it has been referenced anew."""

FINAL = frozenset({Trigger.DEFECT})
"""Causes after which this program is not to be trusted with axes until it has been started again."""


class Arbiter:
    """Decides by `REACTIONS` and keeps what it decided.

    `allowed_s(reaction)` is asked when a reaction begins: how long until standstill (PPS, FAST_PPS, SQS) or until the
    brakes hold (SBT); after that the next reaction begins. The motion side tells `mode` what it does by `enter`.
    `unreferenced` axes have lost their reference; of these, those `restarted` have no torque and say nothing.
    """

    def __init__(self, allowed_s: Callable[[Reaction], float]) -> None:
        self.mode = Mode.OFF
        self.reaction = Reaction.NONE
        self.first: Finding | None = None
        self.later: tuple[Finding, ...] = ()
        self.unreferenced: tuple[str, ...] = ()
        self.restarted: tuple[str, ...] = ()
        self.rejected = 0
        self.on_latched: Callable[[], None] = lambda: None
        self._allowed_s = allowed_s
        self._begun_s = self._limit_s = 0.0
        self._raised = False
        self._gone = True
        self._pressed_s = float("-inf")

    @property
    def latched(self) -> bool:
        """True while a fault is kept: nothing may start."""
        return self.first is not None

    @property
    def in_force(self) -> str:
        """The name of the reaction that stops the axes or has stopped them; empty where nothing has."""
        return WORDS[self.reaction][0] if self.reaction >= Reaction.PPS else ""

    @property
    def also(self) -> tuple[DockingError, ...]:
        """What was found behind the first cause, in order."""
        return tuple(finding.error for finding in self.later)

    def require_referenced(self) -> None:
        """Before the axes are enabled. Raises AxisUnreferenced while no supervisor has acknowledged a new reference."""
        if self.unreferenced:
            cause = "" if self.first is None else self.first.error.text()
            raise AxisUnreferenced(", ".join(self.unreferenced), cause)

    def enter(self, mode: Mode) -> None:
        """The motion side is now OFF, STANDING or MOVING. STOPPING is entered and left by reactions alone.

        Raises EventRefused where a fault is kept and a move is to begin, or a reaction is under way.
        """
        if mode is Mode.STOPPING or (mode is Mode.MOVING and (self.latched or self.mode is not Mode.STANDING)):
            raise EventRefused("motion", f"the axes are {self.mode.value}", value=f"to be {mode.value}")
        if self.mode is not Mode.STOPPING:
            self.mode = mode

    def raise_(self, finding: Finding, now_s: float) -> Reaction:
        """Take a finding; return the reaction in force, which never gets milder before a reset."""
        asked = REACTIONS[finding.trigger, self.mode]
        if asked <= Reaction.REJ:
            self.rejected += 1
            return self.reaction
        where = finding.error.where
        if finding.trigger in UNREFERENCING and where not in self.unreferenced:
            self.unreferenced = (*self.unreferenced, where)
        if finding.trigger is Trigger.NODE_RESTARTED and where not in self.restarted:
            self.restarted = (*self.restarted, where)
        if finding.trigger not in REQUESTS:
            self._raised = self._raised or finding.trigger not in LASTING
            self._note(finding)
        if asked > self.reaction:
            self._begin(asked, now_s)
        return self.reaction

    def poll(self, now_s: float, standing: bool) -> Reaction:
        """Once a cycle, after its findings: escalate what is overdue; return the reaction in force.

        `standing`: the reaction has reached its end (axes at rest; for SBT brakes confirmed and torque off).
        """
        if self.mode is Mode.STOPPING and self.reaction is not Reaction.HW:
            if standing:
                self._end()
            elif not (now_s - self._begun_s <= self._limit_s):
                self.raise_(self._overdue(now_s), now_s)
        self._gone, self._raised = not self._raised, False
        return self.reaction

    def reset(self, role: Role, now_s: float) -> None:
        """Forget the fault. Moves nothing and resumes nothing. Raises EventRefused with the reason."""
        held = now_s - self._pressed_s < RELEASE_S
        self._pressed_s = now_s
        reason = self.objection(role) or self._not_yet(held)
        if reason:
            raise EventRefused("reset", reason, value=f"reset by {role.value}")
        self.reaction, self.first, self.later = Reaction.NONE, None, ()
        self.unreferenced = self.restarted = ()

    def admit(self, name: str) -> Role:
        """The role that asks for a reset, before anything is done for it. Raises BadArgument, EventRefused."""
        role = Role.named(name)
        objection = self.objection(role)
        if objection:
            raise EventRefused("reset", objection, value=f"reset by {name}")
        return role

    def objection(self, role: Role) -> str:
        """Why this role cannot reset what is kept, whatever becomes of the cause; empty where it can."""
        causes = {finding.trigger for finding in (self.first, *self.later) if finding is not None}
        enough = role is Role.SUPERVISOR or (role is Role.OPERATOR and causes <= OPERATORS_OWN)
        reasons = (
            (not self.latched, "There is nothing to reset."),
            (self.reaction is Reaction.HW, "The hardware chain was opened: start the controller again."),
            (bool(causes & FINAL), "The program has an error: start the controller again."),
            (not enough and bool(self.unreferenced), self._lost_reference()),
            (not enough, "This takes a supervisor."),
            (self.mode in (Mode.MOVING, Mode.STOPPING), "The axes are not at rest."),
        )
        return next((text for applies, text in reasons if applies), "")

    def _not_yet(self, held: bool) -> str:
        if self._raised or not self._gone:
            return "The cause is still there."
        return "The key was held down: let it go, then press it again." if held else ""

    def _lost_reference(self) -> str:
        names = ", ".join(self.unreferenced)
        return f"{names} lost its reference: a supervisor acknowledges by the reset that it was referenced anew."

    def _note(self, finding: Finding) -> None:
        """Keep the first finding of each trigger. A drive that warned and is then in fault is one cause: its fault."""
        if self.first is not None and _announced(self.first, finding):
            self.first, self.later = finding, (*self.later, self.first)
            self.on_latched()
        elif self.first is None:
            self.first = finding
            self.on_latched()
        elif all(finding.trigger is not known.trigger for known in (self.first, *self.later)):
            self.later = (*self.later, finding)

    def _begin(self, reaction: Reaction, now_s: float) -> None:
        self.reaction = reaction
        if reaction >= Reaction.PPS:
            self.mode = Mode.STOPPING
            self._begun_s, self._limit_s = now_s, self._allowed_s(reaction)

    def _end(self) -> None:
        self.mode = Mode.OFF if self.reaction is Reaction.SBT else Mode.STANDING
        if not self.latched:
            self.reaction = Reaction.NONE

    def _overdue(self, now_s: float) -> Finding:
        taken_s, name = now_s - self._begun_s, self.reaction.name
        led = self.reaction < Reaction.SQS
        trigger = Trigger.STOP_OVERDUE if led else Trigger.QUICK_STOP_OVERDUE
        return Finding(trigger, StopOverdue(name, value=taken_s, limit=self._limit_s))


def _announced(first: Finding, finding: Finding) -> bool:
    """Whether the first finding only announced this one."""
    of = first.trigger, finding.trigger
    return of == (Trigger.DRIVE_WARNING, Trigger.DRIVE_FAULT) and first.error.where == finding.error.where


if __name__ == "__main__":
    sys.stdout.write(document())
