"""What a metric is: a figure of the product beside a peer's of the same run, their ratio, and the target."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured; the defaults are the ones the targets are meant for."""

    repeats: int = 5
    stop_instants: int = 10
    dock_cell: str = "fuselage-can"
    events_a_task: int = 2000
    study_seeds: int = 24
    study_repeats: int = 3
    lateness_s: float = 60.0
    epochs: int = 100_000
    tracker_frames: int = 5000
    can_frames: int = 60_000


TINY = Sizes(
    repeats=1,
    stop_instants=1,
    dock_cell="lab-can",
    events_a_task=20,
    study_seeds=2,
    study_repeats=1,
    lateness_s=0.3,
    epochs=200,
    tracker_frames=50,
    can_frames=600,
)
"""Enough to see that everything runs; the ratios mean nothing."""


@dataclass(frozen=True)
class Metric:
    """One line of the table. `ratio` is product to peer; `at_least` tells on which side of `target` it belongs."""

    key: str
    what: str
    product: str
    peer: str
    ratio: float
    target: float
    at_least: bool = True

    @property
    def met(self) -> bool:
        return self.ratio >= self.target if self.at_least else self.ratio <= self.target


Group = Callable[[Sizes], list[Metric]]
"""Measures the metrics of one file of this folder."""


def wall_s(work: Callable[[], object]) -> float:
    """Time that `work()` takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def side_by_side(works: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Times (s) of each work, taken in turn so that a disturbance of the machine meets all of them."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            times[name].append(wall_s(work))
    return times


def median_ratio(above: list[float], below: list[float]) -> float:
    """Median of the ratios of the times that were taken in the same turn."""
    return statistics.median(a / b for a, b in zip(above, below, strict=True))
