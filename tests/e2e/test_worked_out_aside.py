"""What takes long is worked out aside of the loop: the cell process has to renew its lease meanwhile.

A minimax goal takes 30 ms of a processor, and several times that on a busy one; fit and plan take longer.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from docking.cli import call
from tests.support.program import cell_copy

T = TypeVar("T")

LONG = (
    ("docking.pose.goal", "best_fit"),
    ("docking.procedure", "fit_pose"),
    ("docking.procedure", "screen"),
    ("docking.survey", "fit_pose"),
    ("docking.survey", "locate_station"),
    ("docking.knowledge", "make_plan"),
)
"""Where the work is called from."""


def test_goals_fits_and_plans_never_keep_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, seen = [0], set()

    async def aside(work: Callable[[], T]) -> T:
        inside[0] += 1
        try:
            return work()
        finally:
            inside[0] -= 1

    def watched(module: str, name: str) -> None:
        original = getattr(__import__(module, fromlist=[name]), name)

        def work(*args: object, **more: object) -> object:
            assert inside[0] > 0, f"{name} on the loop"
            seen.add((module, name))
            return original(*args, **more)

        monkeypatch.setattr(f"{module}.{name}", work)

    monkeypatch.setattr("docking.assemble.runs.at_once", aside)
    for module, name in LONG:
        watched(module, name)
    cell = cell_copy(tmp_path, "lab-can", (".job.toml", 'start = "seated"', 'start = "seated"\ngoal = "minimax"'))
    assert call(["dry-run", str(cell), "--json"]) == 0
    assert seen == set(LONG)
