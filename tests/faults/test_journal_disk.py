"""The disk of the journal fails or is slow: no axis is led by a move that is not on the disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.errors import JournalUnwritable
from docking.journal import read
from sim.virtual_time import run_virtual
from tests.support.dry_cell import DryCell
from tests.support.strained_cell import ReliefCase, Strained, relieved


def test_a_move_whose_intent_the_disk_does_not_take_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, broken = os.fdatasync, [False]

    def fdatasync(fd: int) -> None:
        if broken[0]:
            raise OSError(5, "Input/output error")
        real(fd)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    cell_of: list[DryCell] = []

    def breaks(kind: str, body: dict[str, Any]) -> None:
        broken[0] = broken[0] or kind == "intent"

    async def story() -> None:
        cell = DryCell("lab-can", 1, tmp_path / "run.jsonl")
        cell_of.append(cell)
        await cell.build()
        cell.journal.hooks.append(breaks)
        with pytest.raises(JournalUnwritable, match="Input/output error"):
            await cell.dock()
        await cell.far.close()

    run_virtual(story)
    cell = cell_of[0]
    assert [r["kind"] for r in read(cell.journal_path)][-1] == "intent"
    _, table = cell.setpoints_mm()
    assert len(table) > 100, "the axes were enabled and held"
    driven = ~np.isnan(table[0])
    assert np.ptp(table[:, driven], axis=0).max() == 0.0


def test_a_relief_step_whose_intent_the_disk_does_not_take_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, asked = os.fdatasync, []

    def fdatasync(fd: int) -> None:
        if asked:
            raise OSError(5, "Input/output error")
        real(fd)

    def asks(case: ReliefCase) -> None:
        asked.append(case)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    with pytest.raises(JournalUnwritable, match="Input/output error"):
        relieved(Strained("lab-can", 1, {"B.Z": 0.1}, each=asks), tmp_path / "run.jsonl")
    (case,) = asked
    kinds = [kind for kind, _ in case.records]
    assert kinds.count("intent") == 1
    assert "moved" not in kinds
    at_intent = case.step_starts[0]
    assert np.ptp(np.array(case.position_mm[at_intent:]), axis=0).max() < 1e-3
