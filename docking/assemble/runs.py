"""One run from files to summary: in virtual time, or on real wires."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docking.assemble.controller import Company, Wires, build_cell
from docking.assemble.real_time import aside, on_interrupt, run_real
from docking.assemble.simulated import FarEnd, make_far_end, real_wires, truth_of, virtual_wires
from docking.assemble.spawned import MotionProcess
from docking.cell import Cell
from docking.config import CellFile, JobFile
from docking.config.inputs import ModbusModule
from docking.config.load import default_job_path, file_sha256, load_cell, load_job
from docking.errors import BadArgument, FileUnreadable, FileUnwritable
from docking.journal import JournalFile, read
from docking.operators import AutomaticOperator, TerminalOperator
from docking.ports import Journal, Motion, Operator, at_once
from docking.procedure import Procedure
from docking.progress import Progress
from docking.records import alarm_record
from docking.state import Event, State
from docking.version import VERSION
from docking.words import tell
from drivers.links.serial_port import SerialPort
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
LOOPBACK = ("127.0.0.1", "::1", "localhost")
Say = Callable[[str], None]


@dataclass(frozen=True)
class RunRequest:
    """What one run is asked to do: files, seed of the simulation, where report and journal go, language."""

    cell_path: Path
    job_path: Path | None
    seed: int
    report: Path | None
    journal: Path | None
    language: str


@dataclass(frozen=True)
class WireChoice:
    """Which wires: simulated ones (`sim`), at the addresses in `wires` or started for this run."""

    sim: bool
    wires: Path | None


@dataclass(frozen=True)
class Files:
    """The loaded files of a run."""

    cell: CellFile
    job: JobFile
    job_path: Path


def load_files(request: RunRequest) -> Files:
    """Load and check both files; raises ConfigError with all problems."""
    cell = load_cell(request.cell_path)
    job_path = request.job_path or default_job_path(request.cell_path)
    return Files(cell, load_job(job_path, cell), job_path)


def dry_run(request: RunRequest, say: Say) -> dict[str, Any]:
    """Dock in virtual time; returns the summary, writes journal and report."""
    files = load_files(request)
    truth = truth_of(request.cell_path)
    return dry_run_files(files, truth, request, say)


def dry_run_files(files: Files, truth: TruthFile, request: RunRequest, say: Say) -> dict[str, Any]:
    """`dry_run` with files already loaded and a truth of the caller's choice (studies)."""
    with ExitStack() as stack:
        path = journal_path(request, stack)

        async def main() -> dict[str, Any]:
            far = make_far_end(files.cell, files.job, truth, request.seed)
            wires = await virtual_wires(files.cell, far)
            operator = AutomaticOperator(say, request.language)
            return await _dock(_Run(files, request, wires, operator, path, far, simulated=True))

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
            else:
                found = read_wires(choice.wires, files.cell) if choice.wires else {}
            operator = (TerminalOperator if step else AutomaticOperator)(say, request.language)
            wires = Wires(SerialPort(found.get("tracker", files.cell.tracker.port), files.cell.tracker.baud))
            joined = _Joined(process, found)
            try:
                return await _dock(_Run(files, request, wires, operator, path, far, choice.sim, joined, step))
            finally:
                if far is not None:
                    await far.close()

        # Ticks are the motion process' business; here only those of simulated devices have to be on time.
        own_devices = choice.sim and choice.wires is None
        return _finish(request, path, run_real(main, ticks=own_devices))


def serve(request: RunRequest, wires_file: Path | None, say: Say, trace: Path | None = None) -> None:
    """Serve the simulated devices of a cell on real wires until interrupted; `trace` records how the axes move."""
    files = load_files(request)
    for path in (wires_file, trace):
        if path is not None:
            _prepare(path)
    with tempfile.TemporaryDirectory(prefix="docking-sim-") as folder:

        async def main() -> None:
            far = make_far_end(files.cell, files.job, truth_of(request.cell_path), request.seed)
            found = await real_wires(files.cell, far, Path(folder))
            if trace is not None:
                with _writing(trace):
                    far.trace(trace)
            asked_to_end = asyncio.Event()
            on_interrupt(asked_to_end.set)
            text = json.dumps(found, indent=2)
            if wires_file is not None:
                # Written whole and then renamed: a reader never meets half a file.
                part = wires_file.with_suffix(".part")
                with _writing(wires_file):
                    part.write_text(text + "\n", "utf-8")
                    part.replace(wires_file)
            say(text)
            say(tell(request.language, "served"))
            try:
                await asked_to_end.wait()
            finally:
                await far.close()

        run_real(main)


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


