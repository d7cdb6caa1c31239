"""The tick over drives that take one set-point a cycle: start, hold, stop, faults, and what may not be started."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import numpy as np
import pytest

from docking.errors import (
    AxisNotEnabled,
    ConsistencyTrip,
    Defect,
    DriveFault,
    EventRefused,
    FeedbackMissing,
    FollowingErrorTrip,
    LinkLost,
    PlanStale,
    TickLate,
)
from docking.motion import StreamedMotion
from docking.types import AxisState
from sim.virtual_time import run_virtual
from tests.support.motion_fakes import LATE_CYCLES, StreamedFake, read_back, watch_of
from tests.support.planned_moves import a_plan, lab_site
from tests.support.rigid_figure import path_gap_mm, rigid_gap_mm, sockets_mm

SITE = lab_site()
PLAN = a_plan(SITE, 3)
NEXT = a_plan(SITE, 4, start_mm=np.array(PLAN.q_mm[-1]))
POSITIONERS = SITE.positioners


class Bench:
    """A motion side, enabled, over the fake drives."""

    def __init__(self, start_mm=None) -> None:
        self.bus = StreamedFake(POSITIONERS.axes, np.array(PLAN.q_mm[0]) if start_mm is None else start_mm)
        self.bus.a_quick_mm_s2 = POSITIONERS.a_quick_mm_s2
        self.motion = StreamedMotion(self.bus, watch_of(POSITIONERS), LATE_CYCLES)

    async def begin(self):
        """Enable, load the plan, start it; returns the task of the move."""
        await self.motion.enable()
        await self.motion.load(PLAN)
        return asyncio.get_running_loop().create_task(self.motion.start(PLAN.plan_hash))

    def assert_on_the_path(self) -> None:
        sent = np.array(self.bus.sent)
        where = POSITIONERS.origins_W_mm, POSITIONERS.axes_W
        assert rigid_gap_mm(sockets_mm(*where, PLAN.q_mm[0])[0], sockets_mm(*where, sent)).max() <= 1e-6
        assert path_gap_mm(PLAN.q_mm, sent[::5]).max() <= 1e-3


def on_bench(scenario):
    """Run `scenario(bench)` in virtual time, close, and see that nothing is left over."""

    async def main():
        bench = Bench()
        result = await scenario(bench)
        await bench.motion.close()
        assert bench.bus.closed
        assert asyncio.all_tasks() == {asyncio.current_task()}
        sent = len(bench.bus.sent)
        await asyncio.sleep(1.0)
        assert len(bench.bus.sent) == sent, "a tick goes on after closing"
        return result

    return run_virtual(main)


def after(seconds: float, call, *args) -> None:
    asyncio.get_running_loop().call_later(seconds, call, *args)


def test_a_plan_is_played_to_its_end():
    async def scenario(bench):
        result = await (await bench.begin())
        assert result.result == "done"
        assert result.cause is None
        np.testing.assert_array_equal(result.commanded_mm, PLAN.q_mm[-1])
        assert result.path_time_s == pytest.approx(PLAN.duration_s)
        bench.assert_on_the_path()
        gaps = [b - a for a, b in pairwise(bench.bus.sent_at_s)]
        np.testing.assert_allclose(gaps, 0.01, atol=1e-9)
        # The read-back is judged against the set-point it belongs to: exact drives leave nothing.
        assert result.max_residual_mm <= 1e-9

    on_bench(scenario)


def test_enabling_commands_every_axis_to_where_it_stands():
    async def scenario(bench):
        bench.bus.offset_mm = np.linspace(-1.0, 1.0, 12)
        q = await bench.motion.enable()
        np.testing.assert_allclose(q, PLAN.q_mm[0] + bench.bus.offset_mm)
        await asyncio.sleep(0.1)
        assert len(bench.bus.sent) >= 10
        for sent in bench.bus.sent:
            np.testing.assert_array_equal(sent, q)

    on_bench(scenario)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.5, 0.75, 0.95])
def test_a_hold_rests_on_the_path_and_a_resume_goes_to_the_end(share):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(share * PLAN.duration_s)
        bench.motion.request("hold")
        await asyncio.sleep(1.5 / PLAN.rate_slew_per_s + 0.05)
        rest = np.array(bench.bus.sent[-1])
        await asyncio.sleep(3.0)
        if not move.done():
            np.testing.assert_array_equal(bench.bus.sent[-1], rest)
            bench.motion.request("resume")
        assert (await move).result == "done"
        np.testing.assert_array_equal(bench.bus.sent[-1], PLAN.q_mm[-1])
        bench.assert_on_the_path()

    on_bench(scenario)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.75])
@pytest.mark.parametrize("held", [False, True])
def test_a_stop_ends_the_move_on_the_path(share, held):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(share * PLAN.duration_s)
        if held:
            bench.motion.request("hold")
            await asyncio.sleep(2.0)
        bench.motion.request("stop")
        bench.motion.request("resume")
        result = await move
        assert (result.result, result.cause) == ("stopped", None)
        assert 0.0 < result.path_time_s < PLAN.duration_s
        np.testing.assert_array_equal(result.commanded_mm, bench.bus.sent[-1])
        rest = np.array(bench.bus.sent[-1])
        await asyncio.sleep(2.0)
        np.testing.assert_array_equal(bench.bus.sent[-1], rest)
        bench.assert_on_the_path()
        # The plan is spent: it does not begin where the axes now are.
        with pytest.raises(PlanStale):
            await bench.motion.load(PLAN)

    on_bench(scenario)


@pytest.mark.parametrize("loaded", [False, True])
def test_a_stop_before_the_first_set_point_moves_nothing(loaded):
    async def scenario(bench):
        await bench.motion.enable()
        if not loaded:
            bench.motion.request("stop")
        await bench.motion.load(PLAN)
        if loaded:
            bench.motion.request("stop")
        result = await bench.motion.start(PLAN.plan_hash)
        assert result.result == "stopped"
        for sent in bench.bus.sent:
            np.testing.assert_allclose(sent, PLAN.q_mm[0], atol=1e-12)
        # It was for that move alone.
        await bench.motion.load(PLAN)
        assert (await bench.motion.start(PLAN.plan_hash)).result == "done"

    on_bench(scenario)


def test_a_hold_before_the_first_set_point_waits_for_the_resume():
    async def scenario(bench):
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        bench.motion.request("hold")
        move = asyncio.get_running_loop().create_task(bench.motion.start(PLAN.plan_hash))
        await asyncio.sleep(2.0)
        np.testing.assert_allclose(bench.bus.sent[-1], PLAN.q_mm[0], atol=1e-12)
        bench.motion.request("resume")
        assert (await move).result == "done"
        bench.assert_on_the_path()

    on_bench(scenario)


def assert_faulted(result, kind, where) -> None:
    assert result.result == "fault"
    assert isinstance(result.cause, kind)
    assert result.cause.where == where


def test_a_trip_stops_all_axes_on_the_path():
    async def scenario(bench):
        move = await bench.begin()
        errors = np.zeros(12)
        errors[4] = 2.0
        after(0.5 * PLAN.duration_s, bench.bus.changes.__setitem__, "following_error_mm", errors)
        result = await move
        assert_faulted(result, FollowingErrorTrip, "B.Y")
        assert 0.49 * PLAN.duration_s < result.path_time_s < PLAN.duration_s
        assert bench.bus.quick_stops == 0, "the drives still follow: they are led to rest along the path"
        bench.assert_on_the_path()

    on_bench(scenario)


def test_a_trip_stops_as_hard_as_the_axes_can_and_no_harder():
    async def scenario(bench):
        move = await bench.begin()
        errors = np.zeros(12)
        errors[4] = 2.0
        trip_s = 0.5 * PLAN.duration_s
        after(trip_s, bench.bus.changes.__setitem__, "following_error_mm", errors)
        # Nobody's hold makes the stop of a fault a softer one.
        after(trip_s + 0.025, bench.motion.request, "hold")
        begun = asyncio.get_running_loop().time()
        await move
        assert asyncio.get_running_loop().time() - begun - trip_s <= 0.09
        bend = np.abs(np.diff(np.array(bench.bus.sent), 2, axis=0)) / 1e-4
        assert (bend.max(axis=0) <= POSITIONERS.a_quick_mm_s2 * 1.001).all()
        assert bend.max() > 2.0 * POSITIONERS.a_mm_s2.max()

    on_bench(scenario)


def test_a_drive_that_faults_while_a_trip_is_led_to_rest_makes_all_stop_by_themselves():
    async def scenario(bench):
        move = await bench.begin()
        errors = np.zeros(12)
        errors[4] = 2.0
        after(1.0, bench.bus.changes.__setitem__, "following_error_mm", errors)
        after(1.02, bench.bus.changes.__setitem__, "fault", ("B.Y", 0x8611, "following error"))
        assert_faulted(await move, FollowingErrorTrip, "B.Y")
        await asyncio.sleep(0.5)
        assert bench.bus.quick_stops == 1

    on_bench(scenario)


def test_a_coupling_trip_stops_all_axes_on_the_path():
    async def scenario(bench):
        move = await bench.begin()
        away = -0.01 * (np.arange(12) == 4)
        for cycle in range(40):
            after(0.5 * PLAN.duration_s + 0.01 * cycle, setattr, bench.bus, "offset_mm", (cycle + 1) * away)
        result = await move
        assert result.result == "fault"
        assert isinstance(result.cause, ConsistencyTrip)
        assert 0.03 < result.max_residual_mm < 0.3
        assert bench.bus.quick_stops == 0
        bench.assert_on_the_path()

    on_bench(scenario)


@pytest.mark.parametrize(
    ("changes", "kind", "where"),
    [
        ({"fault": ("C.X", 0x2310, "overcurrent")}, DriveFault, "C.X"),
        ({"states": (*[AxisState.ENABLED] * 4, AxisState.DISABLED, *[AxisState.ENABLED] * 7)}, AxisNotEnabled, "B.Y"),
    ],
)
def test_a_drive_that_cannot_be_led_makes_all_stop_by_themselves(changes, kind, where):
    async def scenario(bench):
        move = await bench.begin()
        after(0.5 * PLAN.duration_s, bench.bus.changes.update, changes)
        assert_faulted(await move, kind, where)
        assert bench.bus.quick_stops == 1

    on_bench(scenario)


def test_an_axis_that_does_not_report_is_answered_on_the_path_as_hard_as_the_axes_can():
    async def scenario(bench):
        move = await bench.begin()
        ages = np.array([0.0] * 9 + [5.0, 0.0, 0.0])
        after(0.5 * PLAN.duration_s, bench.bus.changes.__setitem__, "age_cycles", ages)
        result = await move
        assert_faulted(result, FeedbackMissing, "D.X")
        assert bench.bus.quick_stops == 0
        assert result.path_time_s <= 0.5 * PLAN.duration_s + 0.05
        bench.assert_on_the_path()

    on_bench(scenario)


@pytest.mark.parametrize("moving", [True, False])
def test_a_lost_bus_ends_the_move_and_is_told(moving):
    async def scenario(bench):
        lost = LinkLost("can0", "the bus is off")
        if moving:
            move = await bench.begin()
            after(0.5 * PLAN.duration_s, setattr, bench.bus, "error", lost)
            assert_faulted(await move, LinkLost, "can0")
        else:
            await bench.motion.enable()
            bench.bus.error = lost
            await asyncio.sleep(0.1)
        with pytest.raises(LinkLost):
            bench.motion.feedback()
        with pytest.raises(LinkLost):
            await bench.motion.load(PLAN)

    on_bench(scenario)


def test_a_defect_in_the_tick_reaches_whoever_waits_for_the_move():
    async def scenario(bench):
        seen = []
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: seen.append(context["exception"]))
        move = await bench.begin()
        after(0.5 * PLAN.duration_s, setattr, bench.bus, "error", ZeroDivisionError("a defect"))
        with pytest.raises(ZeroDivisionError):
            await move
        assert [type(error) for error in seen] == [ZeroDivisionError]
        assert bench.bus.quick_stops == 1

    on_bench(scenario)


def test_a_defect_at_rest_stops_the_drives_and_is_held():
    async def scenario(bench):
        seen = []
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: seen.append(context["exception"]))
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        bench.bus.error = ZeroDivisionError("a defect")
        await asyncio.sleep(0.05)
        assert [type(error) for error in seen] == [ZeroDivisionError]
        assert bench.bus.quick_stops == 1
        with pytest.raises(Defect, match="ZeroDivisionError: a defect"):
            bench.motion.feedback()
        with pytest.raises(Defect):
            await bench.motion.start(PLAN.plan_hash)

    on_bench(scenario)


DISABLED = (AxisState.DISABLED, *[AxisState.ENABLED] * 11)


def test_an_axis_that_falls_out_at_rest_stops_the_drives_within_a_cycle():
    async def scenario(bench):
        await bench.motion.enable()
        await asyncio.sleep(0.105)
        bench.bus.changes["states"] = DISABLED
        await asyncio.sleep(0.01)
        assert bench.bus.quick_stops == 1
        with pytest.raises(AxisNotEnabled, match=r"A\.X: the axis is disabled"):
            bench.motion.feedback()

    on_bench(scenario)


@pytest.mark.parametrize("loaded", [False, True])
def test_nothing_is_loaded_or_started_with_an_axis_off(loaded):
    async def scenario(bench):
        await bench.motion.enable()
        if loaded:
            await bench.motion.load(PLAN)
        # Seen in the read-back, not yet by a tick.
        bench.motion._feedback = read_back(np.array(PLAN.q_mm[0]), states=DISABLED)
        with pytest.raises(AxisNotEnabled):
            await (bench.motion.start(PLAN.plan_hash) if loaded else bench.motion.load(PLAN))

    on_bench(scenario)


def test_a_fault_is_held_until_the_axes_are_enabled_again():
    async def scenario(bench):
        await bench.motion.enable()
        bench.bus.changes["fault"] = ("C.X", 0x2310, "overcurrent")
        await asyncio.sleep(0.1)
        bench.bus.changes.clear()
        await asyncio.sleep(0.1)
        for ask in (lambda: bench.motion.load(PLAN), lambda: bench.motion.start(PLAN.plan_hash)):
            with pytest.raises(DriveFault):
                await ask()
        with pytest.raises(DriveFault):
            bench.motion.feedback()
        with pytest.raises(DriveFault):
            await bench.motion.enable()
        with pytest.raises(EventRefused, match="supervisor"):
            await bench.motion.reset("operator")
        await bench.motion.reset("supervisor")
        # A reset resumes nothing: the axes have to be enabled, which commands them to where they stand.
        with pytest.raises(PlanStale):
            await bench.motion.load(PLAN)
        await bench.motion.enable()
        assert bench.motion.feedback().fault is None
        await bench.motion.load(PLAN)
        assert (await bench.motion.start(PLAN.plan_hash)).result == "done"
        gaps = [b - a for a, b in pairwise(bench.bus.sent_at_s)]
        assert min(gaps) > 0.005, "two ticks run side by side"

    on_bench(scenario)


def test_the_first_fault_is_kept():
    async def scenario(bench):
        move = await bench.begin()
        errors = np.zeros(12)
        errors[4] = 2.0
        after(1.0, bench.bus.changes.__setitem__, "following_error_mm", errors)
        after(1.05, bench.bus.changes.__setitem__, "fault", ("C.X", 0x2310, "overcurrent"))
        assert_faulted(await move, FollowingErrorTrip, "B.Y")

    on_bench(scenario)


def test_a_fault_between_loading_and_starting_starts_nothing():
    async def scenario(bench):
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        bench.bus.changes["fault"] = ("C.X", 0x2310, "overcurrent")
        await asyncio.sleep(0.1)
        with pytest.raises(DriveFault):
            await bench.motion.start(PLAN.plan_hash)
        np.testing.assert_array_equal(bench.bus.sent[-1], PLAN.q_mm[0])

    on_bench(scenario)


def test_what_may_not_be_loaded_or_started_is_refused():
    async def scenario(bench):
        motion = bench.motion
        with pytest.raises(PlanStale):
            motion.feedback()
        await motion.enable()
        with pytest.raises(PlanStale):
            await motion.load(NEXT)
        with pytest.raises(PlanStale):
            await motion.start(PLAN.plan_hash)
        await motion.load(PLAN)
        with pytest.raises(PlanStale):
            await motion.start(NEXT.plan_hash)
        await motion.load(PLAN)
        move = asyncio.get_running_loop().create_task(motion.start(PLAN.plan_hash))
        await asyncio.sleep(0.05)
        for ask in (lambda: motion.load(PLAN), lambda: motion.start(PLAN.plan_hash), motion.enable):
            with pytest.raises(PlanStale):
                await ask()
        assert (await move).result == "done"
        with pytest.raises(PlanStale):
            await motion.start(PLAN.plan_hash)
        await motion.load(NEXT)
        assert (await motion.start(NEXT.plan_hash)).result == "done"
        np.testing.assert_array_equal(bench.bus.sent[-1], NEXT.q_mm[-1])

    on_bench(scenario)


@pytest.mark.parametrize("how", ["close", "cancel"])
def test_a_move_that_nobody_waits_for_is_stopped_on_the_path(how):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        if how == "cancel":
            move.cancel()
            with pytest.raises(asyncio.CancelledError):
                await move
            # Nobody closes anything: the stop follows from the cancelling alone.
            await asyncio.sleep(0.4 * PLAN.duration_s)
            np.testing.assert_array_equal(bench.bus.sent[-1], bench.bus.sent[-2])
            assert np.abs(bench.bus.sent[-1] - PLAN.q_mm[-1]).max() > 0.1, "it ran to its end"
        await bench.motion.close()
        steps = np.abs(np.diff(np.array(bench.bus.sent), axis=0)).max(axis=1) / 0.01
        assert steps[-1] < 0.05 * steps.max(), "the last set-points before closing still move"
        bench.assert_on_the_path()
        await asyncio.gather(move, return_exceptions=True)

    on_bench(scenario)


@pytest.mark.parametrize("late_s", [0.19, 0.06])
def test_how_late_a_tick_may_come_is_the_cells_to_say(late_s):
    async def scenario(bench):
        bench.motion = StreamedMotion(bench.bus, watch_of(POSITIONERS), LATE_CYCLES if late_s > 0.1 else 5)
        move = await bench.begin()
        loop = asyncio.get_running_loop()
        after(0.5 * PLAN.duration_s, lambda: setattr(loop, "_now", loop.time() + late_s))
        result = await move
        if late_s > 0.1:
            assert result.result == "done"
        else:
            assert isinstance(result.cause, TickLate)
            assert result.cause.limit == pytest.approx(0.05)

    on_bench(scenario)


def test_a_tick_that_comes_far_too_late_trips():
    async def scenario(bench):
        move = await bench.begin()
        loop = asyncio.get_running_loop()
        after(0.5 * PLAN.duration_s, lambda: setattr(loop, "_now", loop.time() + 0.5))
        result = await move
        assert isinstance(result.cause, TickLate)
        assert result.cause.value == pytest.approx(0.5, abs=0.02)
        gaps = [b - a for a, b in pairwise(bench.bus.sent_at_s)]
        assert min(gaps) > 0.005, "missed cycles are made up for in a burst"

    on_bench(scenario)
