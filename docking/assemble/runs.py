"""One run from files to summary: in virtual time, or on real wires."""

from __future__ import annotations

import asyncio
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from docking.assemble.controller import Company, Wires, build_cell
from docking.assemble.real_time import aside, on_interrupt, run_real
from docking.assemble.requests import (
    Files,
    RunRequest,
    Say,
    WireChoice,
    journal_path,
    load_files,
    opened,
    read_wires,
    writing,
)
from docking.assemble.scenarios import WatchedJournal, as_expected, event_facts, runner_of, scenario_of
from docking.assemble.simulated import FarEnd, make_far_end, real_wires, truth_of, virtual_wires
from docking.assemble.spawned import MotionProcess
from docking.assemble.streams import stream_wires, streams_of, virtual_streams
from docking.cell import Cell
from docking.config.load import file_sha256
from docking.journal import JournalFile, read
from docking.live import ReportingMotion
from docking.operators import AutomaticOperator, TerminalOperator
from docking.ports import Journal, Operator, SerialLink, at_once
from docking.procedure import Procedure
from docking.progress import Progress
from docking.records import alarm_record
from docking.state import Event, State
from docking.transcript import TranscribedSerial
from docking.version import VERSION
from drivers.links.serial_port import SerialPort
from sim.scenario import EventModel, ScenarioFile
from sim.truth import TruthFile
from sim.virtual_time import run_virtual

OUTCOMES = {
    State.DOCKED: "docked",
    State.OUT_OF_TOLERANCE: "out_of_tolerance",
    State.RECOVER: "stopped",
    State.FAULT: "fault",
}
DECISION_RULE = (
    "e + 2 sigma <= tolerance for every docking feature (ISO 14253-1, k = 2), "
    "and at most 2.5 % risk that any feature is out of tolerance (JCGM 106)"
)


def dry_run(request: RunRequest, say: Say) -> dict[str, Any]:
    """Dock in virtual time; returns the summary, writes journal and report."""
    files = load_files(request)
    scenario = scenario_of(request.scenario, request.cell_path)
    truth = truth_of(request.cell_path)
    return dry_run_files(files, truth, request, say, scenario)


def dry_run_files(
    files: Files, truth: TruthFile, request: RunRequest, say: Say, scenario: ScenarioFile | None = None
) -> dict[str, Any]:
    """`dry_run` with files already loaded and a truth of the caller's choice (studies)."""
    with ExitStack() as stack:
        path = journal_path(request, stack)

        async def main() -> dict[str, Any]:
            far = make_far_end(files.cell, files.job, truth, request.seed)
            wires = await virtual_wires(files.cell, far)
            if files.cell.live is not None:
                wires = replace(wires, streams=virtual_streams(files.cell, files.job, request.cell_path.parent, far))
            operator = AutomaticOperator(say, request.language)
            return await _dock(_Run(files, request, wires, operator, path, far, simulated=True, scenario=scenario))

        summary = run_virtual(main)
        return _finish(request, path, summary)


def run_on_wires(request: RunRequest, choice: WireChoice, say: Say, *, step: bool) -> dict[str, Any]:
    """Dock over real wires; with `step` a person confirms every move in the terminal."""
    files = load_files(request)
    with ExitStack() as stack:
        path = journal_path(request, stack)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-")))
        process = stack.enter_context(MotionProcess())

        async def main() -> dict[str, Any]:
            far = None
            if choice.sim and choice.wires is None:
                far = make_far_end(files.cell, files.job, truth_of(request.cell_path), request.seed)
                found = await real_wires(files.cell, far, folder)
                found |= stream_wires(files.cell, files.job, request.cell_path.parent, far)
            else:
                found = read_wires(choice.wires, files.cell) if choice.wires else {}
            operator = (TerminalOperator if step else AutomaticOperator)(say, request.language)
            serial: SerialLink = SerialPort(found.get("tracker", files.cell.tracker.port), files.cell.tracker.baud)
            transcript = opened(request.transcript)
            if transcript is not None:
                serial = TranscribedSerial(serial, transcript, "tracker")
                found = {**found, "transcript": str(transcript.path.resolve())}
            streams = None
            if files.cell.live is not None:
                streams = streams_of(files.cell, request.cell_path.parent, found, transcript)
            wires, joined = Wires(serial=serial, streams=streams), _Joined(process, found)
            try:
                return await _dock(_Run(files, request, wires, operator, path, far, choice.sim, joined, step))
            finally:
                if far is not None:
                    await far.close()
                if transcript is not None:
                    transcript.close()

        # Ticks are the motion process' business; here only those of simulated devices have to be on time.
        own_devices = choice.sim and choice.wires is None
        return _finish(request, path, run_real(main, ticks=own_devices))


@dataclass(frozen=True)
class _Joined:
    """The motion process of a run, and where it finds simulated devices."""

    process: MotionProcess
    found: dict[str, Any]


@dataclass(frozen=True)
class _Run:
    files: Files
    request: RunRequest
    wires: Wires
    operator: Operator
    journal_path: Path
    far: FarEnd | None
    simulated: bool
    joined: _Joined | None = None
    step: bool = False
    scenario: ScenarioFile | None = None


