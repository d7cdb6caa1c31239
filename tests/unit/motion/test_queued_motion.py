"""Motion over controllers that play a queue: start, hold, stop, faults, and what may not be started."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from docking.errors import (
    AxisNotEnabled,
    BadArgument,
    ConsistencyTrip,
    Defect,
    DeviceSilent,
    DockingError,
    DriveFault,
    EventRefused,
    FollowingErrorTrip,
    LeaseLost,
    LinkLost,
    PlanStale,
)
from docking.motion import QueuedMotion
from docking.motion.arbiter import Reaction
from docking.motion.triggers import Finding, Trigger
from docking.types import AxisState
from sim.virtual_time import run_virtual
from tests.support.motion_fakes import LIMITS, QueuedFake, watch_of
from tests.support.planned_moves import a_plan, lab_site
from tests.support.rigid_figure import path_gap_mm

SITE = lab_site("lab-modbus")
PLAN = a_plan(SITE, 3, period_s=0.1, queued=True)
NEXT = a_plan(SITE, 4, period_s=0.1, queued=True, start_mm=np.array(PLAN.q_mm[-1]))
POSITIONERS = SITE.positioners
POLL_S, RAMP_S = 0.05, 0.5


class Bench:
    """A motion side, enabled, over the fake controllers."""

    def __init__(self, kind=QueuedFake, limits=LIMITS) -> None:
        self.bus = kind(POSITIONERS.axes, np.array(PLAN.q_mm[0]), ramp_s=RAMP_S)
        self.motion = QueuedMotion(self.bus, watch_of(POSITIONERS, limits), POLL_S)

    async def begin(self):
        """Enable, load the plan, start it; returns the task of the move."""
        await self.motion.enable()
        await self.motion.load(PLAN)
        return asyncio.get_running_loop().create_task(self.motion.start(PLAN.plan_hash))


def on_bench(scenario, kind=QueuedFake, limits=LIMITS):
    """Run `scenario(bench)` in virtual time, close, and see that nothing is left over."""

    async def main():
        bench = Bench(kind, limits)
        result = await scenario(bench)
        await bench.motion.close()
        assert bench.bus.closed
        assert asyncio.all_tasks() == {asyncio.current_task()}
        return result

    return run_virtual(main)


def after(seconds: float, call, *args) -> None:
    asyncio.get_running_loop().call_later(seconds, call, *args)


async def rests(bench) -> np.ndarray:
    """Where the axes stand; they must stand still for two seconds."""
    before = bench.bus.position_mm()
    for _ in range(8):
        await asyncio.sleep(0.25)
        await bench.bus.poll()
        np.testing.assert_array_equal(bench.bus.position_mm(), before)
    return before


def test_a_plan_is_played_to_its_end():
    async def scenario(bench):
        result = await (await bench.begin())
        assert (result.result, result.cause) == ("done", None)
        assert bench.bus.verbs == ["run"]
        np.testing.assert_array_equal(result.commanded_mm, PLAN.q_mm[-1])
        assert result.path_time_s == pytest.approx(PLAN.duration_s)
        assert result.max_residual_mm <= 1e-9
        await bench.motion.load(NEXT)
        assert (await bench.motion.start(NEXT.plan_hash)).result == "done"

    on_bench(scenario)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.75, 0.9])
@pytest.mark.parametrize("pause_s", [0.0, 0.2, 0.45, 3.0])
def test_a_hold_rests_and_a_resume_goes_to_the_end_however_soon_it_comes(share, pause_s):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(share * PLAN.duration_s)
        bench.motion.request("hold")
        await asyncio.sleep(pause_s)
        if pause_s > RAMP_S + 2 * POLL_S:
            await rests(bench)
        bench.motion.request("resume")
        result = await move
        assert (result.result, result.cause) == ("done", None)
        # Asked for in one breath they may come to nothing.
        assert bench.bus.verbs in ([["run", "hold", "resume"]] if pause_s else [["run"], ["run", "hold", "resume"]])
        np.testing.assert_array_equal(result.commanded_mm, PLAN.q_mm[-1])

    on_bench(scenario)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.3, 0.5, 0.75])
@pytest.mark.parametrize("held", [False, True])
def test_a_stop_ends_the_move_where_the_axes_stand(share, held):
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(share * PLAN.duration_s)
        if held:
            bench.motion.request("hold")
            await asyncio.sleep(2.0)
        bench.motion.request("stop")
        bench.motion.request("resume")
        result = await move
        stood = await rests(bench)
        assert (result.result, result.cause) == ("stopped", None)
        assert "resume" not in bench.bus.verbs
        np.testing.assert_allclose(result.commanded_mm, stood, atol=1e-9)
        assert path_gap_mm(PLAN.q_mm, stood).max() <= 1e-9
        with pytest.raises(PlanStale):
            await bench.motion.start(PLAN.plan_hash)

    on_bench(scenario)


def test_a_stop_is_over_only_when_the_ramp_is():
    # So slow that two read-backs in a row never differ by more than an axis at rest.
    slow = a_plan(replace(SITE, speed_mm_s=0.03, reach_mm=0.2, turn_deg=0.0), 3, period_s=0.1, queued=True)

    async def scenario(bench):
        loop = asyncio.get_running_loop()
        await bench.motion.enable()
        await bench.motion.load(slow)
        move = loop.create_task(bench.motion.start(slow.plan_hash))
        await asyncio.sleep(2.0)
        bench.motion.request("stop")
        asked = loop.time()
        result = await move
        assert result.result == "stopped"
        assert loop.time() - asked >= RAMP_S
        np.testing.assert_allclose(await rests(bench), result.commanded_mm, atol=1e-9)

    on_bench(scenario)


@pytest.mark.parametrize("loaded", [False, True])
def test_a_stop_before_the_start_moves_nothing(loaded):
    async def scenario(bench):
        await bench.motion.enable()
        if not loaded:
            bench.motion.request("stop")
        await bench.motion.load(PLAN)
        if loaded:
            bench.motion.request("stop")
        result = await bench.motion.start(PLAN.plan_hash)
        assert result.result == "stopped"
        np.testing.assert_array_equal(result.commanded_mm, PLAN.q_mm[0])
        np.testing.assert_array_equal(await rests(bench), PLAN.q_mm[0])
        assert "run" not in bench.bus.verbs
        # It was for that move alone.
        await bench.motion.load(PLAN)
        assert (await bench.motion.start(PLAN.plan_hash)).result == "done"

    on_bench(scenario)


@pytest.mark.parametrize("going", ["resume", "stop"])
def test_a_hold_before_the_start_waits(going):
    async def scenario(bench):
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        bench.motion.request("hold")
        move = asyncio.get_running_loop().create_task(bench.motion.start(PLAN.plan_hash))
        np.testing.assert_array_equal(await rests(bench), PLAN.q_mm[0])
        bench.motion.request(going)
        assert (await move).result == ("done" if going == "resume" else "stopped")

    on_bench(scenario)


def test_a_stop_overtakes_a_resume_that_waits():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        bench.motion.request("hold")
        await asyncio.sleep(0.2)
        bench.motion.request("resume")
        await asyncio.sleep(0.1)
        bench.motion.request("stop")
        assert (await move).result == "stopped"
        assert bench.bus.verbs == ["run", "hold", "stop"]

    on_bench(scenario)


class InScans(QueuedFake):
    """Four controllers, each read `age_s` after its last scan: path times and positions of different instants."""

    age_s = np.array([0.0, 0.010, 0.004, 0.007])
    skew_s = 0.0

    async def poll(self, *, surviving=False):
        feedback = await super().poll(surviving=surviving)
        if self.loaded is None:
            return feedback
        times = np.repeat(np.maximum(self._path_s - self.age_s * self._rate, 0.0), 3)
        table = self.loaded
        position = np.array([np.interp(t, table.t_s, q) for t, q in zip(times, table.q_mm.T, strict=True)])
        scan = {"path_times_s": times, "path_time_s": times.min(), "path_skew_s": self.skew_s}
        return replace(feedback, position_mm=position, **scan)


def test_read_backs_of_different_scans_are_no_squeeze():
    """At 4 mm/s a scan is 0.04 mm: without their own path times the tight limits would trip."""
    tight = replace(LIMITS, ball_residual_mm=0.001, warp_force_n=1.0, internal_force_n=20.0)

    async def scenario(bench):
        result = await (await bench.begin())
        assert (result.result, result.cause) == ("done", None)
        assert result.max_residual_mm <= 1e-6

    on_bench(scenario, InScans, tight)


@pytest.mark.parametrize(("skew_s", "trips"), [(0.8, False), (1.25, True)])
@pytest.mark.parametrize("share", [1.0, 0.25])
def test_path_times_apart_by_more_than_the_limit_stop_all(skew_s, trips, share):
    """Each axis is on its path, but not at one place of it. The limit is a length: time apart times the plan's speed,
    whatever the rate."""
    slope = np.abs(np.diff(PLAN.q_mm, axis=0)).reshape(-1, 4, 3) / PLAN.period_s
    limit_s = LIMITS.sync_error_mm / np.linalg.norm(slope, axis=2).max()

    async def scenario(bench):
        bench.motion.override(100.0 * share)
        bench.bus.skew_s = skew_s * limit_s
        result = await (await bench.begin())
        if not trips:
            assert result.result == "done"
            return
        assert_faulted(result, ConsistencyTrip, "path times")
        assert "B is last" in str(result.cause)
        assert result.cause.limit == LIMITS.sync_error_mm
        assert bench.motion.arbiter.first.trigger is Trigger.COUPLING
        assert bench.bus.verbs[-1] == "quick-stop"

    on_bench(scenario, InScans)


def assert_faulted(result, kind, where) -> None:
    assert result.result == "fault"
    assert isinstance(result.cause, kind)
    assert result.cause.where == where


@pytest.mark.parametrize("share", [0.01, 0.5])
@pytest.mark.parametrize(
    ("changes", "kind", "where"),
    [
        ({"following_error_mm": np.array([0.0] * 4 + [2.0] + [0.0] * 7)}, FollowingErrorTrip, "B.Y"),
        ({"fault": ("C.X", 3, "following error")}, DriveFault, "C.X"),
    ],
)
def test_a_trip_stops_all_and_ends_when_they_stand(share, changes, kind, where):
    async def scenario(bench):
        loop = asyncio.get_running_loop()
        move = await bench.begin()
        after(share * PLAN.duration_s, bench.bus.changes.update, changes)
        begun = loop.time()
        result = await move
        assert_faulted(result, kind, where)
        assert bench.bus.verbs == ["run", "quick-stop"]
        assert loop.time() - begun >= share * PLAN.duration_s + bench.bus.quick_ramp_s
        assert loop.time() - begun <= share * PLAN.duration_s + bench.bus.quick_ramp_s + 6 * POLL_S
        assert path_gap_mm(PLAN.q_mm, await rests(bench)).max() <= 1e-9

    on_bench(scenario)


class Deaf(QueuedFake):
    """Its polls fail, its commands arrive."""

    async def poll(self, *, surviving=False):
        if self.error is not None and not (surviving and isinstance(self.error, DockingError)):
            raise self.error
        error, self.error = self.error, None
        feedback = await super().poll()
        self.error = error
        return feedback

    async def command(self, verb: str) -> None:
        error, self.error = self.error, None
        await super().command(verb)
        self.error = error


def test_when_a_read_back_is_lost_the_others_are_told_to_stop():
    async def scenario(bench):
        bench.bus.__class__ = Deaf
        move = await bench.begin()
        after(0.5 * PLAN.duration_s, setattr, bench.bus, "error", DeviceSilent("positioner B", "2 replies lost"))
        assert_faulted(await move, DeviceSilent, "positioner B")
        assert bench.bus.verbs == ["run", "quick-stop"]
        bench.bus.error = None
        assert path_gap_mm(PLAN.q_mm, await rests(bench)).max() <= 1e-9
        assert not bench.bus.silent, "the others answer: they were seen at rest"

    on_bench(scenario)


def test_when_nobody_answers_any_more_the_heartbeats_end_in_time():
    async def scenario(bench):
        loop = asyncio.get_running_loop()
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        bench.bus.error = LinkLost("positioner B", "the connection broke")
        begun_s = loop.time()
        bench.bus.on_lost()
        await asyncio.sleep(0.0)
        await asyncio.sleep(0.0)
        assert bench.motion.arbiter.reaction is Reaction.SQS, "told at once, not by the next poll"
        assert_faulted(await move, LinkLost, "positioner B")
        assert bench.bus.silent
        assert loop.time() - begun_s <= 1.0
        assert bench.motion.arbiter.first.trigger is Trigger.HEARTBEAT_LOST
        assert [finding.trigger for finding in bench.motion.arbiter.later] == [Trigger.QUICK_STOP_OVERDUE]
        with pytest.raises(EventRefused, match="start the controller again"):
            await bench.motion.reset("supervisor")
        bench.bus.error = None

    on_bench(scenario)


@pytest.mark.parametrize("moving", [True, False])
def test_a_lost_link_ends_the_move_and_is_told(moving):
    async def scenario(bench):
        lost = LinkLost("positioner B", "the connection broke")
        if moving:
            move = await bench.begin()
            after(0.5 * PLAN.duration_s, setattr, bench.bus, "error", lost)
            assert_faulted(await move, LinkLost, "positioner B")
        else:
            await bench.motion.enable()
            bench.bus.error = lost
            await asyncio.sleep(0.2)
        with pytest.raises(LinkLost):
            bench.motion.feedback()
        with pytest.raises(LinkLost):
            await bench.motion.load(PLAN)

    on_bench(scenario)


def test_a_fault_is_held_until_it_is_reset_and_the_axes_are_enabled_again():
    async def scenario(bench):
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        bench.bus.changes["fault"] = ("C.X", 3, "following error")
        await asyncio.sleep(0.2)
        bench.bus.changes.clear()
        await asyncio.sleep(1.0)
        motion = bench.motion
        for ask in (lambda: motion.load(PLAN), lambda: motion.start(PLAN.plan_hash), motion.enable):
            with pytest.raises(DriveFault):
                await ask()
        with pytest.raises(DriveFault):
            motion.feedback()
        assert bench.bus.verbs == ["quick-stop"], "an axis in fault at rest: all brake"
        with pytest.raises(EventRefused, match="supervisor"):
            await motion.reset("operator")
        await motion.reset("supervisor")
        assert bench.bus.verbs == ["quick-stop", "reset"]
        with pytest.raises(PlanStale):
            await motion.start(PLAN.plan_hash)
        await bench.motion.enable()
        assert len(asyncio.all_tasks()) == 2, "two keepers run side by side"
        await bench.motion.load(PLAN)
        assert (await bench.motion.start(PLAN.plan_hash)).result == "done"

    on_bench(scenario)


@pytest.mark.parametrize("moving", [True, False])
def test_a_defect_stops_all_and_is_held(moving):
    async def scenario(bench):
        bench.bus.__class__ = Deaf
        if moving:
            move = await bench.begin()
            await asyncio.sleep(0.5 * PLAN.duration_s)
        else:
            await bench.motion.enable()
        bench.bus.error = ZeroDivisionError("a defect")
        if moving:
            with pytest.raises(ZeroDivisionError):
                await move
        await asyncio.sleep(0.2)
        bench.bus.error = None
        assert bench.bus.verbs[-1:] == ["quick-stop"]
        with pytest.raises(Defect, match="ZeroDivisionError: a defect"):
            bench.motion.feedback()
        with pytest.raises(Defect):
            await bench.motion.load(PLAN)

    on_bench(scenario)


def states(state: AxisState) -> tuple[AxisState, ...]:
    return (*[AxisState.ENABLED] * 3, *[state] * 3, *[AxisState.ENABLED] * 6)


@pytest.mark.parametrize("moving", [True, False])
def test_an_axis_that_falls_out_is_named(moving):
    async def scenario(bench):
        if moving:
            move = await bench.begin()
            after(0.5 * PLAN.duration_s, bench.bus.changes.__setitem__, "states", states(AxisState.DISABLED))
            assert_faulted(await move, AxisNotEnabled, "B.X")
            assert bench.bus.verbs == ["run", "quick-stop"]
        else:
            await bench.motion.enable()
            await bench.motion.load(PLAN)
            bench.bus.changes["states"] = states(AxisState.DISABLED)
            await asyncio.sleep(0.1)
            with pytest.raises(AxisNotEnabled):
                await bench.motion.start(PLAN.plan_hash)
            assert "run" not in bench.bus.verbs

    on_bench(scenario)


@pytest.mark.parametrize("seconds", [0.049, 3.0])
def test_axes_that_ramp_down_unasked_are_a_fault_unless_the_next_poll_tells_why(seconds):
    async def scenario(bench):
        move = await bench.begin()
        after(0.5 * PLAN.duration_s, bench.bus.changes.__setitem__, "states", states(AxisState.STOPPING))
        told = {"fault": ("D.X", 2, "underrun"), "states": states(AxisState.ENABLED)}
        after(0.5 * PLAN.duration_s + seconds, bench.bus.changes.update, told)
        kind, where = (DriveFault, "D.X") if seconds < 1.0 else (AxisNotEnabled, "B.X")
        after(0.5 * PLAN.duration_s + 3.0, bench.bus.changes.clear)
        assert_faulted(await move, kind, where)
        assert bench.bus.verbs == ["run", "quick-stop"]
        assert bench.bus.silent == (seconds > 1.0), "a quick stop that never ends"

    on_bench(scenario)


def test_nothing_is_loaded_with_an_axis_off():
    async def scenario(bench):
        await bench.motion.enable()
        bench.bus.changes["states"] = states(AxisState.DISABLED)
        with pytest.raises(AxisNotEnabled):
            await bench.motion.load(PLAN)

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
        await asyncio.sleep(0.5)
        for ask in (lambda: motion.load(PLAN), lambda: motion.start(PLAN.plan_hash), motion.enable):
            with pytest.raises(PlanStale):
                await ask()
        assert (await move).result == "done"
        assert bench.bus.verbs == ["run"]
        with pytest.raises(PlanStale):
            await motion.start(PLAN.plan_hash)

    on_bench(scenario)


def test_a_move_that_nobody_waits_for_is_stopped():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        move.cancel()
        with pytest.raises(asyncio.CancelledError):
            await move
        await asyncio.sleep(0.01)
        assert bench.bus.verbs == ["run", "stop"]
        await asyncio.sleep(RAMP_S + 0.1)
        assert path_gap_mm(PLAN.q_mm, await rests(bench)).max() <= 1e-9

    on_bench(scenario)


@pytest.mark.parametrize("percent", [10.0, 50.0, 99.0])
def test_an_override_on_the_way_holds_sets_the_rate_and_goes_on(percent):
    async def scenario(bench):
        loop = asyncio.get_running_loop()
        move = await bench.begin()
        await asyncio.sleep(0.4 * PLAN.duration_s)
        bench.motion.override(percent)
        begun_s, path_s = loop.time(), 0.4 * PLAN.duration_s
        result = await move
        assert (result.result, result.cause) == ("done", None)
        rate = percent / 100.0
        assert bench.bus.verbs == ["run", "hold", f"rate {rate:g}", "resume"]
        rest_s = PLAN.duration_s - path_s - 0.5 * RAMP_S
        wanted_s = RAMP_S + rest_s / rate + 0.5 * rate * RAMP_S
        assert loop.time() - begun_s == pytest.approx(wanted_s, abs=0.45 + 0.05 / rate)
        # It is kept for the next move, which needs no hold.
        bench.bus.verbs.clear()
        await bench.motion.load(NEXT)
        begun_s = loop.time()
        assert (await bench.motion.start(NEXT.plan_hash)).result == "done"
        assert bench.bus.verbs == ["run"]
        assert loop.time() - begun_s == pytest.approx(NEXT.duration_s / rate, abs=0.3)

    on_bench(scenario)


def test_an_override_leaves_a_hold_alone_and_nought_is_a_hold():
    async def scenario(bench):
        motion, verbs = bench.motion, bench.bus.verbs
        move = await bench.begin()
        await asyncio.sleep(0.3 * PLAN.duration_s)
        motion.request("hold")
        await asyncio.sleep(1.0)
        motion.override(40.0)
        await rests(bench)
        motion.override(0.0)
        motion.request("resume")
        await rests(bench)
        assert verbs == ["run", "hold"]
        motion.override(25.0)
        await asyncio.sleep(0.5)
        assert verbs == ["run", "hold", "rate 0.25", "resume"]
        motion.override(0.0)
        await asyncio.sleep(1.0)
        await rests(bench)
        motion.override(100.0)
        assert (await move).result == "done"
        assert verbs[4:] == ["hold", "rate 1", "resume"]
        for wrong in (-1.0, 100.1, float("nan")):
            with pytest.raises(BadArgument):
                motion.override(wrong)

    on_bench(scenario)


def test_an_override_before_the_start_is_set_before_anything_runs():
    async def scenario(bench):
        await bench.motion.enable()
        bench.motion.override(0.0)
        await bench.motion.load(PLAN)
        move = asyncio.get_running_loop().create_task(bench.motion.start(PLAN.plan_hash))
        await rests(bench)
        bench.motion.override(60.0)
        assert (await move).result == "done"
        assert bench.bus.verbs == ["rate 0.6", "run"]

    on_bench(scenario)


def test_what_is_reported_from_outside_stops_on_the_path_and_is_kept():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        bench.motion.report(Finding(Trigger.LEASE_LOST, LeaseLost("cell process", value=0.6, limit=0.5)))
        result = await move
        assert_faulted(result, LeaseLost, "cell process")
        assert bench.bus.verbs == ["run", "stop"]
        with pytest.raises(LeaseLost):
            await bench.motion.load(NEXT)
        await bench.motion.reset("operator")
        await bench.motion.enable()

    on_bench(scenario)
