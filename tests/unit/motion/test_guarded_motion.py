"""What wired inputs do to motion: which contact asks for which reaction, when, and what they forbid."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from docking.errors import (
    AxisAtLimit,
    BrakeDisagrees,
    DeviceSilent,
    EmergencyStop,
    EventRefused,
    PermissiveLost,
    PermissiveMissing,
    ProtectiveStop,
)
from docking.motion.arbiter import Arbiter, Mode, Reaction
from docking.motion.guarded import GuardedMotion, InputRules
from docking.motion.reactions import REACTIONS
from docking.motion.triggers import Finding, Trigger
from docking.types import Correction, Identity, InputState, Plan
from sim.virtual_time import run_virtual

RULES = InputRules(
    emergency=("e_stop",),
    protective=("gate",),
    silent_s={"io1": 0.15},
    limits={"end_x": "A.X"},
    brakes={"brake_z": "A.Z"},
)
READY = {"e_stop": False, "gate": False, "end_x": False, "brake_z": False, "crane_free": True, "held": True}


class Contacts:
    """Inputs of a test's own."""

    def __init__(self) -> None:
        self.on_change = lambda: None
        self.state = InputState(dict(READY))

    async def bring_up(self):
        return (Identity("input module io1", "", "", "", ""),)

    def latest(self) -> InputState:
        return self.state

    def set(self, silent: tuple[str, ...] = (), **given: bool | None) -> None:
        self.state = InputState({**self.state.given, **given}, {}, silent)
        self.on_change()

    async def close(self) -> None:
        self.closed = True


class Axes:
    """A motion side with a real arbiter; a move lasts until it is told to end."""

    axes = ("A.X", "A.Y", "A.Z")

    def __init__(self) -> None:
        self.arbiter = Arbiter(lambda reaction: 1.0)
        self.reported: list[tuple[Trigger, type, str]] = []
        self.enabled = 0
        self.over = asyncio.Event()

    async def connect(self):
        return (Identity("axis A.X", "", "", "", ""),)

    async def enable(self):
        self.enabled += 1
        self.arbiter.enter(Mode.STANDING)
        return np.zeros(3)

    async def load(self, plan: Plan) -> None:
        self.loaded = plan

    async def start(self, plan_hash: str):
        self.arbiter.enter(Mode.MOVING)
        await self.over.wait()
        return "result"

    async def reset(self, role: str) -> None:
        self.was_reset = role

    def report(self, finding: Finding) -> None:
        self.reported.append((finding.trigger, type(finding.error), finding.error.where))
        self.arbiter.raise_(finding, 0.0)

    async def close(self) -> None:
        self.closed = True


PLAN = Plan(
    1, "hash", "align", "align", Axes.axes, 0.1, np.zeros(2), np.zeros(2), np.zeros((2, 3)),
    Correction(np.zeros(3), np.zeros(3), np.zeros(3)), 0.0, 1.0, "",
)  # fmt: skip


def play(scenario, requires=("crane_free", "held", "not_wired")):
    """`scenario(axes, contacts, guarded)` while a move runs that requires these inputs."""

    async def main():
        axes, contacts = Axes(), Contacts()
        guarded = GuardedMotion(axes, contacts, RULES)
        await guarded.connect()
        await guarded.enable()
        await guarded.load(replace(PLAN, requires=requires))
        move = asyncio.get_running_loop().create_task(guarded.start("hash"))
        await asyncio.sleep(0)
        result = scenario(axes, contacts, guarded)
        axes.over.set()
        await move
        return axes, result

    return run_virtual(main)