async def _dock(run: _Run) -> dict[str, Any]:
    """Dock once on the running loop and close the journal with the outcome."""
    loop = asyncio.get_running_loop()
    started_s, wall_s = loop.time(), time.perf_counter()
    work = aside if run.joined else at_once
    journal: Journal = JournalFile(run.journal_path, loop.time, aside=work)
    watched = WatchedJournal(journal, run.far) if run.scenario is not None and run.far is not None else None
    journal = watched or journal
    try:
        journal.write("run_started", _started(run))
        await journal.sync()
        company = Company(journal, run.operator, loop.time, work, run.step)
        motion = await _joined_motion(run, run.joined, journal) if run.joined else None
        cell = build_cell(run.files.cell, run.files.job, run.wires, company, motion)
        if watched is not None:
            _let_happen(run, cell, watched)
        run.operator.attend(cell.post, cell.override)
        if run.joined:
            on_interrupt(lambda: _abort(cell, run.operator))
        try:
            state = await cell.dock()
        finally:
            if run.joined:
                journal.write("motion_process", await run.joined.process.end())
        times = (loop.time() - started_s, time.perf_counter() - wall_s)
        summary = _summary(run, cell, state, times)
        if run.scenario is not None:
            met = as_expected(run.scenario, summary["outcome"], summary["alarms"])
            summary["scenario"] = {"name": run.scenario.name, "as_expected": met}
        journal.write("outcome", summary)
        await journal.sync()
        return summary
    finally:
        journal.close()


def _let_happen(run: _Run, cell: Cell[Procedure], watched: WatchedJournal) -> None:
    """Let the scenario of this run happen; every event is kept and told."""
    path = run.request.scenario
    if run.scenario is None or run.far is None or path is None:
        return

    def told(what: str, event: EventModel) -> None:
        watched.write("scenario", {"what": what, **event_facts(event)})
        if what == "begins":
            run.operator.notify("scenario_begins", device=event.device, fault=event.fault)
        else:
            run.operator.notify("scenario_ends", device=event.device, fault=event.fault)

    watched.watch(cell, runner_of(run.scenario, path, run.files.cell, run.far, told, run.files.job))


async def _joined_motion(run: _Run, joined: _Joined, journal: Journal) -> ReportingMotion:
    """The motion side in its own process; what it says of itself is kept, and told where it matters."""
    files = run.files
    raised = files.job.level or files.job.lift_mm > 0.0
    asked = [stage.speed_mm_s for stage in files.job.stages] + [files.job.lift_speed_mm_s] * raised
    fastest_mm_s = max(asked)

    def hear(kind: str, body: Any) -> None:
        if kind == "lateness":
            journal.write("lateness", body)
            if not (fastest_mm_s <= body["speed_limit_mm_s"]):
                late_ms, limit_mm_s = 1e3 * body["p999_s"], body["speed_limit_mm_s"]
                run.operator.notify("slowed", late_ms=late_ms, limit_mm_s=limit_mm_s)
            return
        if kind == "run_lateness":
            journal.write("run_lateness", body)
            return
        journal.write("motion_process", body if isinstance(body, dict) else {kind: body})
        if kind == "hello" and not body["priority"]:
            run.operator.notify("no_priority")

    return await joined.process.join((run.request.cell_path, files.job_path), files.cell, joined.found, hear)


def _abort(cell: Cell[Procedure], operator: Operator) -> None:
    operator.notify("interrupted")
    cell.post(Event.ABORT)


def _started(run: _Run) -> dict[str, Any]:
    files, limits = run.files, run.files.cell.limits
    return {
        "cell": str(run.request.cell_path),
        "job": str(files.job_path),
        "cell_sha256": file_sha256(run.request.cell_path),
        "job_sha256": file_sha256(files.job_path),
        "part_number": files.job.part_number,
        "serial_number": files.job.serial_number,
        "seed": run.request.seed if run.simulated else None,
        "simulated": run.simulated,
        "version": VERSION,
        "tolerance_mm": files.job.tolerance_mm,
        "decision_rule": DECISION_RULE,
        "axes": list(files.cell.axis_names),
        "limits": {
            "following_error_mm": limits.following_error_vmax_mm,
            "ball_residual_mm": limits.ball_residual_mm,
            "internal_force_n": limits.internal_force_n,
            "axis_force_n": {
                f"{p.name}.{a.name}": rated
                for p in files.cell.positioners
                for a, rated in zip(p.axes, p.rated_n, strict=True)
            },
        },
    }


def _summary(run: _Run, cell: Cell[Procedure], state: State, times_s: tuple[float, float]) -> dict[str, Any]:
    """The object that `--json` prints."""
    p: Progress = cell.procedure.progress
    outcome = OUTCOMES[state]
    if outcome == "fault" and p.moves == 0:
        outcome = "refused"
    worst = p.errors.worst() if p.errors is not None else None
    true_mm = float(run.far.plant.true_feature_errors_mm().max()) if run.far is not None else None
    return {
        "outcome": outcome,
        "tolerance_mm": run.files.job.tolerance_mm,
        "max_feature_error_mm": float(p.errors.norm_mm[worst]) if p.errors is not None else None,
        "feature_sigma_mm": float(p.errors.sigma_mm[worst]) if p.errors is not None else None,
        "true_max_feature_error_mm": true_mm,
        "moves": p.moves,
        "rejected_points": sorted(p.rejected),
        "max_consistency_residual_mm": p.max_residual_mm if p.moves else None,
        "max_internal_force_n": p.max_internal_force_n if p.moves else None,
        "virtual_time_s": times_s[0],
        "wall_time_s": times_s[1],
        "alarms": [alarm_record(a) for a in p.alarms],
        "report": str(run.request.report) if run.request.report else None,
    }


def _finish(request: RunRequest, journal_path: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Write the report from the journal alone."""
    if request.report is not None:
        from docking.report import write_report

        with writing(request.report):
            write_report(read(journal_path), request.report, request.language)
    return summary
