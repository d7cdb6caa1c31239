"""P8: how late the ticks of the motion side come while other programs burn all CPUs, against a bare sleep loop.

Each side is a process of its own. The product runs the real tick (monitors, arbiter, playback) of twelve axes on drives
in memory, as the motion process runs it. Where the operating system permits real-time priority the peer is a bare loop
with that priority on a quiet computer; where it does not, a bare loop under the same load.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from docking.assemble.real_time import run_real
from docking.motion import StreamedMotion
from docking.motion.lateness import Lateness
from tests.bench.metric import Metric, Sizes
from tests.support.motion_fakes import LATE_CYCLES, StreamedFake, watch_of
from tests.support.planned_moves import rc1_site

BURNERS = 2
PERIOD_S = 0.01
BURN = "while True: pass"


def measure(sizes: Sizes) -> list[Metric]:
    with _burning():
        product = _run("product", sizes.lateness_s)
        loaded = _run("bare", sizes.lateness_s) if not product["priority"] else None
    peer, target = (loaded, 1.0) if loaded else (_run("bare", sizes.lateness_s), 3.0)
    what = "bare loop, same load" if loaded else "bare loop, no load"
    return [
        Metric(
            "P8",
            f"tick lateness p99, {BURNERS} processes burn CPU",
            f"{1e6 * product['p99_s']:.0f} us",
            f"{1e6 * peer['p99_s']:.0f} us {what}",
            product["p99_s"] / peer["p99_s"],
            target,
            at_least=False,
        )
    ]


@contextmanager
def _burning() -> Iterator[None]:
    burners = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(BURNERS)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def _run(side: str, duration_s: float) -> dict[str, float]:
    asked = [sys.executable, "-m", "tests.bench.tick_lateness", side, str(duration_s)]
    found: dict[str, float] = json.loads(subprocess.run(asked, capture_output=True, text=True, check=True).stdout)
    return found


async def _ticks(duration_s: float) -> Lateness:
    """The tick of twelve axes that stand enabled: read-back, monitors, arbiter, set-points."""
    site = rc1_site()
    bus = StreamedFake(site.positioners.axes, site.start_mm, PERIOD_S)
    motion = StreamedMotion(bus, watch_of(site.positioners), LATE_CYCLES)
    await motion.enable()
    await asyncio.sleep(duration_s)
    await motion.close()
    return motion.lateness


def _bare(duration_s: float) -> Lateness:
    """A thread that sleeps until the next deadline, and nothing else; with real-time priority where it is permitted."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    found = Lateness()
    due_s = time.monotonic()
    for _ in range(round(duration_s / PERIOD_S)):
        due_s += PERIOD_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        found.add(time.monotonic() - due_s)
    return found


def main() -> None:
    side, duration_s = sys.argv[1], float(sys.argv[2])
    refused: list[bool] = []
    if side == "bare":
        found = _bare(duration_s)
    else:
        found = run_real(lambda: _ticks(duration_s), lambda: refused.append(True))
    record = found.as_record()
    print(json.dumps({"p99_s": record["p99_s"], "max_s": record["max_s"], "priority": not refused}))


if __name__ == "__main__":
    main()
