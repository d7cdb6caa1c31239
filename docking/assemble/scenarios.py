"""Scenarios of simulated cells: what the cell is doing, told to the runner that lets the faults happen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.simulated import FarEnd, truth_path
from docking.assemble.wires import LINE
from docking.cell import Cell
from docking.config import CellFile, JobFile
from docking.errors import BadArgument, ConfigInvalid
from docking.ports import Journal
from docking.procedure import Procedure
from docking.state import State
from sim.fault_book import FaultBook
from sim.scenario import EventModel, Known, ScenarioFile, ScenarioRunner, load_scenario, problems_of

Told = Callable[[str, EventModel], None]


def scenario_of(path: Path | None, cell_path: Path) -> ScenarioFile | None:
    """The scenario in `path`. Raises BadArgument for a cell that is not simulated, FileUnreadable, ConfigInvalid."""
    if path is None:
        return None
    if not truth_path(cell_path).exists():
        cause = f"{cell_path} is not simulated: it has no {truth_path(cell_path).name}"
        raise BadArgument("--scenario", cause, value=str(path))
    return load_scenario(path)


def runner_of(
    scenario: ScenarioFile, path: Path, cell: CellFile, far: FarEnd, told: Told, job: JobFile | None = None
) -> ScenarioRunner:
    """What lets `scenario` happen to the devices of `far`; by states only where the cell that runs `job` is in reach.

    Raises ConfigInvalid with every device, fault, state and station that is not there, and those that are.
    """
    book = FaultBook(cell, far.plant, far.world, far.devices)
    if far.line is not None:
        book.line("tracker", far.line.unplug, far.line.replug)
    if far.positioner_line is not None:
        book.line(LINE, far.positioner_line.unplug, far.positioner_line.replug)
    known = Known()
    if job is not None:
        known = Known(tuple(state.value for state in State), tuple(stage.name for stage in job.stages))
    problems = problems_of(scenario, book, known)
    if problems:
        raise ConfigInvalid(str(path), problems)
    return ScenarioRunner(scenario, book, far.loop, told)


class WatchedJournal:
    """A journal that tells a scenario's runner what the cell is doing: its records are where every step is written."""

    def __init__(self, journal: Journal, far: FarEnd) -> None:
        self._journal, self._far = journal, far
        self._cell: Cell[Procedure] | None = None
        self._runner: ScenarioRunner | None = None

    def watch(self, cell: Cell[Procedure], runner: ScenarioRunner) -> None:
        """From now on `runner` hears of the states of `cell`."""
        self._cell, self._runner = cell, runner

    def write(self, kind: str, body: dict[str, Any]) -> None:
        self._journal.write(kind, body)
        if kind == "state" and self._runner is not None and self._cell is not None:
            self._runner.entered(body["to"], self._stage(self._cell), self._share)

    async def sync(self) -> None:
        await self._journal.sync()

    def close(self) -> None:
        if self._runner is not None:
            self._runner.close()
        self._journal.close()

    def _stage(self, cell: Cell[Procedure]) -> str:
        """The station that the cell is working for; in a move, the one that it leads to."""
        progress = cell.procedure.progress
        plan = progress.plan
        moving = cell.situation.state in (State.CONFIRM, State.MOVE, State.PAUSED, State.SETTLE)
        if plan is not None and moving:
            return plan.stage
        return cell.procedure.stages[progress.stage]

    def _share(self) -> float:
        """How much of the planned displacement the axes have behind them, 0 to 1."""
        plan = self._cell.procedure.progress.plan if self._cell is not None else None
        if plan is None:
            return 0.0
        way = plan.displacement_mm
        done = self._far.plant.encoder_mm() - plan.q_mm[0]
        length = float(way @ way)
        return float(np.clip(done @ way / length, 0.0, 1.0)) if length > 0.0 else 1.0


def event_facts(event: EventModel) -> dict[str, Any]:
    """What is told and kept of an event."""
    return {"device": event.device, "fault": event.fault, **({"values": event.values} if event.values else {})}


def as_expected(scenario: ScenarioFile, outcome: str, alarms: list[dict[str, Any]]) -> bool | None:
    """Whether a run ended as its scenario says; None where it says nothing."""
    wanted = scenario.expected
    if wanted is None:
        return None
    codes = {alarm["code"] for alarm in alarms}
    named = wanted.where in str(alarms[0]["where"]) if alarms else not wanted.where
    return outcome == wanted.outcome and named and codes <= set(wanted.codes) and bool(codes) == bool(wanted.codes)