@pytest.mark.parametrize(
    ("change", "trigger", "error", "where", "reaction"),
    [
        ({"e_stop": True}, Trigger.EMERGENCY_STOP, EmergencyStop, "e_stop", Reaction.SBT),
        ({"gate": True}, Trigger.PROTECTIVE_STOP, ProtectiveStop, "gate", Reaction.PPS),
        ({"crane_free": False}, Trigger.PERMISSIVE_LOST, PermissiveLost, "crane_free", Reaction.PPS),
        ({"held": False}, Trigger.PERMISSIVE_LOST, PermissiveLost, "held", Reaction.PPS),
        ({"end_x": True}, Trigger.LIMIT_SWITCH, AxisAtLimit, "A.X", Reaction.PPS),
        ({"brake_z": True}, Trigger.BRAKE, BrakeDisagrees, "A.Z", Reaction.FAST_PPS),
        ({"silent": ("io1",)}, Trigger.INPUTS_SILENT, DeviceSilent, "input module io1", Reaction.PPS),
    ],
)
def test_every_input_has_its_reaction_in_a_move_and_asks_for_it_once(change, trigger, error, where, reaction):
    def scenario(axes: Axes, contacts: Contacts, guarded: GuardedMotion):
        contacts.set(**change)
        contacts.set(**change)
        return axes.arbiter.reaction, axes.arbiter.latched

    axes, (reached, latched) = play(scenario)
    assert axes.reported == [(trigger, error, where)]
    assert reached is reaction is REACTIONS[trigger, Mode.MOVING]
    assert latched


def test_what_the_move_does_not_require_may_fall():
    axes, _ = play(lambda axes, contacts, guarded: contacts.set(crane_free=False), requires=("held",))
    assert axes.reported == []


def test_the_emergency_stop_goes_before_everything_that_falls_with_it():
    def scenario(axes: Axes, contacts: Contacts, guarded: GuardedMotion):
        contacts.set(crane_free=False, gate=True, e_stop=True)
        return axes.arbiter.first

    _, first = play(scenario)
    assert first.trigger is Trigger.EMERGENCY_STOP


async def _ready():
    axes, contacts = Axes(), Contacts()
    guarded = GuardedMotion(axes, contacts, RULES)
    await guarded.connect()
    return axes, contacts, guarded


@pytest.mark.parametrize(
    ("change", "error"),
    [({"e_stop": True}, EmergencyStop), ({"gate": True}, ProtectiveStop), ({"silent": ("io1",)}, DeviceSilent)],
)
def test_nothing_is_enabled_started_or_reset_while_a_stop_lasts(change, error):
    async def main():
        axes, contacts, guarded = await _ready()
        contacts.set(**change)
        assert axes.reported == []
        with pytest.raises(error):
            await guarded.enable()
        assert axes.enabled == 0
        contacts.state = InputState(dict(READY))
        await guarded.enable()
        contacts.set(**change)
        await guarded.load(PLAN)
        with pytest.raises(error):
            await guarded.start("hash")
        with pytest.raises(EventRefused, match="still there"):
            await guarded.reset("supervisor")
        contacts.set(**READY)
        await guarded.reset("supervisor")
        return axes

    assert run_virtual(main).was_reset == "supervisor"


@pytest.mark.parametrize("given", [False, None])
def test_a_start_without_a_required_input_is_refused_by_name(given):
    async def main():
        axes, contacts, guarded = await _ready()
        await guarded.enable()
        await guarded.load(replace(PLAN, requires=("crane_free",)))
        contacts.set(crane_free=given)
        with pytest.raises(PermissiveMissing, match="crane_free"):
            await guarded.start("hash")
        return axes

    assert run_virtual(main).reported == []


@pytest.mark.parametrize("given", [True, None])
def test_a_start_on_a_brake_that_is_not_seen_open_is_refused(given):
    async def main():
        _axes, contacts, guarded = await _ready()
        await guarded.enable()
        contacts.set(brake_z=given)
        await guarded.load(PLAN)
        with pytest.raises(BrakeDisagrees, match=r"A\.Z"):
            await guarded.start("hash")

    run_virtual(main)


def test_a_contact_that_falls_again_after_a_reset_asks_again():
    async def main():
        axes, contacts, guarded = await _ready()
        await guarded.enable()
        contacts.set(gate=True)
        contacts.set(gate=False)
        await guarded.reset("operator")
        contacts.set(gate=True)
        return axes

    assert [row[0] for row in run_virtual(main).reported] == [Trigger.PROTECTIVE_STOP] * 2


def test_every_change_is_told_and_everything_is_closed():
    async def main():
        axes, contacts, guarded = await _ready()
        heard: list[InputState] = []
        guarded.on_inputs = heard.append
        contacts.set(crane_free=False)
        await guarded.close()
        return axes.closed, contacts.closed, heard

    closed, also, heard = run_virtual(main)
    assert closed
    assert also
    assert [state.given["crane_free"] for state in heard] == [False]
