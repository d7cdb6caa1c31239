"""Brakes of controllers that play a queue: they end the hardest stop, and open the hardware chain when they do not."""

from __future__ import annotations

import asyncio

import pytest

from docking.errors import EmergencyStop
from docking.motion.arbiter import Reaction
from docking.motion.triggers import Finding, Trigger
from tests.support.motion_fakes import QueuedFake
from tests.unit.motion.test_queued_motion import PLAN, POLL_S, on_bench

BRAKE_S = 2.0


class NoBrakes(QueuedFake):
    """Stops as it is told, and no brake confirms that it is closed."""

    async def command(self, verb: str) -> None:
        await super().command(verb)
        self.braked = False


@pytest.mark.parametrize("share", [0.5, None], ids=["moving", "standing"])
def test_brakes_that_nobody_confirms_open_the_hardware_chain_in_time(share):
    async def scenario(bench):
        move = await bench.begin()
        await (move if share is None else asyncio.sleep(share * PLAN.duration_s))
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        bench.motion.report(Finding(Trigger.EMERGENCY_STOP, EmergencyStop("input E")))
        while not bench.bus.silent:
            await asyncio.sleep(0.01)
            assert loop.time() - begun_s <= BRAKE_S + 3.0 * POLL_S, "overdue"
        assert loop.time() - begun_s >= BRAKE_S
        assert bench.motion.arbiter.reaction is Reaction.HW
        assert (await move).result == ("done" if share is None else "fault")

    on_bench(scenario, NoBrakes)


def test_brakes_that_are_confirmed_end_it():
    async def scenario(bench):
        move = await bench.begin()
        await asyncio.sleep(0.5 * PLAN.duration_s)
        bench.motion.report(Finding(Trigger.EMERGENCY_STOP, EmergencyStop("input E")))
        assert (await move).result == "fault"
        await asyncio.sleep(BRAKE_S + 1.0)
        assert not bench.bus.silent
        assert bench.motion.arbiter.reaction is Reaction.SBT

    on_bench(scenario)
