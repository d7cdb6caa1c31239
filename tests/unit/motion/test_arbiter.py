"""The arbiter: every trigger in every mode, and every second trigger on top of it; escalation, latching, reset."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

from docking.errors import AxisUnreferenced, BadArgument, Defect, DriveFault, EventRefused, StopOverdue
from docking.motion.arbiter import FINAL, OPERATORS_OWN, REACTIONS, RELEASE_S, Arbiter, Mode, Reaction, Role
from docking.motion.reactions import REQUESTS, WORDS, document
from docking.motion.triggers import Finding, Trigger

CYCLE_S = 0.01
ALLOWED_S = {Reaction.PPS: 0.8, Reaction.FAST_PPS: 0.05, Reaction.SQS: 0.15, Reaction.SBT: 0.5, Reaction.HW: 0.0}
STOPS = tuple(ALLOWED_S)


def arbiter_in(mode: Mode) -> Arbiter:
    """An arbiter in one mode; STOPPING by the mildest stop there is, a stop that the operator asked for."""
    arbiter = Arbiter(ALLOWED_S.__getitem__)
    if mode is not Mode.OFF:
        arbiter.enter(Mode.STANDING)
    if mode in (Mode.MOVING, Mode.STOPPING):
        arbiter.enter(Mode.MOVING)
    if mode is Mode.STOPPING:
        arbiter.raise_(finding(Trigger.OPERATOR_STOP), 1.0)
    assert arbiter.mode is mode
    return arbiter


def finding(trigger: Trigger) -> Finding:
    return Finding(trigger, DriveFault("A.X", trigger.value, value=1))


def test_every_trigger_has_a_reaction_in_every_mode() -> None:
    assert set(REACTIONS) == set(product(Trigger, Mode))
    assert set(WORDS) == set(Reaction)
    assert list(Reaction) == sorted(Reaction)


def test_the_table_keeps_the_rules_of_the_house() -> None:
    for (trigger, mode), reaction in REACTIONS.items():
        if mode is Mode.OFF:
            assert reaction <= Reaction.NOGO, "without power there is nothing to stop"
        elif mode is Mode.STANDING:
            assert not Reaction.PPS <= reaction <= Reaction.FAST_PPS, "at rest there is no path to stop on"
        else:
            assert reaction >= Reaction.PPS, f"{trigger} lets a move go on"
        if reaction is Reaction.SBT:
            assert trigger in (Trigger.DRIFT, Trigger.EMERGENCY_STOP), "torque goes off where none can be relied on"
    for trigger in Trigger:
        assert REACTIONS[trigger, Mode.STOPPING] >= REACTIONS[trigger, Mode.MOVING]
    for jam in (Trigger.STUCK, Trigger.COUPLING, Trigger.PREDICTED_FORCE, Trigger.MEASURED_FORCE, Trigger.OVERLOAD):
        assert REACTIONS[jam, Mode.MOVING] is Reaction.FAST_PPS
    for unled in (Trigger.AXIS_OFF, Trigger.DRIVE_FAULT, Trigger.HEARTBEAT_LOST, Trigger.NODE_RESTARTED):
        assert REACTIONS[unled, Mode.MOVING] is Reaction.SQS
    assert REACTIONS[Trigger.LINK_LOST, Mode.MOVING] is Reaction.HW
    assert REACTIONS[Trigger.DRIFT, Mode.STANDING] is Reaction.SBT


@pytest.mark.parametrize("mode", Mode)
def test_every_trigger_in_every_mode_with_every_second_trigger(mode: Mode) -> None:
    for one, two in product(Trigger, Trigger):
        arbiter = arbiter_in(mode)
        first = finding(one)
        before = arbiter.reaction
        got = arbiter.raise_(first, 1.0)
        asked = REACTIONS[one, mode]
        assert got == arbiter.reaction == max(before, asked if asked > Reaction.REJ else Reaction.NONE)
        kept = first if one not in REQUESTS else None
        assert arbiter.first is kept
        assert arbiter.mode is (Mode.STOPPING if max(before, asked) >= Reaction.PPS else mode)
        later = finding(two)
        severity = arbiter.raise_(later, 1.0 + CYCLE_S)
        assert severity >= got, f"{one.name} then {two.name} got milder"
        if (one, two) == (Trigger.DRIVE_WARNING, Trigger.DRIVE_FAULT):
            assert (arbiter.first, arbiter.later) == (later, (first,)), "the warning only announced the fault"
        elif kept is not None:
            assert arbiter.first is kept, "the first cause is kept"
            assert arbiter.later == ((later,) if two not in REQUESTS and two is not one else ())
        else:
            assert arbiter.first is (later if two not in REQUESTS else None)
        assert_escalates(arbiter, severity)


def assert_escalates(arbiter: Arbiter, reaction: Reaction) -> None:
    """What never comes to an end becomes harder: quick stop, then hardware, each after its own time and no later."""
    if arbiter.mode is not Mode.STOPPING:
        return
    now_s, begun_s, seen = 1.0 + CYCLE_S, {reaction: 1.0 + CYCLE_S}, [reaction]
    first = arbiter.first
    while arbiter.reaction is not Reaction.HW:
        now_s += CYCLE_S
        after = arbiter.poll(now_s, False)
        assert after >= seen[-1]
        if after is not seen[-1]:
            taken_s = now_s - begun_s[seen[-1]]
            # A second trigger of the same severity does not prolong the first one's time.
            assert ALLOWED_S[seen[-1]] - 1.5 * CYCLE_S <= taken_s <= ALLOWED_S[seen[-1]] + 1.5 * CYCLE_S
            begun_s[after] = now_s
            seen.append(after)
        assert now_s < 3.0
    assert len(seen) <= 3
    assert arbiter.first is first or first is None
    if len(seen) > 1:
        known = (arbiter.first, *arbiter.later)
        assert any(f is not None and isinstance(f.error, StopOverdue) for f in known)
    assert arbiter.poll(now_s + 100.0, True) is Reaction.HW, "latched"
    assert arbiter.mode is Mode.STOPPING


@pytest.mark.parametrize(
    ("trigger", "seen"),
    [
        (Trigger.TICK_LATE, (Reaction.PPS, Reaction.SQS, Reaction.HW)),
        (Trigger.STUCK, (Reaction.FAST_PPS, Reaction.SQS, Reaction.HW)),
        (Trigger.DRIVE_FAULT, (Reaction.SQS, Reaction.HW)),
    ],
)
def test_the_way_up(trigger: Trigger, seen: tuple[Reaction, ...]) -> None:
    arbiter = arbiter_in(Mode.MOVING)
    met = [arbiter.raise_(finding(trigger), 0.0)]
    met += [arbiter.poll(cycle * CYCLE_S, False) for cycle in range(200)]
    assert tuple(dict.fromkeys(met)) == seen
    assert [f.trigger for f in arbiter.later][-1] is Trigger.QUICK_STOP_OVERDUE


@pytest.mark.parametrize("trigger", [t for t in Trigger if Reaction.PPS <= REACTIONS[t, Mode.MOVING] < Reaction.HW])
def test_a_stop_that_ends_in_time_stays_what_it_was(trigger: Trigger) -> None:
    arbiter = arbiter_in(Mode.MOVING)
    reaction = arbiter.raise_(finding(trigger), 0.0)
    arbiter.poll(0.9 * ALLOWED_S[reaction], False)
    arbiter.poll(0.95 * ALLOWED_S[reaction], True)
    for cycle in range(500):
        arbiter.poll(1.0 + cycle * CYCLE_S, True)
    assert arbiter.mode is (Mode.OFF if reaction is Reaction.SBT else Mode.STANDING)
    assert arbiter.reaction is (Reaction.NONE if trigger in REQUESTS else reaction)
    assert arbiter.latched is (trigger not in REQUESTS)


def test_a_time_that_is_no_number_counts_as_overdue() -> None:
    arbiter = arbiter_in(Mode.MOVING)
    arbiter.raise_(finding(Trigger.TICK_LATE), 0.0)
    assert arbiter.poll(float("nan"), False) is Reaction.SQS


def test_a_drive_in_fault_ends_with_brakes_only_where_it_stands() -> None:
    arbiter = arbiter_in(Mode.STANDING)
    assert arbiter.raise_(finding(Trigger.DRIFT), 0.0) is Reaction.SBT
    arbiter.poll(0.1, True)
    assert arbiter.mode is Mode.OFF
    assert arbiter.latched


def test_nothing_begins_while_a_fault_is_kept() -> None:
    arbiter = arbiter_in(Mode.STANDING)
    arbiter.raise_(finding(Trigger.UNDERLOAD), 0.0)
    for mode in (Mode.MOVING, Mode.STOPPING):
        with pytest.raises(EventRefused):
            arbiter.enter(mode)


def stopped(trigger: Trigger) -> Arbiter:
    """At rest after a stop, the cause gone."""
    arbiter = arbiter_in(Mode.MOVING)
    arbiter.raise_(finding(trigger), 0.0)
    arbiter.poll(0.01, True)
    arbiter.poll(0.02, True)
    return arbiter


@pytest.mark.parametrize(("trigger", "role"), list(product(Trigger, Role)))
def test_who_may_reset_what(trigger: Trigger, role: Role) -> None:
    if REACTIONS[trigger, Mode.MOVING] is Reaction.HW or trigger in FINAL | REQUESTS:
        return
    arbiter = stopped(trigger)
    if role is Role.SUPERVISOR or (role is Role.OPERATOR and trigger in OPERATORS_OWN):
        arbiter.reset(role, 1.0)
        assert (arbiter.reaction, arbiter.first, arbiter.later) == (Reaction.NONE, None, ())
        assert arbiter.mode in (Mode.STANDING, Mode.OFF), "a reset moves nothing"
    else:
        with pytest.raises(EventRefused, match="supervisor"):
            arbiter.reset(role, 1.0)
        assert arbiter.latched


def test_a_later_cause_asks_for_its_own_role() -> None:
    arbiter = arbiter_in(Mode.MOVING)
    arbiter.raise_(finding(Trigger.PERMISSIVE_LOST), 0.0)
    arbiter.raise_(finding(Trigger.STUCK), 0.0)
    arbiter.poll(0.01, True)
    arbiter.poll(0.02, True)
    with pytest.raises(EventRefused, match="supervisor"):
        arbiter.reset(Role.OPERATOR, 1.0)


def test_no_reset_while_the_cause_is_there_and_no_held_key_afterwards() -> None:
    arbiter = stopped(Trigger.OVERLOAD)
    arbiter.raise_(finding(Trigger.OVERLOAD), 1.0)
    with pytest.raises(EventRefused, match="still there"):
        arbiter.reset(Role.SUPERVISOR, 1.0)
    arbiter.poll(1.0, True)
    with pytest.raises(EventRefused, match="still there"):
        arbiter.reset(Role.SUPERVISOR, 1.1)
    now_s = 1.1
    while now_s < 3.0:
        now_s += 0.1
        arbiter.poll(now_s, True)
        with pytest.raises(EventRefused, match="held down"):
            arbiter.reset(Role.SUPERVISOR, now_s)
    arbiter.reset(Role.SUPERVISOR, now_s + RELEASE_S)
    assert not arbiter.latched


def test_no_reset_in_motion_after_the_hardware_chain_or_after_a_defect() -> None:
    arbiter = arbiter_in(Mode.MOVING)
    with pytest.raises(EventRefused, match="nothing"):
        arbiter.reset(Role.SUPERVISOR, 0.0)
    arbiter.raise_(finding(Trigger.TICK_LATE), 1.0)
    arbiter.poll(1.0, False)
    arbiter.poll(1.01, False)
    with pytest.raises(EventRefused, match="not at rest"):
        arbiter.reset(Role.SUPERVISOR, 2.0)
    lost = stopped(Trigger.LINK_LOST)
    with pytest.raises(EventRefused, match="hardware chain"):
        lost.reset(Role.SUPERVISOR, 3.0)
    broken = arbiter_in(Mode.MOVING)
    broken.raise_(Finding(Trigger.DEFECT, Defect("motion", "ZeroDivisionError")), 0.0)
    broken.poll(0.01, True)
    broken.poll(0.02, True)
    with pytest.raises(EventRefused, match="error"):
        broken.reset(Role.SUPERVISOR, 3.0)


def test_another_drives_fault_does_not_take_the_place_of_a_warning() -> None:
    arbiter = arbiter_in(Mode.MOVING)
    warning = Finding(Trigger.DRIVE_WARNING, DriveFault("A.X", value=0x4210))
    fault = Finding(Trigger.DRIVE_FAULT, DriveFault("B.X", value=0x2310))
    arbiter.raise_(warning, 0.0)
    assert arbiter.raise_(fault, 0.01) is Reaction.SQS
    assert (arbiter.first, arbiter.later) == (warning, (fault,))


@pytest.mark.parametrize("trigger", [Trigger.ENCODER_JUMP, Trigger.NODE_RESTARTED])
def test_an_axis_without_reference_is_acknowledged_by_a_supervisor(trigger: Trigger) -> None:
    """Whatever the first cause was, and however many axes it is."""
    arbiter = arbiter_in(Mode.MOVING)
    arbiter.require_referenced()
    arbiter.raise_(finding(Trigger.LEASE_LOST), 0.0)
    for axis in ("B.X", "C.Z", "B.X"):
        arbiter.raise_(Finding(trigger, DriveFault(axis, value=1)), 0.0)
    arbiter.poll(0.01, True)
    arbiter.poll(0.02, True)
    with pytest.raises(AxisUnreferenced, match=r"B\.X, C\.Z") as caught:
        arbiter.require_referenced()
    assert finding(Trigger.LEASE_LOST).error.text() in caught.value.text(), "the reason is told"
    with pytest.raises(EventRefused, match=r"B\.X, C\.Z lost its reference.*supervisor"):
        arbiter.reset(Role.OPERATOR, 1.0)
    arbiter.reset(Role.SUPERVISOR, 2.0)
    arbiter.require_referenced()


def test_only_known_roles_reset() -> None:
    assert [Role.named(role.value) for role in Role] == list(Role)
    with pytest.raises(BadArgument, match="cleaner"):
        Role.named("cleaner")


def test_what_is_dropped_is_counted() -> None:
    arbiter = arbiter_in(Mode.STANDING)
    assert arbiter.raise_(finding(Trigger.OPERATOR_STOP), 0.0) is Reaction.NONE
    assert (arbiter.rejected, arbiter.latched) == (1, False)


def test_the_published_table_is_the_programs() -> None:
    page = Path(__file__).parents[3] / "docs" / "stop-reactions.md"
    assert page.read_text("utf-8") == document()
