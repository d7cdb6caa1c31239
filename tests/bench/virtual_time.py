"""P11: the dry run against real time, and the virtual loop's event rate against trio's and looptime's."""

from __future__ import annotations

import asyncio
import statistics
from pathlib import Path

import looptime
import trio
import trio.testing

import sim
from docking.assemble import RunRequest, dry_run
from sim.virtual_time import run_virtual
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side, wall_s

TASKS = 12
PERIOD_S = 0.01


def measure(sizes: Sizes) -> list[Metric]:
    return [_dry_run(sizes), *_event_rates(sizes)]


def _dry_run(sizes: Sizes) -> Metric:
    """Cell time over wall time of whole dockings, files read and journal written."""
    cell = Path(sim.__file__).parent / "cells" / f"{sizes.dock_cell}.toml"
    request = RunRequest(cell, None, 1, None, None, "en")
    cell_s: list[float] = []

    def dock() -> None:
        cell_s.append(dry_run(request, lambda text: None)["virtual_time_s"])

    taken_s = statistics.median(wall_s(dock) for _ in range(sizes.repeats))
    return Metric(
        "P11", f"dry run {sizes.dock_cell}", f"{taken_s:.2f} s", f"{cell_s[0]:.0f} s real", cell_s[0] / taken_s, 50.0
    )


def _event_rates(sizes: Sizes) -> list[Metric]:
    """Tasks that do nothing but sleep: what one jump and one wake-up cost."""
    count = sizes.events_a_task
    works = {
        "product": lambda: run_virtual(lambda: _asyncio_tasks(count)),
        "trio MockClock": lambda: trio.run(_trio_tasks, count, clock=trio.testing.MockClock(autojump_threshold=0)),
        "looptime": lambda: _looptime(count),
    }
    times = side_by_side(works, sizes.repeats)
    rates = {name: TASKS * count / statistics.median(taken) for name, taken in times.items()}
    return [
        Metric(
            "P11",
            f"{TASKS} tasks at {PERIOD_S * 1e3:.0f} ms against {peer}",
            f"{rates['product']:,.0f} events/s",
            f"{rates[peer]:,.0f} events/s",
            median_ratio(times[peer], times["product"]),
            3.0,
        )
        for peer in ("trio MockClock", "looptime")
    ]


async def _asyncio_tasks(count: int) -> None:
    async def task() -> None:
        for _ in range(count):
            await asyncio.sleep(PERIOD_S)

    await asyncio.gather(*(task() for _ in range(TASKS)))


async def _trio_tasks(count: int) -> None:
    async def task() -> None:
        for _ in range(count):
            await trio.sleep(PERIOD_S)

    async with trio.open_nursery() as nursery:
        for _ in range(TASKS):
            nursery.start_soon(task)


def _looptime(count: int) -> None:
    loop = looptime.new_event_loop(start=0.0)
    try:
        loop.run_until_complete(_asyncio_tasks(count))
    finally:
        loop.close()
