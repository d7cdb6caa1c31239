"""P12: a study on two workers against the same study on one."""

from __future__ import annotations

import tempfile
from pathlib import Path

import sim
from docking.study.dock import StudyRequest, study_dock
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side

CELL = "lab-can"


def measure(sizes: Sizes) -> list[Metric]:
    works = {"alone": lambda: _study(sizes.study_seeds, 1), "both": lambda: _study(sizes.study_seeds, 2)}
    times = side_by_side(works, sizes.study_repeats)
    alone, both = min(times["alone"]), min(times["both"])
    return [
        Metric(
            "P12",
            f"study dock {CELL}, {sizes.study_seeds} seeds, 2 workers",
            f"{both:.2f} s",
            f"{alone:.2f} s with 1",
            median_ratio(times["alone"], times["both"]),
            1.8,
        )
    ]


def _study(seeds: int, workers: int) -> None:
    """A fresh study: nothing is resumed."""
    cell = Path(sim.__file__).parent / "cells" / f"{CELL}.toml"
    with tempfile.TemporaryDirectory(prefix="docking-bench-") as out:
        study_dock(StudyRequest(cells=(cell,), seeds=seeds, out=Path(out), workers=workers), lambda text: None)
