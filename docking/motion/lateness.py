"""How late the ticks come, and what follows from it for the speed."""

from __future__ import annotations

import asyncio
import math
from typing import Any

from docking.errors import TickLate

LATENESS = ("lateness", "run_lateness")
"""Messages and records of it: measured before anything is connected, and of all cycles of a run at its end."""
A_DECADE = 20
SHORTEST_S = 1e-6
COUNT = 7 * A_DECADE


class Lateness:
    """A histogram of how late control cycles come: 20 classes a decade from 1 us to 10 s."""

    def __init__(self) -> None:
        self.counts = [0] * (COUNT + 1)
        self.samples = 0
        self.worst_s = 0.0

    def add(self, late_s: float) -> None:
        """Count one cycle; one that comes early is not late."""
        self.samples += 1
        self.worst_s = max(self.worst_s, late_s)
        row = 0 if late_s <= SHORTEST_S else 1 + int(A_DECADE * math.log10(late_s / SHORTEST_S))
        self.counts[min(row, COUNT)] += 1

    def quantile_s(self, share: float) -> float:
        """The lateness that `share` of the cycles do not exceed: upper end of its class, at most the worst seen."""
        left = share * self.samples
        for row, count in enumerate(self.counts):
            left -= count
            if left <= 1e-9:
                return min(_upper_s(row), self.worst_s)
        return self.worst_s

    def as_record(self) -> dict[str, Any]:
        """For the journal: quantiles, and the classes that are not empty with their upper ends."""
        return {
            "samples": self.samples,
            "p50_s": self.quantile_s(0.5),
            "p99_s": self.quantile_s(0.99),
            "p999_s": self.quantile_s(0.999),
            "max_s": self.worst_s,
            "histogram": [[_upper_s(row), count] for row, count in enumerate(self.counts) if count],
        }


def _upper_s(row: int) -> float:
    return SHORTEST_S * math.pow(10.0, row / A_DECADE)


async def measure_lateness(period_s: float, duration_s: float) -> Lateness:
    """Tick on absolute deadlines for a while, as a move does, and see how late the loop wakes."""
    loop = asyncio.get_running_loop()
    found, done = Lateness(), loop.create_future()
    end_s = loop.time() + duration_s

    def tick(deadline_s: float) -> None:
        now_s = loop.time()
        found.add(now_s - deadline_s)
        if now_s >= end_s:
            done.set_result(None)
            return
        missed = max(0, math.floor((now_s - deadline_s) / period_s + 0.5))
        due_s = deadline_s + (1 + missed) * period_s
        loop.call_at(due_s, tick, due_s)

    start_s = loop.time() + period_s
    loop.call_at(start_s, tick, start_s)
    await done
    return found


def speed_limit_mm_s(lateness: Lateness, sync_error_mm: float, late_limit_s: float) -> float:
    """Fastest speed at which one cycle in a thousand is late by no more than `sync_error_mm` of travel.

    Raises TickLate where one in a thousand is later than `late_limit_s`: a move would not reach its end.
    """
    late_s = lateness.quantile_s(0.999)
    if not (late_s <= late_limit_s):
        raise TickLate("motion process", value=late_s, limit=late_limit_s)
    return sync_error_mm / late_s if late_s > 0.0 else math.inf
