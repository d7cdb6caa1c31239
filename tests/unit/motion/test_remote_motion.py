"""The motion side behind its channel: the same port, a lease, a named end. Virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from docking.errors import (
    BadArgument,
    DriveFault,
    EventRefused,
    FollowingErrorTrip,
    LeaseLost,
    MotionProcessLost,
    PlanStale,
    TickLate,
)
from docking.motion import StreamedMotion
from docking.motion.channel import QueueChannel
from docking.motion.lateness import LATENESS, Lateness, measure_lateness, speed_limit_mm_s
from docking.motion.messages import encode
from docking.motion.remote import LeaseSettings, RemoteMotion
from docking.motion.served import ServedMotion, ServiceSettings
from sim.virtual_time import run_virtual
from tests.support.motion_fakes import LATE_CYCLES, StreamedFake, watch_of
from tests.support.planned_moves import a_plan, rc1_site

SITE = rc1_site()
PLAN = a_plan(SITE, 1)
LEASE_S = 0.5


class Bench:
    """Both ends of one channel on a virtual loop; `measured` is how late the ticks are said to come."""

    def __init__(self, measured: Lateness | None = None) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = StreamedFake(SITE.positioners.axes, SITE.start_mm)
        self.local = StreamedMotion(self.bus, watch_of(SITE.positioners), LATE_CYCLES)
        self.near, self.far = QueueChannel.pair(self.loop)
        self.told: list[tuple[str, object]] = []
        lease = LeaseSettings(LEASE_S, 0.1)
        self.motion = RemoteMotion(self.near, self.bus.axes, lease, lambda what, body: self.told.append((what, body)))

        async def measure() -> Lateness:
            assert measured is not None
            return measured

        settings = ServiceSettings(LEASE_S, 0.1, sync_error_mm=0.05, late_limit_s=0.05)
        self.served = ServedMotion(self.local, self.far, settings, measure if measured else None)

    async def moving(self) -> asyncio.Task[object]:
        await self.motion.connect()
        await self.motion.enable()
        await self.motion.load(PLAN)
        return self.loop.create_task(self.motion.start(PLAN.plan_hash))

    def freeze(self) -> None:
        """The cell process stands still: it renews nothing and reads nothing."""
        timer = self.motion._timer
        assert timer is not None
        timer.cancel()
        self.near.on_message = lambda message: None


def play(scenario: Callable[[Bench], Awaitable[None]], measured: Lateness | None = None) -> Bench:
    async def main() -> Bench:
        bench = Bench(measured)
        await scenario(bench)
        return bench

    return run_virtual(main)


def test_a_move_through_the_channel_is_the_move():
    async def scenario(bench: Bench) -> None:
        result = await (await bench.moving())
        assert result.result == "done"
        np.testing.assert_array_equal(result.commanded_mm, PLAN.q_mm[-1])
        # What was told before the answer is as new as the answer.
        np.testing.assert_allclose(bench.motion.feedback().position_mm, bench.local.feedback().position_mm)
        with pytest.raises(PlanStale):
            await bench.motion.start(PLAN.plan_hash)
        await bench.motion.close()
        assert bench.bus.closed
        assert bench.served.ended.is_set()
        with pytest.raises(MotionProcessLost):
            bench.motion.feedback()

    play(scenario)


def test_read_backs_come_at_their_rate_and_never_older():
    async def scenario(bench: Bench) -> None:
        move = await bench.moving()
        ages = []
        while not move.done():
            await asyncio.sleep(0.03)
            ages.append(np.abs(bench.motion.feedback().position_mm - bench.local.feedback().position_mm).max())
        speed = np.abs(np.diff(PLAN.q_mm, axis=0)).max() / PLAN.period_s
        assert 0.05 * speed < max(ages) <= 0.11 * speed
        await bench.motion.close()

    play(scenario)


@pytest.mark.parametrize("early", [True, False])
def test_hold_and_resume_reach_the_move_they_are_meant_for(early):
    async def scenario(bench: Bench) -> None:
        await bench.motion.connect()
        await bench.motion.enable()
        await bench.motion.load(PLAN)
        if early:
            bench.motion.request("hold")
        move = bench.loop.create_task(bench.motion.start(PLAN.plan_hash))
        if not early:
            await asyncio.sleep(0.3)
            bench.motion.request("hold")
        await asyncio.sleep(3.0)
        sent = bench.bus.sent[-50:]
        assert np.ptp(sent, axis=0).max() == 0.0
        assert not move.done()
        bench.motion.request("resume")
        assert (await move).result == "done"
        # A verb that comes after the end of its move, still on its way, holds no later one.
        again = a_plan(SITE, 2, start_mm=np.array(PLAN.q_mm[-1]))
        await bench.motion.load(again)
        assert (await bench.motion.start(again.plan_hash)).result == "done"
        await bench.motion.close()

    play(scenario)


def stopped_on_the_path(bench: Bench) -> None:
    last = bench.bus.sent[-1]
    gaps = np.abs(PLAN.q_mm - last).max(axis=1)
    assert 0 < np.argmin(gaps) < len(PLAN.q_mm) - 1
    assert gaps.min() <= np.abs(np.diff(PLAN.q_mm, axis=0)).max()
    assert bench.bus.quick_stops == 0


def test_a_lease_that_is_not_renewed_stops_on_the_path():
    async def scenario(bench: Bench) -> None:
        await bench.moving()
        await asyncio.sleep(0.3)
        bench.freeze()
        frozen_s = bench.loop.time()
        await asyncio.sleep(LEASE_S - 0.15)
        bench.local.feedback()
        await asyncio.sleep(0.26)
        with pytest.raises(LeaseLost) as lapsed:
            bench.local.feedback()
        assert LEASE_S <= float(lapsed.value.value) <= LEASE_S + 0.11
        assert bench.loop.time() - frozen_s <= LEASE_S + 0.12
        await asyncio.sleep(2.0)
        assert np.ptp(bench.bus.sent[-50:], axis=0).max() == 0.0
        stopped_on_the_path(bench)
        assert not bench.bus.closed, "the cell may come back and ask why"

    play(scenario)


def test_the_end_of_the_channel_is_the_end_of_the_lease_at_once():
    async def scenario(bench: Bench) -> None:
        await bench.moving()
        await asyncio.sleep(0.3)
        bench.near.close()
        await asyncio.sleep(0.02)
        with pytest.raises(LeaseLost):
            bench.local.feedback()
        await asyncio.wait_for(bench.served.ended.wait(), 5.0)
        stopped_on_the_path(bench)
        assert bench.bus.closed

    play(scenario)


def test_closing_in_a_move_stops_it_on_the_path_and_does_not_wait_for_its_end():
    async def scenario(bench: Bench) -> None:
        move = await bench.moving()
        await asyncio.sleep(0.3)
        begun_s = bench.loop.time()
        await bench.motion.close()
        assert bench.loop.time() - begun_s < min(1.5, 0.5 * PLAN.duration_s)
        assert (await move).result == "stopped"
        stopped_on_the_path(bench)
        assert bench.bus.closed

    play(scenario)


@pytest.mark.parametrize("silently", [True, False])
def test_a_motion_side_that_is_gone_is_named_everywhere(silently):
    async def scenario(bench: Bench) -> None:
        move = await bench.moving()
        await asyncio.sleep(0.3)
        gone_s = bench.loop.time()
        if silently:
            bench.far.send = lambda message: None  # type: ignore[method-assign]
        else:
            bench.far.close()
        with pytest.raises(MotionProcessLost):
            await move
        assert bench.loop.time() - gone_s <= (LEASE_S + 0.21 if silently else 0.0)
        for ask in (bench.motion.enable, lambda: bench.motion.load(PLAN)):
            with pytest.raises(MotionProcessLost):
                await ask()
        with pytest.raises(MotionProcessLost):
            bench.motion.feedback()
        await bench.motion.close()
        await asyncio.sleep(3.0)

    play(scenario)


def test_a_fault_is_told_at_once_and_held():
    async def scenario(bench: Bench) -> None:
        await bench.motion.connect()
        await bench.motion.enable()
        await asyncio.sleep(0.2)
        bench.bus.changes["fault"] = ("B.Z", 0x2310, "overcurrent")
        await asyncio.sleep(0.021)
        with pytest.raises(DriveFault, match=r"B\.Z") as caught:
            bench.motion.feedback()
        assert caught.value.value == 0x2310
        with pytest.raises(DriveFault):
            await bench.motion.load(PLAN)
        await bench.motion.close()

    play(scenario)


def late(late_s: float, rare_s: float) -> Lateness:
    found = Lateness()
    for k in range(1000):
        found.add(rare_s if k % 500 == 0 else late_s)
    return found


def test_lateness_limits_the_speed_and_is_told():
    bench = play(lambda bench: connected(bench), late(1e-4, 0.02))
    (what, body) = bench.told[0]
    assert what == "lateness"
    assert isinstance(body, dict)
    assert body["samples"] == 1000
    # 0.05 mm at 20 ms, to the width of a class.
    assert 0.05 / 0.02 <= bench.motion.speed_limit_mm_s * 1.0001 <= 1.13 * 0.05 / 0.02


async def connected(bench: Bench) -> None:
    await bench.motion.connect()
    await bench.motion.close()


def test_a_computer_that_is_too_late_too_often_is_refused():
    async def scenario(bench: Bench) -> None:
        with pytest.raises(TickLate) as refused:
            await bench.motion.connect()
        assert refused.value.value == pytest.approx(0.2)
        assert bench.told[0][0] == "lateness"
        await bench.motion.close()

    play(scenario, late(1e-4, 0.2))


def test_quantiles_of_the_histogram_are_on_the_safe_side():
    rng = np.random.default_rng(5)
    values = np.exp(rng.normal(-9.0, 1.5, 5000))
    found = Lateness()
    for value in values:
        found.add(float(value))
    for share in (0.5, 0.9, 0.99, 0.999):
        exact = np.quantile(values, share, method="inverted_cdf")
        assert exact * 0.9999 <= found.quantile_s(share) <= exact * 10 ** (1 / 20) * 1.0001
    assert found.quantile_s(1.0) == pytest.approx(values.max())
    early = Lateness()
    early.add(-0.5)
    assert early.quantile_s(0.999) <= 1e-6
    assert speed_limit_mm_s(early, 0.05, 0.05) > 1e3


def test_measuring_lateness_in_virtual_time_finds_none():
    found = run_virtual(lambda: measure_lateness(0.002, 1.0))
    assert found.samples == pytest.approx(500, abs=2)
    assert found.worst_s <= 1e-9


def test_a_fault_is_reset_through_the_channel_by_role_and_edge_and_nothing_is_resumed():
    async def scenario(bench: Bench) -> None:
        move = await bench.moving()
        await asyncio.sleep(0.4)
        bench.bus.changes["following_error_mm"] = 9.0 * (np.arange(12) == 3)
        result = await move
        assert isinstance(result.cause, FollowingErrorTrip)
        assert result.stop is not None
        assert result.stop.found_s <= result.stop.commanded_s < result.stop.rest_s
        for role, kind in (("operator", EventRefused), ("cleaner", BadArgument)):
            with pytest.raises(kind):
                await bench.motion.reset(role)
        bench.bus.changes.clear()
        await asyncio.sleep(1.0)
        with pytest.raises(FollowingErrorTrip):
            await bench.motion.enable()
        await bench.motion.reset("supervisor")
        sent = np.array(bench.bus.sent[-1])
        bench.motion.request("resume")
        await asyncio.sleep(1.0)
        np.testing.assert_array_equal(bench.bus.sent[-1], sent)
        with pytest.raises(PlanStale):
            await bench.motion.start(PLAN.plan_hash)
        with pytest.raises(EventRefused, match="nothing to reset"):
            await bench.motion.reset("supervisor")
        await bench.motion.enable()
        assert bench.motion.feedback() is not None
        await bench.motion.close()

    play(scenario)


def test_how_late_the_cycles_of_a_run_came_is_told_at_its_end():
    measured = Lateness()
    measured.add(1e-5)

    async def scenario(bench: Bench) -> None:
        assert (await (await bench.moving())).result == "done"
        assert [what for what, _ in bench.told] == ["lateness"]
        await bench.motion.close()

    bench = play(scenario, measured)
    assert [what for what, _ in bench.told] == list(LATENESS)
    told = bench.told[1][1]
    assert [list(row) for row in told.pop("histogram")] == bench.local.lateness.as_record()["histogram"]
    assert told == {key: value for key, value in bench.local.lateness.as_record().items() if key != "histogram"}
    assert told["samples"] >= len(PLAN.q_mm)
    # Virtual time is never late, and nobody measures it.
    assert [what for what, _ in play(scenario_without).told] == []


async def scenario_without(bench: Bench) -> None:
    assert (await (await bench.moving())).result == "done"
    await bench.motion.close()


def test_a_process_that_reads_its_files_after_its_greeting_is_waited_for() -> None:
    """Nothing may be taken for its death before it has begun to work; afterwards the lease's time counts."""

    async def main() -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        near, far = QueueChannel.pair(loop)
        motion = RemoteMotion(near, SITE.positioners.axes, LeaseSettings(LEASE_S, 0.1), lambda what, body: None)
        begun_s = loop.time()
        waiting = loop.create_task(motion.connect())
        far.send(encode("hello", 0, {"pid": 1, "priority": True}))
        await asyncio.sleep(5.0)
        assert not waiting.done()
        far.send(encode("alive", 0))
        spoke_s = loop.time()
        with pytest.raises(MotionProcessLost, match="silent"):
            await waiting
        return spoke_s - begun_s, loop.time() - spoke_s

    waited_s, silent_s = run_virtual(main)
    assert waited_s == pytest.approx(5.0, abs=0.1)
    assert LEASE_S <= silent_s <= 2.0 * LEASE_S
