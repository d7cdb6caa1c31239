"""Drives that are simulated on a busy computer: what the process missed must not look like what a drive did."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from itertools import pairwise

import numpy as np
import pytest

from docking.ports import CanFrame
from sim.canopen import DriveSettings
from sim.canopen.drives import SYNC_LOST, Stage
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

STEP_MM = 0.05


def run(scenario: Callable[[Bench], Awaitable[None]], **settings: object) -> None:
    async def main() -> None:
        await scenario(Bench(can_cell(), DriveSettings(**settings)))  # type: ignore[arg-type]

    run_virtual(main)


async def stalled(bench: Bench, cycles: int) -> list[tuple[float, np.ndarray]]:
    """A steady move during which the drives' process is away for `cycles` cycles; the plant's steps since then."""
    q = await bench.ready()
    waiting: list[CanFrame] = []
    for k in range(20 + cycles):
        if k == 20:
            bench.far.on_frames, deliver = waiting.extend, bench.far.on_frames
        q = q + STEP_MM
        exchange(bench.master, q)
        await asyncio.sleep(0.01)
    bench.far.on_frames = deliver
    count = len(bench.plant.calls)
    deliver(waiting)
    for _ in range(10):
        q = q + STEP_MM
        exchange(bench.master, q)
        await asyncio.sleep(0.01)
    return bench.plant.calls[count - 1 :]


def fastest_mm_s(calls: list[tuple[float, np.ndarray]]) -> float:
    moved = [(b[0] - a[0], b[1][0] - a[1][0]) for a, b in pairwise(calls) if b[0] > a[0]]
    return max(mm / s for s, mm in moved)


def test_syncs_that_waited_are_played_a_cycle_apart() -> None:
    async def scenario(bench: Bench) -> None:
        calls = await stalled(bench, 8)
        steps = np.diff([t for t, _ in calls])
        assert steps.min() >= 0.0089
        assert steps.max() <= 0.021
        assert np.median(steps) == pytest.approx(0.01, abs=0.0011)
        assert fastest_mm_s(calls) <= 1.2 * STEP_MM / 0.01

    run(scenario, shared_cpu=True, sync_loss_cycles=25.0)


def test_without_it_the_axes_would_jump() -> None:
    async def scenario(bench: Bench) -> None:
        assert fastest_mm_s(await stalled(bench, 8)) >= 4.0 * STEP_MM / 0.01

    run(scenario, shared_cpu=False, sync_loss_cycles=25.0)


@pytest.mark.parametrize("cycles", [3.0, 25.0])
def test_a_controller_that_stops_is_noticed_after_the_stated_cycles(cycles: float) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.ready()
        bench.master._keeper.end()
        for _ in range(round(cycles - 1.5)):
            # The rest of the controller goes on: only SYNC is missing.
            bench.near.send([(0x77F, b"\x05")])
            await asyncio.sleep(0.01)
        assert all(stage is Stage.OPERATION for stage in bench.drives.drives.stages)
        await asyncio.sleep(0.03)
        assert all(stage is Stage.QUICK_STOP for stage in bench.drives.drives.stages)
        assert bench.master._watch.worst is not None
        assert bench.master._watch.worst[1] == SYNC_LOST

    run(scenario, shared_cpu=True, sync_loss="quick-stop", sync_loss_cycles=cycles)
