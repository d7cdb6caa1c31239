"""A stress relief from files to summary: in virtual time, or on real wires with a supervisor at the terminal."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from docking.assemble.controller import Company, Wires
from docking.assemble.motion_side import local_motion, motion_beside
from docking.assemble.real_time import on_interrupt, run_real
from docking.assemble.runs import Files, RunRequest, Say, WireChoice, journal_path, load_files, near_ends, read_wires
from docking.assemble.simulated import FarEnd, make_far_end, real_wires, truth_of
from docking.cell import Cell
from docking.config.build import plan_period_s, plan_settings, positioners_from, relief_settings
from docking.config.load import file_sha256
from docking.errors import BadArgument
from docking.journal import JournalFile, read
from docking.motion.settle import SettleSettings
from docking.operators import TerminalOperator
from docking.planning.relief import Tare, Weighing
from docking.ports import Operator
from docking.relief import Relief, ReliefRun, summary_of
from docking.state import Event, State
from docking.types import readonly
from docking.version import VERSION
from docking.words import tell

OUTCOMES = {State.IDLE: "relieved", State.RECOVER: "stopped", State.FAULT: "fault"}


@dataclass(frozen=True)
class ReliefRequest:
    """Which files and journal (`run`), which supervisor asks, and the journal of the run that left the part strained
    (`after`), where one is known."""

    run: RunRequest
    supervisor: str
    after: Path | None


def build_relief(files: Files, wires: Wires, company: Company, supervisor: str, tare: Tare | None) -> Cell[Relief]:
    """The controller of one stress relief: the axes and no instrument."""
    cell, job = files.cell, files.job
    settle = cell.settle
    run = ReliefRun(
        positioners=positioners_from(cell, job),
        plan=plan_settings(cell, job),
        relief=relief_settings(cell),
        settle=SettleSettings(settle.window_s, settle.readings, settle.tolerance_mm, settle.timeout_s),
        period_s=plan_period_s(cell),
        permissives=job.stages[0].permissives,
        supervisor=supervisor,
        tare=tare,
    )
    motion = motion_beside(cell, local_motion(cell, job, wires.can, wires.modbus))
    return Cell(Relief(run, motion, company.journal, company.operator, company.clock))


def relieve(request: ReliefRequest, choice: WireChoice, say: Say) -> dict[str, Any]:
    """Relieve the part over real wires, step by step as the supervisor asks at the terminal; returns the summary."""
    files = load_files(request.run)
    tare = None if request.after is None else tare_of(request.after, files)
    with ExitStack() as stack:
        path = journal_path(request.run, stack)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-")))

        async def main() -> dict[str, Any]:
            far = None
            if choice.sim and choice.wires is None:
                far = make_far_end(files.cell, files.job, truth_of(request.run.cell_path), request.run.seed)
                found = await real_wires(files.cell, far, folder)
            else:
                found = read_wires(choice.wires, files.cell) if choice.wires else {}
            operator = TerminalOperator(say, request.run.language)
            try:
                return await relieve_on_loop(files, near_ends(files.cell, found), operator, (request, tare, path), far)
            finally:
                if far is not None:
                    await far.close()

        return run_real(main, lambda: say(tell(request.run.language, "no_priority")))


async def relieve_on_loop(
    files: Files,
    wires: Wires,
    operator: Operator,
    asked: tuple[ReliefRequest, Tare | None, Path],
    far: FarEnd | None,
    interrupt: Callable[[Callable[[], None]], None] = on_interrupt,
) -> dict[str, Any]:
    """Relieve once on the running loop and close the journal with the outcome; `asked`: request, tare, journal."""
    request, tare, path = asked
    loop = asyncio.get_running_loop()
    started_s, wall_s = loop.time(), time.perf_counter()
    journal = JournalFile(path, loop.time)
    try:
        journal.write("run_started", _started(request, files, tare, simulated=far is not None), durable=True)
        cell = build_relief(files, wires, Company(journal, operator, loop.time), request.supervisor, tare)
        operator.attend(cell.post, cell.override)
        interrupt(lambda: _abort(cell, operator))
        state = await cell.relieve()
        summary = {
            "outcome": OUTCOMES[state],
            **summary_of(cell.procedure),
            "true_internal_force_n": far.plant.true_internal_force_n() if far is not None else None,
            "virtual_time_s": loop.time() - started_s,
            "wall_time_s": time.perf_counter() - wall_s,
        }
        journal.write("outcome", summary, durable=True)
        return summary
    finally:
        journal.close()


def _abort(cell: Cell[Relief], operator: Operator) -> None:
    operator.notify("interrupted")
    cell.post(Event.ABORT)


def _started(request: ReliefRequest, files: Files, tare: Tare | None, *, simulated: bool) -> dict[str, Any]:
    return {
        "command": "relieve",
        "supervisor": request.supervisor,
        "cell": str(request.run.cell_path),
        "job": str(files.job_path),
        "cell_sha256": file_sha256(request.run.cell_path),
        "job_sha256": file_sha256(files.job_path),
        "part_number": files.job.part_number,
        "serial_number": files.job.serial_number,
        "seed": request.run.seed if simulated else None,
        "simulated": simulated,
        "version": VERSION,
        "axes": list(files.cell.axis_names),
        "after": None if request.after is None else str(request.after),
        "tare_age_h": None if tare is None else tare.age_h,
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
