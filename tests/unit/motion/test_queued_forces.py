"""Load cells over controllers that play a queue: what the part at rest shows keeps a plan from loading, a loaded one
from starting, a held one from going on."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from docking.errors import MeasuredForceTrip, PlanStale
from docking.kinematics import axis_forces_n, ball_reactions_n, pose_from_axes
from docking.motion import QueuedMotion
from docking.motion.monitors import Watch
from docking.types import Array
from sim.virtual_time import run_virtual
from tests.support.motion_fakes import LIMITS, LOAD, QueuedFake
from tests.support.planned_moves import a_plan, lab_site

SITE = lab_site("lab-modbus")
PLAN = a_plan(SITE, 3, period_s=0.1, queued=True)
POSITIONERS = SITE.positioners
POLL_S = 0.05
LIGHT = replace(LOAD, mass_kg=40.0, com_C_mm=POSITIONERS.balls_C_mm.mean(axis=0))
WIDE = replace(LIMITS, measured_whole_force_n=1000.0, measured_force_n=1000.0, standing_force_n=200.0, overload=99.0,
               underload=1e-6, rating=9.0)  # fmt: skip


class Weighed:
    """Enabled axes with a load cell each."""

    def __init__(self) -> None:
        self.bus = QueuedFake(POSITIONERS.axes, np.array(PLAN.q_mm[0]))
        self.motion = QueuedMotion(self.bus, Watch(POSITIONERS, LIGHT, WIDE, np.ones(12, dtype=bool)), POLL_S)
        X_WC = pose_from_axes(POSITIONERS, PLAN.q_mm[0])
        balls, weight_n = X_WC.apply(POSITIONERS.balls_C_mm), LIGHT.mass_kg * LIGHT.gravity_m_s2
        carried = ball_reactions_n(POSITIONERS, balls, X_WC.apply(LIGHT.com_C_mm), weight_n)[0]
        self.resting: Array = axis_forces_n(POSITIONERS, carried)

    def weigh(self, pushed_n: float = 0.0) -> None:
        """From the next poll on the cells show the weight, and `pushed_n` more at B.X."""
        self.bus.changes["force_n"] = self.resting + pushed_n * (np.arange(12) == 3)

    async def standing(self) -> None:
        """Enabled, and looked at often enough to know the forces at rest."""
        await self.motion.enable()
        for _ in range(20):
            self.weigh()
            await asyncio.sleep(POLL_S)


def test_a_strained_part_is_not_loaded_and_a_relief_is() -> None:
    async def main() -> None:
        cell = Weighed()
        cell.weigh(1050.0)
        await cell.motion.enable()
        with pytest.raises(MeasuredForceTrip, match="docking relieve"):
            await cell.motion.load(PLAN)
        assert not cell.motion.arbiter.latched
        with pytest.raises(PlanStale):
            await cell.motion.start(PLAN.plan_hash)
        await cell.motion.load(replace(PLAN, kind="relief"))
        await cell.motion.close()
        assert cell.bus.verbs == []

    run_virtual(main)


def test_a_force_that_changed_since_the_load_keeps_the_move_from_starting() -> None:
    async def main() -> None:
        cell = Weighed()
        await cell.standing()
        await cell.motion.load(PLAN)
        cell.weigh(250.0)
        await asyncio.sleep(2.0 * POLL_S)
        with pytest.raises(MeasuredForceTrip, match="measure again"):
            await cell.motion.start(PLAN.plan_hash)
        await cell.motion.close()
        assert cell.bus.verbs == []

    run_virtual(main)


@pytest.mark.parametrize("pushed_n", [0.0, 250.0])
def test_a_force_that_changed_in_a_hold_keeps_the_move_from_going_on(pushed_n: float) -> None:
    async def main() -> None:
        cell = Weighed()
        await cell.standing()
        await cell.motion.load(PLAN)
        move = asyncio.get_running_loop().create_task(cell.motion.start(PLAN.plan_hash))
        await asyncio.sleep(0.4 * PLAN.duration_s)
        cell.motion.request("hold")
        for _ in range(40):
            cell.weigh()
            await asyncio.sleep(POLL_S)
        cell.weigh(pushed_n)
        # One sample alone is no finding of a monitor; the resume is what asks.
        await asyncio.sleep(1.2 * POLL_S)
        cell.motion.request("resume")
        result = await move
        assert ("resume" in cell.bus.verbs) == (result.result == "done") == (pushed_n == 0.0)
        if pushed_n:
            assert isinstance(result.cause, MeasuredForceTrip), result.cause
            assert "measure again" in result.cause.text()
            assert result.path_time_s < 0.8 * PLAN.duration_s
        await cell.motion.close()

    run_virtual(main)
