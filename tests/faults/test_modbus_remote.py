"""Speed and reset of a Modbus cell from behind the channel of the motion process, down to the registers of the PLCs."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from docking.assemble.motion_side import motion_beside
from docking.errors import DriveFault, EventRefused
from docking.motion.arbiter import Mode
from docking.motion.remote import RemoteMotion
from docking.motion.triggers import Trigger
from docking.types import Array, Plan
from sim.plc.registers import Fault, State
from tests.support.planned_moves import a_plan, lab_site
from tests.support.ready_modbus import ModbusScene, ReadyModbus, play_modbus

SLOW = 40.0
SPEED_MM_S = 4.0


def next_plan(cell: ReadyModbus, standing_mm: Array, seed: int, reach_mm: float = 4.0) -> Plan:
    site = replace(lab_site("lab-modbus"), reach_mm=reach_mm, turn_deg=0.1, speed_mm_s=SPEED_MM_S)
    period_s = cell.cell.bus.segment_s  # type: ignore[union-attr]
    return a_plan(site, seed, period_s=period_s, queued=True, start_mm=standing_mm)


async def rates(cell: ReadyModbus, seconds: float) -> Array:
    """Path time that each PLC played in a second of its clock, after what is under way has settled."""
    await asyncio.sleep(seconds)
    rows = []
    for _ in range(2):
        rows.append([(plc.queue.play_seq + plc.queue.fraction) * 0.1 for plc in cell.group.plcs])
        await asyncio.sleep(0.2)
    return (np.array(rows[1]) - rows[0]) / 0.2


async def slowly_half_way(cell: ReadyModbus, motion: RemoteMotion) -> tuple[Plan, asyncio.Task[object]]:
    """A move that was slowed down on its way."""
    standing = await motion.enable()
    plan = next_plan(cell, standing, 3)
    await motion.load(plan)
    move = cell.loop.create_task(motion.start(plan.plan_hash))
    np.testing.assert_allclose(await rates(cell, 0.5), 1.0, atol=0.01)
    motion.override(SLOW)
    np.testing.assert_allclose(await rates(cell, 1.4), 0.01 * SLOW, atol=0.01)
    assert {plc._rate_permille for plc in cell.group.plcs} == {round(10.0 * SLOW)}
    return plan, move


def test_override_and_reset_reach_the_plcs_through_the_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(cell: ReadyModbus) -> None:
        motion = motion_beside(cell.cell, cell.motion)
        await cell.group.serve()
        await motion.connect()
        cell.start_s = cell.loop.time()
        cell.plan, move = await slowly_half_way(cell, motion)
        cell.group.press_limit("B.Z")
        result = await asyncio.wait_for(move, 2.0)
        assert isinstance(result.cause, DriveFault)  # type: ignore[attr-defined]
        with pytest.raises(DriveFault, match=r"B\.Z"):
            motion.feedback()
        assert cell.motion.arbiter.first is not None
        assert cell.motion.arbiter.first.trigger is Trigger.LIMIT_SWITCH
        assert cell.motion.arbiter.mode is Mode.OFF
        assert [plc.fault for plc in cell.group.plcs] == [Fault.GROUP_LINE, Fault.LIMIT, *[Fault.GROUP_LINE] * 2]
        cell.watched_until_s = cell.loop.time()
        cell.group.press_limit("B.Z", False)
        await asyncio.sleep(1.0)
        await the_reset(cell, motion)
        # The speed that was asked for is kept; a reset resumes nothing.
        standing = await motion.enable()
        again = next_plan(cell, standing, 5, 1.0)
        await motion.load(again)
        begun_s = cell.loop.time()
        assert (await motion.start(again.plan_hash)).result == "done"
        assert cell.loop.time() - begun_s >= again.duration_s / (0.01 * SLOW)
        last = cell.record.motors()[1][-1]
        assert np.abs(last - again.q_mm[-1]).max() <= 0.002
        await motion.close()

    cell = play_modbus(ModbusScene(), story, monkeypatch)
    assert cell.residual_mm() <= cell.stated_mm()
    cell.assert_at_rest_and_braked()


async def the_reset(cell: ReadyModbus, motion: RemoteMotion) -> None:
    """By a supervisor alone; the registers forget the fault, nothing moves."""
    before = cell.record.motors()[1][-1]
    with pytest.raises(EventRefused, match="supervisor"):
        await motion.reset("operator")
    assert {plc.state for plc in cell.group.plcs} == {State.FAULT}
    await motion.reset("supervisor")
    await asyncio.sleep(0.5)
    assert {(plc.state, plc.fault) for plc in cell.group.plcs} == {(State.DISABLED, Fault.NONE)}
    np.testing.assert_array_equal(cell.record.motors()[1][-1], before)
