"""Faults while the enabled axes stand: named at once, nothing moves, nothing starts whatever is asked next."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from docking.errors import (
    AxisAtLimit,
    AxisNotEnabled,
    BallForceTrip,
    DockingError,
    DriveFault,
    DriveWarning,
    EncoderJump,
    FeedbackMissing,
    LinkLost,
    MeasuredForceTrip,
)
from tests.support.fault_rows import T
from tests.support.ready_cell import ReadyCell, Scene, play

ROWS: list[tuple[str, Callable[[ReadyCell], Any], tuple[type[DockingError], ...], float]] = [
    ("CAN-01", lambda c: c.bus.cut("the controller went bus-off"), (LinkLost,), 2 * T),
    ("CAN-02", lambda c: c.faults.lose_read_back("B.X"), (FeedbackMissing,), 3 * T),
    ("CAN-05-warning", lambda c: c.faults.warn("B.X", 0x4210), (DriveWarning,), 2 * T),
    ("CAN-05-fault", lambda c: c.group.trip("B.X", 0x2310), (DriveFault,), 2 * T),
    ("CAN-06", lambda c: c.faults.lose_heartbeat("B.X"), (DockingError,), 0.4 + T),
    ("CAN-07", lambda c: c.group.restart("B.X"), (DockingError,), 2 * T),
    ("CAN-09", lambda c: c.faults.forge_set_point("B.X", 5.0), (DockingError,), 2 * T),
    ("AX-05", lambda c: c.faults.limit_switch("B.X"), (AxisAtLimit,), 2 * T),
    ("AX-06", lambda c: c.faults.misread("B.X", 1.0), (EncoderJump,), 2 * T),
    ("AX-07", lambda c: c.plant.misread_force("A.Z", 450.0), (BallForceTrip, MeasuredForceTrip), 0.3),
    ("AX-08", lambda c: c.faults.disable_voltage("B.X"), (AxisNotEnabled,), 3 * T),
]


def parameters() -> list[Any]:
    return [pytest.param(*row[1:], id=row[0]) for row in ROWS]


async def named_after_s(cell: ReadyCell, limit_s: float) -> tuple[float, DockingError | None]:
    """How long it takes until the motion side holds a fault against the cell."""
    begun_s = cell.loop.time()
    while cell.loop.time() <= begun_s + limit_s + T:
        try:
            cell.motion.feedback()
        except DockingError as error:
            return cell.loop.time() - begun_s, error
        await asyncio.sleep(0.25 * T)
    return float("inf"), None


@pytest.mark.parametrize(("fault", "errors", "within_s"), parameters())
def test_a_fault_at_rest_is_named_and_nothing_moves(fault, errors, within_s):
    async def story(cell: ReadyCell) -> None:
        await asyncio.sleep(0.3)
        before = cell.recorded.ticks[-1].motor_mm
        fault(cell)
        after_s, error = await named_after_s(cell, within_s)
        print(after_s, error)
        assert isinstance(error, errors), error
        assert after_s <= within_s
        with pytest.raises(DockingError):
            await cell.motion.start(cell.plan.plan_hash)
        await asyncio.sleep(1.0)
        with pytest.raises(DockingError):
            cell.motion.feedback()
        # The forged set-point is overwritten by the controller's own before the SYNC that would apply it.
        moved = np.abs(cell.recorded.ticks[-1].motor_mm - before)
        assert moved.max() <= 0.002

    play(Scene(), story)
