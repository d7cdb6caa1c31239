"""A second fault while the axes stop for the first: the more severe reaction takes over, the first cause stays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from docking.errors import AxisAtLimit, DriveWarning
from tests.support.fault_rows import T
from tests.support.invariants import judge
from tests.support.ready_cell import ReadyCell, Scene, play

Fault = Callable[[ReadyCell], Any]


def at_limit(cell: ReadyCell) -> None:
    cell.faults.limit_switch("A.X")


def warning(cell: ReadyCell) -> None:
    cell.faults.warn("A.X", 0x4210)


def trip(cell: ReadyCell) -> None:
    cell.group.trip("B.X", 0x2310)


def jam(cell: ReadyCell) -> None:
    cell.plant.jam("B.X")


def cut(cell: ReadyCell) -> None:
    cell.bus.cut("the controller went bus-off")


def lost(cell: ReadyCell) -> None:
    cell.faults.lose_read_back("B.X")


CASES = [
    (at_limit, trip, "B.X", "quick-stop", 0.1),
    (warning, jam, "B.X", "path", 0.15),
    (warning, cut, None, "silence", 0.15),
    (warning, lost, None, "path", 0.15),
]


def parameters() -> list[Any]:
    """Each pair with the second fault at several times in the stop; one of them by default."""
    return [
        pytest.param(*case, delay, id=f"{case[0].__name__}-{case[1].__name__}-{delay}", marks=marks)
        for case in CASES
        for delay, marks in ((T, pytest.mark.full), (3 * T, pytest.mark.full), (0.1, []), (0.2, pytest.mark.full))
    ]


@pytest.mark.parametrize(("first", "second", "broken", "reaction", "still_s", "delay_s"), parameters())
def test_the_more_severe_reaction_takes_over(first, second, broken, reaction, still_s, delay_s):
    def both(cell: ReadyCell) -> None:
        first(cell)
        cell.loop.call_later(delay_s, second, cell)

    cell = play(Scene(), lambda cell: cell.during(0.5, both, cell))
    outcome = judge(cell, broken)
    print(first.__name__, second.__name__, delay_s, outcome)
    assert isinstance(cell.cause, AxisAtLimit if first is at_limit else DriveWarning)
    assert outcome.reaction == reaction
    # Sooner than the gentle stop of the first fault alone would have ended.
    assert outcome.standstill_s <= delay_s + still_s
    assert outcome.residual_mm <= cell.cell.limits.ball_residual_mm
    assert outcome.force_n <= cell.cell.limits.internal_force_n
