"""One row of the fault matrix as a case: what happens to a moving cell, and what the controller must do about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from docking.errors import DockingError
from tests.support.invariants import Outcome, judge
from tests.support.ready_cell import CYCLE_S, ReadyCell, Scene, play

T = CYCLE_S
SMOOTH_S = 3.0 * T
"""A smooth stop begins so gently that it shows in counts of 0.1 um this much later."""


@dataclass(frozen=True)
class Row:
    """`fault(cell)` at `share` of the move; the cause is one of `errors` and names `where`; the commands do one of
    `reactions` within `within_s` after the fault; the healthy axes rest `still_s` after that at the latest.

    `broken` is the axis that does not keep the invariants itself; `full` puts the row into the full set.
    """

    name: str
    fault: Callable[[ReadyCell], Any]
    errors: tuple[type[DockingError], ...]
    where: str
    reactions: tuple[str, ...]
    within_s: float
    broken: str | None = None
    share: float = 0.5
    still_s: float | None = None
    scene: Scene = field(default_factory=Scene)
    full: bool = False


def params(rows: list[Row]) -> list[Any]:
    """The rows for `pytest.mark.parametrize`."""
    return [pytest.param(row, id=row.name, marks=[pytest.mark.full] if row.full else []) for row in rows]


def run_row(row: Row) -> tuple[ReadyCell, Outcome]:
    """Play one row and assert everything that it says."""
    cell = play(row.scene, lambda cell: cell.during(row.share, row.fault, cell))
    outcome = judge(cell, row.broken)
    print(row.name, type(cell.cause).__name__, cell.cause, outcome)
    assert isinstance(cell.cause, row.errors), repr(cell.cause)
    assert row.where in str(cell.cause)
    assert outcome.reaction in row.reactions, outcome
    late_s = SMOOTH_S if outcome.reaction == "path" else 0.0
    assert outcome.reacted_s <= row.within_s + late_s, outcome
    still_s = row.still_s if row.still_s is not None else stop_s(cell, outcome.reaction)
    assert outcome.standstill_s <= row.within_s + still_s, outcome
    return cell, outcome


def stop_s(cell: ReadyCell, reaction: str) -> float:
    """How long the cell may take to stand: the path's own stop, or the ramp of the drives, and two cycles."""
    ramp_s = 1.5 / cell.plan.rate_slew_per_s if reaction == "path" else 0.1
    return ramp_s + 3.0 * T
