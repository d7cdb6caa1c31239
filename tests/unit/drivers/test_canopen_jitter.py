"""The CANopen driver on a computer that is not on time: late ticks, read-backs that come in pieces."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from docking.ports import CanFrame
from sim.canopen import DriveSettings
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

STEP_MM = 0.05


def run(scenario: Callable[[Bench], Awaitable[None]], settings: DriveSettings | None = None) -> None:
    async def main() -> None:
        await scenario(Bench(can_cell(), settings))

    run_virtual(main)


async def move(bench: Bench, q: np.ndarray, cycles: int, pause_s: float = 0.01) -> np.ndarray:
    """Move all axes on by STEP_MM a cycle; returns the last set-point."""
    for _ in range(cycles):
        q = q + STEP_MM
        exchange(bench.master, q)
        await asyncio.sleep(pause_s)
    return q


@pytest.mark.parametrize("arrived", [1, 5, 11])
def test_read_backs_of_two_cycles_are_never_mixed(arrived: int) -> None:
    """With some axes a cycle older than the others a moving figure would look strained by a whole step."""

    async def scenario(bench: Bench) -> None:
        q = await move(bench, await bench.ready(), 5)
        held: list[CanFrame] = []
        deliver = bench.near.on_frames

        def keep(batch: list[CanFrame]) -> None:
            ours = [frame for frame in batch if 0x180 < frame[0] < 0x200]
            if ours:
                held.extend(ours[arrived:])
                deliver(ours[:arrived])

        before = exchange(bench.master, q).position_mm
        bench.near.on_frames = keep
        await asyncio.sleep(0.01)
        between = exchange(bench.master, q + STEP_MM)
        np.testing.assert_array_equal(between.position_mm, before)
        assert (between.age_cycles == 1.0).all()
        bench.near.on_frames = deliver
        deliver(held)
        whole = exchange(bench.master, q + 2 * STEP_MM)
        assert np.ptp(whole.position_mm - before) <= 1e-9
        assert (whole.position_mm > before + 0.9 * STEP_MM).all()

    run(scenario)


def test_an_axis_that_falls_silent_ages_while_the_others_are_read_on() -> None:
    async def scenario(bench: Bench) -> None:
        q = await move(bench, await bench.ready(), 5)
        bench.drives.mute(bench.cell.axis_names[3])
        before = exchange(bench.master, q).position_mm
        q = await move(bench, q, 6)
        feedback = exchange(bench.master, q)
        others = np.arange(12) != 3
        assert feedback.age_cycles[3] >= 5.0
        assert (feedback.age_cycles[others] <= 1.0).all()
        assert (feedback.position_mm[others] > before[others] + 3 * STEP_MM).all()

    run(scenario)


def test_the_controllers_heartbeat_keeps_its_period_when_ticks_are_late() -> None:
    """30 ms instead of 10 ms between ticks: counted in cycles it would starve the drives' watchdogs (280 ms)."""

    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        loop, beats = asyncio.get_running_loop(), []

        def keep(cob: int, data: bytes) -> bool:
            if cob == 0x77F:
                beats.append(loop.time())
            return True

        bench.bus.keep = keep
        await move(bench, q, 60, pause_s=0.03)
        assert len(beats) >= 15
        assert np.diff(beats).max() <= 0.1 + 0.03 + 1e-6
        assert not bench.drives.drives.error_codes[0]

    run(scenario, DriveSettings(sync_loss_cycles=25.0))
