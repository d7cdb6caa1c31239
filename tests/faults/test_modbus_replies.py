"""Rows MB-01 to MB-05 by the faults that scenarios name: what a PLC's answers can suffer on the way, in a move.

The faults are those of the simulated devices themselves (`sim.plc.reply_faults`), on TCP and on one serial line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.assemble.simulated import make_far_end, truth_of, virtual_wires
from docking.config.load import load_cell, load_job
from docking.errors import BadReply, ConsistencyTrip, DeviceRefused, DeviceSilent, DockingError
from sim.fault_book import FaultBook
from sim.plc.reply_faults import KINDS, ReplyFaults
from sim.scenario import EventModel, Known, ScenarioFile, problems_of
from sim.virtual_time import run_virtual
from tests.support.ready_modbus import ModbusScene, ReadyModbus, play_modbus

POLL_S, TIMEOUT_S, SCAN_S = 0.05, 0.05, 0.01
TOLD_S = 3.0 * SCAN_S
CELL = Path(__file__).parents[2] / "sim" / "cells" / "lab-modbus.toml"


@dataclass(frozen=True)
class Row:
    """`begin` at half of the move; it ends `done` where `errors` is empty, else with one of them that says `named`,
    all axes told to stop within `told_s`."""

    begin: Callable[[ReplyFaults], None]
    errors: tuple[type[DockingError], ...] = ()
    told_s: float = POLL_S + TOLD_S
    named: str = "positioner B"


SILENT_S = POLL_S + 2.0 * TIMEOUT_S + TOLD_S
ROWS = {
    "MB-01 late, in time": Row(lambda f: f.late(0.6 * TIMEOUT_S)),
    "MB-01 late once": Row(lambda f: f.late(1.5 * TIMEOUT_S, count=1)),
    "MB-01 late": Row(lambda f: f.late(4.0 * TIMEOUT_S), (DeviceSilent,), SILENT_S),
    "MB-01 requests lost": Row(lambda f: f.lose_requests(), (DeviceSilent,), SILENT_S + 0.4),
    "MB-01 replies lost": Row(lambda f: f.lose_replies(), (DeviceSilent,), SILENT_S),
    "MB-02 exception 4": Row(lambda f: f.exception(4, count=1), (DeviceRefused,)),
    "MB-02 busy once": Row(lambda f: f.exception(6, count=1)),
    "MB-04 short once": Row(lambda f: f.short(count=1)),
    "MB-04 short": Row(lambda f: f.short(), (DeviceSilent, BadReply), SILENT_S),
    "MB-04 sliced": Row(lambda f: f.sliced()),
    "MB-05 wrong length": Row(lambda f: f.wrong_length(count=1), (BadReply,)),
    "MB-05 wrong transaction once": Row(lambda f: f.wrong_transaction(count=1)),
    "MB-05 wrong transaction": Row(lambda f: f.wrong_transaction(), (DeviceSilent,), SILENT_S),
    "MB-05 wrong unit": Row(lambda f: f.wrong_unit(count=1), (BadReply,)),
    "MB-05 wrong function": Row(lambda f: f.wrong_function(count=1), (BadReply,)),
    "MB-05 stale": Row(lambda f: f.stale()),
    "MB-05 double": Row(lambda f: f.double()),
    "MB-05 one poll old": Row(lambda f: f.repeat(), (ConsistencyTrip,), SILENT_S, "B is last"),
}


TAMPERED_TOO = ("requests lost", "replies lost", "exception 4", "busy once", "short once", "short")
"""Rows that tests/faults/test_modbus_rows.py plays every time, by bytes changed on the wire."""


def row_cases() -> list[Any]:
    return [pytest.param(name, marks=[pytest.mark.full] if name.endswith(TAMPERED_TOO) else []) for name in ROWS]


@pytest.mark.parametrize("name", row_cases())
def test_a_row(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]

    def fault(cell: ReadyModbus) -> None:
        row.begin(cell.group.faults["B"])

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(0.5, fault)

    cell = play_modbus(ModbusScene(), story, monkeypatch)
    result = cell.result
    assert result is not None, cell.refused
    cell.assert_no_second_start()
    assert cell.residual_mm() <= cell.stated_mm()
    cell.assert_at_rest_and_braked()
    if not row.errors:
        assert (result.result, result.cause) == ("done", None)
        assert np.abs(cell.record.motors()[1][-1] - cell.plan.q_mm[-1]).max() <= 0.002
        return
    assert result.result == "fault"
    assert isinstance(result.cause, row.errors), repr(result.cause)
    assert row.named in str(result.cause)
    assert cell.stood_s() <= row.told_s + cell.motion._bus.quick_ramp_s + 2.0 * SCAN_S


def test_scenarios_know_every_fault_of_an_answer() -> None:
    """By name, with the values that it takes, on a positioner; a wrong value is refused before anything moves."""

    async def main() -> tuple[tuple[str, ...], tuple[str, ...]]:
        cell = load_cell(CELL)
        far = make_far_end(cell, load_job(CELL.with_name("lab-modbus.job.toml"), cell), truth_of(CELL), 1)
        await virtual_wires(cell, far)
        book = FaultBook(cell, far.plant, far.world, far.devices)
        needed = {"late": {"late_s": 0.2}}
        events = [
            EventModel(device="B", fault=kind, at_s=1.0, for_s=0.5, values={"count": 3, **needed.get(kind, {})})
            for kind in KINDS
        ]
        wrong = [
            EventModel(device="B", fault="late", at_s=1.0),
            EventModel(device="B", fault="exception", at_s=1.0, values={"code": "six"}),
        ]
        found = [
            problems_of(ScenarioFile(schema_version=1, name="all", event=tuple(each)), book, Known())
            for each in (events, wrong)
        ]
        await far.close()
        return found[0], found[1]

    right, wrong = run_virtual(main)
    assert right == ()
    assert [text.partition(": ")[2] for text in wrong] == [
        "it needs the value late_s",
        "code = 'six' is of the wrong type",
    ]
    assert len(KINDS) == 14
