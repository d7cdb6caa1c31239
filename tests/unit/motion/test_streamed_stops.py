"""How the tick carries out what the arbiter decides: same cycle, all axes, escalation, brakes, silence, override."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.errors import (
    AxisDrift,
    AxisNotEnabled,
    AxisUnreferenced,
    BadArgument,
    DriveFault,
    EncoderJump,
    EventRefused,
    LinkLost,
    MeasuredForceTrip,
    PlanStale,
    StopOverdue,
)
from docking.kinematics import axis_forces_n, ball_reactions_n, pose_from_axes
from docking.motion import StreamedMotion
from docking.motion.arbiter import Mode, Reaction
from docking.motion.monitors import Watch
from docking.motion.playback import Playback
from docking.motion.stops import planned_stop
from docking.motion.triggers import Finding, Trigger
from docking.types import AxisState, FaultKind
from sim.virtual_time import run_virtual
from tests.support.motion_fakes import LATE_CYCLES, LIMITS, LOAD, StreamedFake, watch_of
from tests.support.planned_moves import a_plan, lab_site
from tests.support.rigid_figure import path_gap_mm, rigid_gap_mm, sockets_mm

SITE = lab_site()
PLAN = a_plan(SITE, 3)
POSITIONERS = SITE.positioners
WHERE = POSITIONERS.origins_W_mm, POSITIONERS.axes_W
CYCLE_S = 0.01
OFF = (*[AxisState.ENABLED] * 4, AxisState.DISABLED, *[AxisState.ENABLED] * 7)


class Bench:
    """A motion side, enabled, over the fake drives."""

    def __init__(self) -> None:
        self.bus = StreamedFake(POSITIONERS.axes, np.array(PLAN.q_mm[0]))
        self.motion = StreamedMotion(self.bus, watch_of(POSITIONERS), LATE_CYCLES)
        self.loop = asyncio.get_running_loop()

    async def begin(self):
        await self.motion.enable()
        await self.motion.load(PLAN)
        return self.loop.create_task(self.motion.start(PLAN.plan_hash))


def on_bench(scenario):
    async def main():
        bench = Bench()
        result = await scenario(bench)
        await bench.motion.close()
        assert asyncio.all_tasks() == {asyncio.current_task()}
        return result

    return run_virtual(main)


def test_a_finding_changes_what_is_sent_in_the_same_tick():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s + 0.005)
        before = np.diff(np.array(bench.bus.sent[-2:]), axis=0)[0]
        bench.bus.changes["following_error_mm"] = 2.0 * (np.arange(12) == 4)
        await asyncio.sleep(CYCLE_S)
        after = np.diff(np.array(bench.bus.sent[-2:]), axis=0)[0]
        # a_quick of 200 mm/s^2 takes more than half of 4 mm/s away within the first cycle.
        assert np.abs(after).max() < 0.8 * np.abs(before).max()
        await move

    on_bench(scenario)


def test_one_axis_that_leaves_makes_all_stop_by_themselves_in_the_tick_that_sees_it():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.005)
        sent = len(bench.bus.sent)
        bench.bus.changes["states"] = OFF
        await asyncio.sleep(CYCLE_S)
        assert bench.bus.quick_stops == 1
        assert len(bench.bus.sent) == sent, "the quick stop is this cycle's frame: set-points come after it"
        rest = bench.bus.changes["states"] = tuple(
            AxisState.DISABLED if state is AxisState.DISABLED else AxisState.STOPPING for state in OFF
        )
        result = await move
        assert isinstance(result.cause, AxisNotEnabled)
        assert bench.motion.arbiter.reaction is Reaction.SQS
        sent = np.array(bench.bus.sent[sent:])
        np.testing.assert_array_equal(sent, np.broadcast_to(sent[0], sent.shape), "path time goes on in a quick stop")
        # What the stop left behind is no cause that keeps a reset away; enabling brings the axes back.
        await bench.motion.reset("supervisor")
        assert rest
        del bench.bus.changes["states"]
        await bench.motion.enable()
        assert bench.motion.feedback() is not None

    on_bench(scenario)


def test_ramps_are_armed_in_proportion_before_every_move():
    async def scenario(bench):
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        ((peak, t_stop_s),) = bench.bus.armed
        largest = np.abs(np.diff(PLAN.q_mm, axis=0)).max(axis=0) / PLAN.period_s
        np.testing.assert_allclose(peak, largest, rtol=1e-12)
        assert t_stop_s == pytest.approx(max(largest.max() / 200.0, CYCLE_S))
        stop = planned_stop(PLAN, bench.bus.a_quick_mm_s2, CYCLE_S)
        speed = np.abs(np.diff(PLAN.q_mm, axis=0)) / PLAN.period_s
        assert (speed / (peak / t_stop_s) <= stop.t_stop_s * (1.0 + 1e-9)).all(), "every axis is at rest by then"

    on_bench(scenario)


def test_a_stop_on_the_path_that_does_not_end_becomes_a_quick_stop_then_silence():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        playback = bench.motion._move.playback
        playback.hold = playback.stop_straight = lambda *_: None
        # Path time cannot be stopped, and the drives do not come to rest either: the positions go on by themselves.
        bench.motion.request("stop")
        begun_s, silent_s = bench.loop.time(), None
        quick_s = None
        for cycle in range(400):
            await asyncio.sleep(CYCLE_S)
            if quick_s is None and bench.bus.quick_stops:
                quick_s = bench.loop.time() - begun_s
            if quick_s is not None:
                bench.bus.offset_mm = np.full(12, 0.01 * (cycle % 2))
            if silent_s is None and bench.bus.silent:
                silent_s = bench.loop.time() - begun_s
                break
        stop = planned_stop(PLAN, bench.bus.a_quick_mm_s2, CYCLE_S)
        assert quick_s == pytest.approx(1.5 / PLAN.rate_slew_per_s + 2 * CYCLE_S, abs=1.5 * CYCLE_S)
        assert silent_s - quick_s == pytest.approx(stop.t_stop_s + 0.1, abs=2.0 * CYCLE_S)
        result = await move
        assert result.result == "fault"
        assert isinstance(result.cause, StopOverdue)
        sent = len(bench.bus.sent)
        await asyncio.sleep(1.0)
        assert len(bench.bus.sent) == sent, "silence means silence"
        with pytest.raises(StopOverdue):
            await bench.motion.enable()

    on_bench(scenario)


def test_a_lost_link_ends_in_silence():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.bus.error = LinkLost("can0", "bus off")
        result = await move
        assert isinstance(result.cause, LinkLost)
        assert bench.bus.silent
        assert bench.motion.arbiter.reaction is Reaction.HW

    on_bench(scenario)


@pytest.mark.parametrize("brakes_hold", [True, False])
def test_an_axis_that_drifts_at_rest_is_braked_with_all_others(brakes_hold):
    async def scenario(bench):
        if not brakes_hold:
            bench.bus.brake_s = 60.0
        await bench.motion.enable()
        await asyncio.sleep(0.5)
        for step in range(30):
            bench.bus.offset_mm = 0.002 * step * (np.arange(12) == 2)
            await asyncio.sleep(CYCLE_S)
        with pytest.raises(AxisDrift):
            bench.motion.feedback()
        assert bench.bus.quick_stops == 1
        await asyncio.sleep(3.0)
        assert bench.bus.brakes == (1 if brakes_hold else 0)
        assert bench.bus.silent is not brakes_hold, "brakes that are not confirmed open the hardware chain"
        if brakes_hold:
            assert bench.motion.arbiter.mode is Mode.OFF

    on_bench(scenario)


def test_a_drive_that_complains_does_not_hide_one_that_left():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.bus.changes |= {"fault": ("A.X", 0x4210, "drive too hot"), "states": OFF}
        result = await move
        assert isinstance(result.cause, DriveFault | AxisNotEnabled)
        assert bench.bus.quick_stops == 1

    on_bench(scenario)


def test_an_operators_stop_is_no_fault():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.motion.request("stop")
        assert bench.motion.arbiter.reaction is Reaction.PPS
        assert (await move).result == "stopped"
        arbiter = bench.motion.arbiter
        assert (arbiter.reaction, arbiter.mode, arbiter.latched) == (Reaction.NONE, Mode.STANDING, False)
        assert Trigger.OPERATOR_STOP not in {f.trigger for f in arbiter.later}

    on_bench(scenario)


def test_a_late_tick_in_a_stop_makes_it_longer_not_harder():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.motion.request("stop")
        ramp_s = 1.5 / PLAN.rate_slew_per_s
        await asyncio.sleep(0.9 * ramp_s)
        bench.loop._now += 0.15
        assert (await move).result == "stopped"
        assert bench.bus.quick_stops == 0

    on_bench(scenario)


def test_lateness_is_counted():
    async def scenario(bench):
        await bench.motion.enable()
        await asyncio.sleep(1.0)
        assert bench.motion.lateness.samples == pytest.approx(100, abs=2)
        bench.loop._now += 0.05
        await asyncio.sleep(0.1)
        assert bench.motion.lateness.worst_s == pytest.approx(0.05, abs=0.011)

    on_bench(scenario)


@pytest.mark.parametrize("bad", [-1.0, 100.1, float("nan"), float("inf")])
def test_an_impossible_override_is_refused(bad):
    async def scenario(bench):
        with pytest.raises(BadArgument):
            bench.motion.override(bad)

    on_bench(scenario)


def test_the_override_outlasts_a_hold_and_the_move():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.motion.override(50.0)
        await asyncio.sleep(1.5 / PLAN.rate_slew_per_s)
        playback = bench.motion._move.playback
        assert playback.rate == 0.5
        bench.motion.request("hold")
        bench.motion.override(25.0)
        await asyncio.sleep(2.0)
        assert playback.standing
        bench.motion.request("resume")
        await asyncio.sleep(2.0 / PLAN.rate_slew_per_s)
        assert playback.rate == 0.25
        bench.motion.override(100.0)
        assert (await move).result == "done"
        np.testing.assert_array_equal(bench.bus.sent[-1], PLAN.q_mm[-1])
        bench.motion.override(30.0)
        back = a_plan(SITE, 4, start_mm=np.array(PLAN.q_mm[-1]))
        await bench.motion.load(back)
        begun_s = bench.loop.time()
        await bench.motion.start(back.plan_hash)
        assert bench.loop.time() - begun_s == pytest.approx(back.duration_s / 0.3, rel=0.02)

    on_bench(scenario)


VERBS = st.lists(
    st.tuples(
        st.integers(1, 60),
        st.one_of(
            st.just("hold"), st.just("resume"), st.just("fast"), st.floats(0.0, 1.0).map(lambda share: f"{share:.3f}")
        ),
    ),
    max_size=12,
)


@settings(max_examples=60, deadline=None)
@given(verbs=VERBS)
def test_hold_resume_override_and_stops_change_the_rate_never_the_path(verbs):
    playback = Playback(PLAN)
    slew = planned_stop(PLAN, POSITIONERS.a_quick_mm_s2, CYCLE_S).fast_slew_per_s
    sent, rates = [np.array(PLAN.q_mm[0])], [1.0]
    for cycles, verb in [(5, "resume"), *verbs]:
        if verb == "fast":
            playback.stop_straight(slew)
        elif verb in ("hold", "resume"):
            getattr(playback, verb)()
        else:
            playback.override(float(verb))
        for _ in range(cycles):
            sent.append(playback.advance(CYCLE_S))
            rates.append(playback.rate)
    table, path = np.array(sent), np.array(rates)
    assert rigid_gap_mm(sockets_mm(*WHERE, PLAN.q_mm[0])[0], sockets_mm(*WHERE, table)).max() <= 1e-6
    assert path_gap_mm(PLAN.q_mm, table[:: max(1, len(table) // 60)]).max() <= 1e-4
    assert path.min() >= 0.0
    assert path.max() <= 1.0
    bend = np.abs(np.diff(table, 2, axis=0)) / CYCLE_S**2
    assert (bend <= POSITIONERS.a_quick_mm_s2 * 1.001).all()


def test_a_straight_stop_is_as_hard_as_the_axes_can_and_as_short():
    for share in (0.2, 0.5, 0.8):
        playback = Playback(PLAN)
        stop = planned_stop(PLAN, POSITIONERS.a_quick_mm_s2, CYCLE_S)
        while playback.path_time_s < share * PLAN.duration_s:
            playback.advance(CYCLE_S)
        begun = playback.path_time_s
        playback.stop_straight(stop.fast_slew_per_s)
        while not playback.standing:
            playback.advance(CYCLE_S)
        # v t / 2 of the fastest axis, rounded up to the cycle.
        assert playback.path_time_s - begun <= 0.5 / stop.fast_slew_per_s + CYCLE_S
    assert 1.0 / stop.fast_slew_per_s == pytest.approx(stop.t_stop_s, rel=0.02)


def test_axes_that_can_do_no_better_stop_as_a_hold_does():
    weak = planned_stop(PLAN, POSITIONERS.a_mm_s2, CYCLE_S)
    assert weak.fast_slew_per_s >= PLAN.rate_slew_per_s
    assert planned_stop(PLAN, 0.1 * POSITIONERS.a_mm_s2, CYCLE_S).fast_slew_per_s == PLAN.rate_slew_per_s


def test_a_plan_that_stands_still_is_armed_with_something():
    plan = a_plan(SITE, 3)
    still = replace(plan, q_mm=np.tile(plan.q_mm[0], (len(plan.q_mm), 1)), s=np.zeros(len(plan.s)))
    stop = planned_stop(still, POSITIONERS.a_quick_mm_s2, CYCLE_S)
    assert stop.t_stop_s == CYCLE_S
    np.testing.assert_array_equal(stop.peak_mm_s, 0.0)


@pytest.mark.parametrize(
    ("change", "sent_after_s"),
    [
        ({"following_error_mm": 2.0 * (np.arange(12) == 4)}, 0.0),
        ({"states": OFF}, 0.0),
        ({"fault": ("B.X", 0x4210, "hot"), "fault_kind": FaultKind.DRIVE_WARNING}, 0.0),
    ],
)
def test_a_fault_tells_when_it_was_found_when_commands_changed_and_when_all_stood(change, sent_after_s):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s + 0.005)
        begun_s = bench.loop.time()
        # A warning is one once a newer read-back has come.
        for _ in range(2):
            bench.bus.changes = {**change, "t_s": bench.loop.time()}
            await asyncio.sleep(CYCLE_S)
        while not move.done():
            bench.bus.changes["t_s"] = bench.loop.time()
            await asyncio.sleep(0.1 * CYCLE_S)
        stop = (await move).stop
        assert 0.0 < stop.found_s - begun_s <= 2.5 * CYCLE_S
        assert stop.commanded_s - stop.found_s == pytest.approx(sent_after_s, abs=1e-9), "the same tick"
        sent, at_s = np.array(bench.bus.sent), np.array(bench.bus.sent_at_s)
        last_s = at_s[1:][np.abs(np.diff(sent, axis=0)).max(axis=1) > 1e-5].max()
        # The axes are two cycles behind the set-points, and stand when three read-backs in a row say so.
        assert 2.0 * CYCLE_S <= stop.rest_s - max(last_s, stop.commanded_s) <= 7.0 * CYCLE_S
        assert bench.loop.time() - stop.rest_s <= CYCLE_S

    on_bench(scenario)


def test_a_stop_that_was_asked_for_has_its_times_and_a_plan_that_ran_to_its_end_has_none():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.003)
        asked_s = bench.loop.time()
        bench.motion.request("stop")
        result = await move
        assert (result.result, result.cause) == ("stopped", None)
        assert result.stop.found_s == asked_s
        assert 0.0 < result.stop.commanded_s - asked_s <= CYCLE_S
        assert result.stop.rest_s > asked_s + 1.5 / PLAN.rate_slew_per_s

    async def whole(bench):
        assert (await (await bench.begin())).stop is None

    on_bench(scenario)
    on_bench(whole)


def test_a_fault_in_a_stop_that_was_asked_for_counts_from_itself_on():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.motion.request("stop")
        await asyncio.sleep(0.055)
        found_from_s = bench.loop.time()
        bench.bus.changes["following_error_mm"] = 2.0 * (np.arange(12) == 4)
        stop = (await move).stop
        assert 0.0 <= stop.found_s - found_from_s <= CYCLE_S
        assert stop.commanded_s == stop.found_s

    on_bench(scenario)


def test_an_axis_that_drifts_in_a_hold_is_braked_and_told_as_drift():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.motion.request("hold")
        await asyncio.sleep(1.5 / PLAN.rate_slew_per_s + 0.5)
        while not move.done():
            bench.bus.offset_mm = bench.bus.offset_mm + 0.001 * (np.arange(12) == 7) * (bench.bus.brakes == 0)
            bench.bus.changes["t_s"] = bench.loop.time()
            await asyncio.sleep(CYCLE_S)
        result = await move
        assert isinstance(result.cause, AxisDrift)
        assert result.cause.where == "C.Y"
        assert abs(bench.bus.offset_mm[7]) <= 0.02 + 0.001 * (2 + round(bench.bus.brake_s / CYCLE_S))
        assert (bench.bus.quick_stops, bench.bus.brakes) == (1, 1)
        assert bench.motion.arbiter.mode is Mode.OFF

    on_bench(scenario)


def test_brakes_wait_for_axes_that_still_move():
    """Emergency stop in motion: every drive ramps down by itself, then, once all are seen at rest, brakes close."""

    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.003)
        stopped_s = bench.loop.time()
        bench.motion.report(Finding(Trigger.EMERGENCY_STOP, AxisNotEnabled("cell")))
        assert bench.bus.quick_stops == 1
        rolling_s = 0.06
        while bench.loop.time() - stopped_s < rolling_s:
            bench.bus.offset_mm = bench.bus.offset_mm + 0.05
            await asyncio.sleep(CYCLE_S)
            assert bench.motion._braking.waits
        result = await move
        assert bench.bus.brakes == 1
        took_s = bench.loop.time() - stopped_s
        assert rolling_s + bench.bus.brake_s < took_s <= rolling_s + bench.bus.brake_s + 8 * CYCLE_S
        assert result.stop.commanded_s == result.stop.found_s == stopped_s

    on_bench(scenario)


def test_an_axis_that_lost_its_reference_is_not_enabled_until_a_supervisor_acknowledges():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(1.0)
        bench.bus.offset_mm = 5.0 * (np.arange(12) == 3)
        result = await move
        assert isinstance(result.cause, EncoderJump)
        await asyncio.sleep(0.1)
        with pytest.raises(AxisUnreferenced, match=r"B\.X"):
            await bench.motion.enable()
        with pytest.raises(EventRefused, match=r"B\.X lost its reference"):
            await bench.motion.reset("operator")
        with pytest.raises(AxisUnreferenced):
            await bench.motion.enable()
        await asyncio.sleep(1.0)
        await bench.motion.reset("supervisor")
        sent = len(bench.bus.sent)
        with pytest.raises(PlanStale):
            await bench.motion.start(PLAN.plan_hash)
        assert len(bench.bus.sent) == sent
        await bench.motion.enable()

    on_bench(scenario)


def test_the_work_before_a_move_is_done_just_after_a_tick():
    async def scenario(bench):
        await bench.motion.enable()
        await asyncio.sleep(0.0037)
        begun_s, watch_about = [], bench.motion._watch.watch_about

        def watched(*args, **how):
            begun_s.append(bench.loop.time())
            watch_about(*args, **how)

        bench.motion._watch.watch_about = watched
        await bench.motion.load(PLAN)
        assert begun_s == [bench.bus.sent_at_s[-1]]

    on_bench(scenario)


LIGHT = replace(LOAD, mass_kg=40.0, com_C_mm=POSITIONERS.balls_C_mm.mean(axis=0))


class Weighed(Bench):
    """The same with a load cell under every axis, all reading `force_n`."""

    def __init__(self):
        super().__init__()
        limits = replace(LIMITS, measured_whole_force_n=1000.0, overload=99.0, underload=1e-6, rating=9.0)
        limits = replace(limits, standing_force_n=200.0, measured_force_n=1000.0)
        watch = Watch(POSITIONERS, LIGHT, limits, np.ones(12, dtype=bool))
        self.motion = StreamedMotion(self.bus, watch, LATE_CYCLES)
        self.resting = axis_forces_n(POSITIONERS, stress_free_n(PLAN.q_mm[0]))

    def weigh(self, row=0, value=0.0):
        self.bus.changes = {"force_n": self.resting + value * (np.arange(12) == row), "t_s": self.loop.time()}


def stress_free_n(q_mm):
    """Ball forces (k, 3) that carry the part."""
    X_WC = pose_from_axes(POSITIONERS, q_mm)
    balls = X_WC.apply(POSITIONERS.balls_C_mm)
    centre = balls.mean(axis=0)
    weight_n = LIGHT.mass_kg * LIGHT.gravity_m_s2
    return ball_reactions_n(POSITIONERS, balls - centre, X_WC.apply(LIGHT.com_C_mm) - centre, weight_n)[0]


def test_a_strained_part_is_refused_at_load_and_a_changed_force_at_start_and_resume():
    async def main():
        bench = Weighed()
        bench.weigh(3, 1050.0)
        await bench.motion.enable()
        with pytest.raises(MeasuredForceTrip, match="docking relieve") as caught:
            await bench.motion.load(PLAN)
        assert caught.value.limit == 1000.0
        assert not bench.motion.arbiter.latched, "nothing has happened that would have to be reset"
        with pytest.raises(PlanStale):
            await bench.motion.start(PLAN.plan_hash)
        await bench.motion.load(replace(PLAN, kind="relief"))
        for _ in range(20):
            bench.weigh()
            await asyncio.sleep(0.05)
        await bench.motion.load(PLAN)
        bench.weigh(3, 250.0)
        await asyncio.sleep(0.05)
        with pytest.raises(MeasuredForceTrip, match="measure again"):
            await bench.motion.start(PLAN.plan_hash)
        bench.weigh()
        await asyncio.sleep(0.05)
        await bench.motion.load(PLAN)
        move = bench.loop.create_task(bench.motion.start(PLAN.plan_hash))
        for cycle in range(300):
            bench.weigh()
            if cycle == 100:
                bench.motion.request("hold")
            await asyncio.sleep(CYCLE_S)
        # Between two samples: only the resume itself can see it.
        bench.weigh(3, 250.0)
        await asyncio.sleep(0.011)
        bench.motion.request("resume")
        result = await move
        assert isinstance(result.cause, MeasuredForceTrip), result.cause
        assert "measure again" in result.cause.text()
        assert len({tuple(row) for row in bench.bus.sent[-10:]}) == 1, "it was not resumed"
        await bench.motion.close()

    run_virtual(main)
