"""A motion side with wired inputs: emergency and protective stop, permissives, limit switches and brakes.

What is wired is looked at before anything begins and at every change while axes are powered. A contact asks for its
reaction once, when it changes; while it lasts, nothing starts and no reset is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from docking.errors import (
    AxisAtLimit,
    BrakeDisagrees,
    DeviceSilent,
    DockingError,
    EmergencyStop,
    EventRefused,
    PermissiveLost,
    PermissiveMissing,
    ProtectiveStop,
)
from docking.motion.arbiter import Arbiter, Mode
from docking.motion.lateness import Lateness
from docking.motion.served import LocalMotion
from docking.motion.triggers import Finding, Trigger
from docking.ports import Inputs
from docking.types import Array, Feedback, Identity, InputState, MoveResult, Plan


@dataclass(frozen=True)
class InputRules:
    """Which inputs are what: names, and for limit switches and brakes the axis of each name. `silent_s`: after how long
    without a word each module is silent."""

    emergency: tuple[str, ...] = ()
    protective: tuple[str, ...] = ()
    silent_s: dict[str, float] = field(default_factory=dict)
    limits: dict[str, str] = field(default_factory=dict)
    brakes: dict[str, str] = field(default_factory=dict)


class GuardedMotion:
    """`motion` behind `inputs`. `on_inputs` hears every change of what they say."""

    def __init__(self, motion: LocalMotion, inputs: Inputs, rules: InputRules) -> None:
        self._motion, self._inputs, self._rules = motion, inputs, rules
        self.axes = motion.axes
        self.on_inputs: Callable[[InputState], None] = lambda state: None
        self._requires: tuple[str, ...] = ()
        self._stage = ""
        self._loaded: tuple[str, str, tuple[str, ...]] = ("", "", ())
        self._told: frozenset[str] = frozenset()
        inputs.on_change = self._changed

    @property
    def arbiter(self) -> Arbiter:
        return self._motion.arbiter

    @property
    def lateness(self) -> Lateness:
        return self._motion.lateness

    # the port ----------------------------------------------------------------------------------------------------
    async def connect(self) -> tuple[Identity, ...]:
        """The positioners first: their wire may be the one that the inputs share."""
        found = await self._motion.connect()
        return (*found, *await self._inputs.bring_up())

    async def enable(self) -> Array:
        """Raises EmergencyStop, ProtectiveStop or DeviceSilent while one of them is there, and as the axes do."""
        self._require_no_stop()
        self._told = frozenset()
        result = await self._motion.enable()
        self._changed()
        return result

    async def load(self, plan: Plan) -> None:
        self._loaded = (plan.plan_hash, plan.stage, plan.requires)
        await self._motion.load(plan)

    async def start(self, plan_hash: str) -> MoveResult:
        """Raises PermissiveMissing where an input that the plan requires is wired and not given."""
        self._require_no_stop()
        loaded, stage, requires = self._loaded
        state = self._inputs.latest()
        wired = tuple(name for name in requires if name in state.given) if loaded == plan_hash else ()
        for name in wired:
            if state.given[name] is not True:
                raise PermissiveMissing(name, value=stage)
        for name, axis in self._rules.brakes.items():
            if state.given.get(name) is not False:
                raise BrakeDisagrees(axis, f"input {name}", value=_closed(state.given.get(name)), limit="open")
        self._requires, self._stage = wired, stage
        try:
            return await self._motion.start(plan_hash)
        finally:
            self._requires = ()

    async def reset(self, role: str) -> None:
        """As the axes do; refused while an emergency or protective stop or a silent module is still there."""
        error = self._stop()
        if error is not None:
            raise EventRefused("reset", f"The cause is still there: {error.text()}", value=f"reset by {role}")
        await self._motion.reset(role)
        self._told = frozenset()

    def request(self, verb: str) -> None:
        self._motion.request(verb)

    def override(self, percent: float) -> None:
        self._motion.override(percent)

    def report(self, finding: Finding) -> None:
        self._motion.report(finding)

    def feedback(self) -> Feedback:
        return self._motion.feedback()

    def inputs(self) -> InputState:
        return self._inputs.latest()

    async def close(self) -> None:
        """The axes first: while they are being released, their inputs are still watched."""
        try:
            await self._motion.close()
        finally:
            await self._inputs.close()

    # the inputs --------------------------------------------------------------------------------------------------
    def _changed(self) -> None:
        """Ask for a reaction to everything that was not there when the inputs last changed."""
        state = self._inputs.latest()
        if self._motion.arbiter.mode is not Mode.OFF:
            found = dict(self._findings(state))
            news = [finding for name, finding in found.items() if name not in self._told]
            # A reaction may end the move at once: what has been told is kept before.
            self._told = frozenset(found)
            for finding in news:
                self._motion.report(finding)
        self.on_inputs(state)

    def _findings(self, state: InputState) -> Iterator[tuple[str, Finding]]:
        """(name, finding) of every input that is not as it should be, the most severe first."""
        rules, stage = self._rules, self._stage
        on = [name for name, given in state.given.items() if given]
        off = [name for name, given in state.given.items() if given is False]
        yield from ((n, Finding(Trigger.EMERGENCY_STOP, EmergencyStop(n))) for n in rules.emergency if n in on)
        yield from ((n, Finding(Trigger.PROTECTIVE_STOP, ProtectiveStop(n))) for n in rules.protective if n in on)
        yield from ((module, Finding(Trigger.INPUTS_SILENT, self._silent(module))) for module in state.silent)
        pressed = ((n, axis) for n, axis in rules.limits.items() if n in on)
        yield from ((n, Finding(Trigger.LIMIT_SWITCH, AxisAtLimit(axis, f"input {n}"))) for n, axis in pressed)
        moving = self._motion.arbiter.mode is Mode.MOVING
        closed = ((n, axis) for n, axis in rules.brakes.items() if moving and n in on)
        yield from ((n, Finding(Trigger.BRAKE, _closed_in_motion(n, axis))) for n, axis in closed)
        fallen = (n for n in self._requires if n in off)
        yield from ((n, Finding(Trigger.PERMISSIVE_LOST, PermissiveLost(n, value=stage))) for n in fallen)

    def _stop(self) -> DockingError | None:
        """What forbids that anything begins."""
        state = self._inputs.latest()
        for name in self._rules.emergency:
            if state.given.get(name):
                return EmergencyStop(name)
        for name in self._rules.protective:
            if state.given.get(name):
                return ProtectiveStop(name)
        return self._silent(state.silent[0]) if state.silent else None

    def _silent(self, module: str) -> DeviceSilent:
        limit_s = self._rules.silent_s.get(module)
        return DeviceSilent(f"input module {module}", "its inputs are not known any more", limit=limit_s)

    def _require_no_stop(self) -> None:
        error = self._stop()
        if error is not None:
            raise error


def _closed_in_motion(name: str, axis: str) -> BrakeDisagrees:
    return BrakeDisagrees(axis, f"input {name}", value="closed", limit="open")


def _closed(given: bool | None) -> str:
    return {True: "closed", False: "open", None: "unknown"}[given]
