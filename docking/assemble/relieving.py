"""A stress relief from files to summary, on real wires, with a supervisor at the terminal."""

from __future__ import annotations

import asyncio
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Company
from docking.assemble.real_time import aside, on_interrupt, run_real
from docking.assemble.requests import Files, RunRequest, Say, WireChoice, journal_path, load_files, read_wires
from docking.assemble.simulated import make_far_end, real_wires, truth_of
from docking.assemble.spawned import MotionProcess
from docking.cell import Cell
from docking.config.build import plan_period_s, plan_settings, positioners_from, relief_settings
from docking.config.load import file_sha256
from docking.errors import BadArgument
from docking.journal import JournalFile, read
from docking.motion.lateness import LATENESS
from docking.motion.settle import SettleSettings
from docking.operators import TerminalOperator
from docking.planning.relief import Tare, Weighing
from docking.ports import Motion, Operator
from docking.relief import Relief, ReliefRun, summary_of
from docking.state import Event, State
from docking.types import readonly
from docking.version import VERSION

OUTCOMES = {State.IDLE: "relieved", State.RECOVER: "stopped", State.FAULT: "fault"}


@dataclass(frozen=True)
class ReliefRequest:
    """Which files and journal (`run`), which supervisor asks, and the journal of the run that left the part strained
    (`after`), where one is known."""

    run: RunRequest
    supervisor: str
    after: Path | None


def build_relief(
    files: Files, motion: Motion, company: Company, supervisor: str, tare: Tare | None = None
) -> Cell[Relief]:
    """The controller of one stress relief: the axes and no instrument."""
    cell, job = files.cell, files.job
    settle = cell.settle
    enabling = cell.inputs.names("enabling-device") if cell.inputs is not None else ()
    run = ReliefRun(
        positioners=positioners_from(cell, job),
        plan=plan_settings(cell, job),
        relief=relief_settings(cell),
        settle=SettleSettings(settle.window_s, settle.readings, settle.tolerance_mm, settle.timeout_s),
        period_s=plan_period_s(cell),
        permissives=(*job.stages[0].permissives, *enabling),
        supervisor=supervisor,
        tare=tare,
    )
    return Cell(Relief(run, motion, company.journal, company.operator, company.clock))


def relieve(request: ReliefRequest, choice: WireChoice, say: Say) -> dict[str, Any]:
    """Relieve the part over real wires, step by step as the supervisor asks at the terminal; returns the summary."""
    files = load_files(request.run)
    tare = None if request.after is None else tare_of(request.after, files)
    with ExitStack() as stack:
        path = journal_path(request.run, stack)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-")))
        process = stack.enter_context(MotionProcess())

        async def main() -> dict[str, Any]:
            far = None
            if choice.sim and choice.wires is None:
                far = make_far_end(files.cell, files.job, truth_of(request.run.cell_path), request.run.seed)
                found = await real_wires(files.cell, far, folder)
            else:
                found = read_wires(choice.wires, files.cell) if choice.wires else {}
            run = _Run(request, files, tare, TerminalOperator(say, request.run.language), path, choice.sim)
            try:
                return await _relieve(run, process, found)
            finally:
                if far is not None:
                    await far.close()

        return run_real(main, ticks=choice.sim and choice.wires is None)


@dataclass(frozen=True)
class _Run:
    request: ReliefRequest
    files: Files
    tare: Tare | None
    operator: Operator
    journal_path: Path
    simulated: bool


async def _relieve(run: _Run, process: MotionProcess, found: dict[str, Any]) -> dict[str, Any]:
    """Relieve once on the running loop and close the journal with the outcome."""
    loop, files, operator = asyncio.get_running_loop(), run.files, run.operator
    started_s = loop.time()
    journal = JournalFile(run.journal_path, loop.time, aside=aside)

    def hear(kind: str, body: Any) -> None:
        named = kind if kind in LATENESS else "motion_process"
        journal.write(named, body if isinstance(body, dict) else {kind: body})
        if kind == "hello" and not body["priority"]:
            operator.notify("no_priority")

    try:
        journal.write("run_started", _started(run))
        await journal.sync()
        paths = (run.request.run.cell_path, files.job_path)
        motion = await process.join(paths, files.cell, found, hear)
        cell = build_relief(files, motion, Company(journal, operator, loop.time), run.request.supervisor, run.tare)
        operator.attend(cell.post, cell.override)
        on_interrupt(lambda: _abort(cell, operator))
        try:
            state = await cell.relieve()
        finally:
            journal.write("motion_process", await process.end())
        elapsed_s = loop.time() - started_s
        summary = {"outcome": OUTCOMES[state], **summary_of(cell.procedure), "elapsed_s": elapsed_s}
        journal.write("outcome", summary)
        await journal.sync()
        return summary
    finally:
        journal.close()


def _abort(cell: Cell[Relief], operator: Operator) -> None:
    operator.notify("interrupted")
    cell.post(Event.ABORT)


def _started(run: _Run) -> dict[str, Any]:
    request, files = run.request, run.files
    return {
        "command": "relieve",
        "supervisor": request.supervisor,
        "cell": str(request.run.cell_path),
        "job": str(files.job_path),
        "cell_sha256": file_sha256(request.run.cell_path),
        "job_sha256": file_sha256(files.job_path),
        "part_number": files.job.part_number,
        "serial_number": files.job.serial_number,
        "seed": request.run.seed if run.simulated else None,
        "simulated": run.simulated,
        "version": VERSION,
        "axes": list(files.cell.axis_names),
        "after": None if request.after is None else str(request.after),
        "tare_age_h": None if run.tare is None else run.tare.age_h,
    }


def tare_of(path: Path, files: Files) -> Tare:
    """The weighing before the first move of the run in journal `path`: of this part on these axes, the newest one.

    Raises BadArgument where the journal holds none, and as `docking.journal.read`.
    """
    part = (files.job.part_number, files.job.serial_number)
    found, same_part = None, False
    for record in read(path):
        body = record["body"]
        if record["kind"] == "run_started":
            same_part = (body["part_number"], body["serial_number"]) == part
            same_part = same_part and body["axes"] == list(files.cell.axis_names)
        elif record["kind"] == "tare" and same_part:
            found = record
    if found is None:
        raise BadArgument("--after", "it holds no weighing of this part on this cell", value=str(path))
    axes, body = files.cell.axis_names, found["body"]
    rows = [readonly([body[name][axis] for axis in axes]) for name in ("position_mm", "force_n", "noise_n")]
    age_s = (datetime.now(UTC) - datetime.fromisoformat(found["t_wall"])).total_seconds()
    return Tare(Weighing(*rows), float(np.clip(age_s, 0.0, None)) / 3600.0)