async def _dock(run: _Run) -> dict[str, Any]:
    """Dock once on the running loop and close the journal with the outcome."""
    loop = asyncio.get_running_loop()
    started_s, wall_s = loop.time(), time.perf_counter()
    journal = JournalFile(run.journal_path, loop.time)
    try:
        journal.write("run_started", _started(run), durable=True)
        company = Company(journal, run.operator, loop.time, aside if run.joined else at_once, run.step)
        motion = await _joined_motion(run, run.joined, journal) if run.joined else None
        cell = build_cell(run.files.cell, run.files.job, run.wires, company, motion)
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
        journal.write("outcome", summary, durable=True)
        return summary
    finally:
        journal.close()


async def _joined_motion(run: _Run, joined: _Joined, journal: Journal) -> Motion:
    """The motion side in its own process; what it says of itself is kept, and told where it matters."""
    files = run.files
    fastest_mm_s = max(stage.speed_mm_s for stage in files.job.stages)

    def hear(kind: str, body: Any) -> None:
        if kind == "lateness":
            journal.write("lateness", body)
            if not (fastest_mm_s <= body["speed_limit_mm_s"]):
                late_ms, limit_mm_s = 1e3 * body["p999_s"], body["speed_limit_mm_s"]
                run.operator.notify("slowed", late_ms=late_ms, limit_mm_s=limit_mm_s)
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

        with _writing(request.report):
            write_report(read(journal_path), request.report, request.language)
    return summary


def journal_path(request: RunRequest, stack: ExitStack) -> Path:
    """Where the journal of this run goes: as asked, beside the report, or into a folder that ends with the run.

    Raises FileUnwritable before anything moves where journal or report cannot be written.
    """
    if request.report is not None:
        _prepare(request.report)
    if request.journal is not None:
        return _fresh(request.journal)
    if request.report is not None:
        return _fresh(request.report.with_suffix(".journal.jsonl"))
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="docking-"))) / "journal.jsonl"


def _fresh(path: Path) -> Path:
    """One journal a run: an earlier one is kept beside it under the next free number."""
    _prepare(path)
    if path.exists():
        n = 1
        while (kept := path.with_name(f"{path.stem}.{n}{path.suffix}")).exists():
            n += 1
        with _writing(path):
            path.rename(kept)
    return path


def _prepare(path: Path) -> None:
    """Make the folder of a file that is to be written, and find out whether it can be."""
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FileUnwritable(str(path), (error.strerror or str(error)).lower()) from error


def _refuse_real_devices(path: Path, found: dict[str, Any]) -> None:
    """Simulated devices live on this machine: on a pty, a local socket, the loopback interface. Nothing else is moved
    without a person."""
    listed = found.get("modbus")
    hosts = [str(at[0]) for at in listed.values() if at] if isinstance(listed, dict) else []
    far = [host for host in hosts if host not in LOOPBACK]
    tracker, can = str(found.get("tracker", "")), str(found.get("can", ""))
    far += [tracker] if tracker and not tracker.startswith("/dev/pts/") else []
    far += [can] if can and not Path(can).is_socket() else []
    if far:
        raise BadArgument("--wires", f"{far[0]} is no simulated device of this machine", value=str(path))


def read_wires(path: Path, cell: CellFile) -> dict[str, Any]:
    """The addresses that `docking sim` wrote. Raises FileUnreadable, BadArgument when they are not this cell's."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise FileUnreadable(str(path), (error.strerror or str(error)).lower()) from error
    except ValueError as error:
        raise FileUnreadable(str(path), f"not JSON: {error}") from error
    if not isinstance(found, dict) or found.get("cell") != cell.name:
        raise BadArgument("--wires", f"the file is not for cell {cell.name}", value=str(path))
    modules = cell.inputs.modules if cell.inputs is not None else ()
    expected = {module.name for module in modules if isinstance(module, ModbusModule)}
    queued = cell.bus.kind == "modbus-tcp"
    expected |= {p.name for p in cell.positioners} if queued else set()
    listed = found.get("modbus", {})
    whole = isinstance(listed, dict) and set(listed) == expected and (queued or isinstance(found.get("can"), str))
    _refuse_real_devices(path, found)
    if not (whole and isinstance(found.get("tracker"), str)):
        cause = "the file lacks addresses of this cell; let `docking sim` write it"
        raise BadArgument("--wires", cause, value=str(path))
    return found
