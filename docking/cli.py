"""The command line: `docking COMMAND`. With `--json` exactly one object goes to stdout on every exit."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from docking.cli_devices import devices, monitor
from docking.cli_fit import fit, study_pose, study_real, study_screening
from docking.cli_guide import guide, study_guidance
from docking.cli_home import home
from docking.cli_single import single
from docking.cli_survey import layout, network
from docking.cli_track import study_tracking, track
from docking.errors import (
    EXIT_FAULT,
    EXIT_OK,
    EXIT_OUT_OF_TOLERANCE,
    EXIT_STOPPED,
    BadArgument,
    ConfigInvalid,
    Defect,
    DockingError,
    StoppedByOperator,
)
from docking.terminal import FILE, json_option, language, print_json, print_text, transcript_option, wire_choice
from docking.words import tell

EXIT_OF_OUTCOME = {
    "docked": EXIT_OK,
    "relieved": EXIT_OK,
    "out_of_tolerance": EXIT_OUT_OF_TOLERANCE,
    "stopped": EXIT_STOPPED,
    "fault": EXIT_FAULT,
    "refused": EXIT_FAULT,
}
SEED = click.IntRange(min=0)
COUNT = click.IntRange(min=1)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="docking-cell", prog_name="docking")
def cli() -> None:
    """Docks large aircraft components with numerically controlled positioners.

    A functional layer, not a safety function: the emergency-stop chain is hard-wired and does not depend on it.

    \b
    Example: docking dry-run sim/cells/lab-can.toml --report report.html
    """


@cli.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@json_option
def check(cell: Path, job: Path | None, as_json: bool) -> int:
    """Check a CELL file and its JOB file, and say what the cell can prove.

    \b
    Example: docking check sim/cells/fuselage-can.toml
    """
    from docking.config.check import check_files

    result = check_files(cell, job)
    if as_json:
        print_json(result.as_json())
    else:
        click.echo(result.text)
    return EXIT_OK


@cli.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option(
    "--from", "start", metavar="X,Y,Z,A,B,G", help="Start so far off the first station: mm along W, deg about the face."
)
@click.option("--seed", type=SEED, help="Draw the start inside the guard of the first correction instead.")
@click.option("--plot", type=FILE, help="Draw every axis along the paths into this HTML file.")
@json_option
def plan(cell: Path, job: Path | None, start: str | None, seed: int | None, plot: Path | None, as_json: bool) -> int:
    """Plan and check every move of a job without connecting or moving anything.

    Says for each stage how far every axis goes, what is left to its limits, which limit sets the speed, and what one
    jammed axis would do to the part. A refused move exits with 1 and names what would fit.

    \b
    Example: docking plan sim/cells/fuselage-can.toml --from 15,-10,5,0.2,0,-0.3 --plot plan.html
    """
    from docking.preview import head_text, move_text, open_preview, preview_json

    preview = open_preview(cell, job, start, seed)
    moves = []
    if not as_json:
        print_text(head_text(preview))
    for move in preview.moves():
        moves.append((move, move_text(move)))
        if not as_json:
            print_text(moves[-1][1])
    if plot is not None:
        from docking.report.plan_page import write_plan_page

        write_plan_page(f"Plan of {preview.cell.name}", head_text(preview), moves, plot)
    if as_json:
        print_json(preview_json(preview, [move for move, _ in moves]))
    return EXIT_OK


@cli.command("dry-run")
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Seed of the simulated errors.")
@click.option("--report", type=FILE, help="Write the report to this HTML file.")
@click.option(
    "--journal", type=FILE, help="Keep the journal in this file (default: beside the report, else temporary)."
)
@click.option("--scenario", type=FILE, help="Let the faults in this TOML file happen to the simulated devices.")
@json_option
def dry_run(cell: Path, job: Path | None, seed: int, as_json: bool, **files: Path | None) -> int:
    """Dock against simulated devices in virtual time: real state machine, real drivers, real bytes.

    \b
    Example: docking dry-run sim/cells/fuselage-can.toml --seed 7 --report report.html
    Example: docking dry-run sim/cells/lab-can.toml --scenario sim/scenarios/crane-moves-in.toml
    """
    from docking import assemble

    report, journal, scenario = files["report"], files["journal"], files["scenario"]
    request = assemble.RunRequest(cell, job, seed, report, journal, language(), scenario)
    return _ended(assemble.dry_run(request, _say(as_json)), as_json)


@cli.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option("--sim", is_flag=True, help="Use simulated devices on real wires.")
@click.option("--wires", type=FILE, help="Addresses that `docking sim` wrote; without it --sim starts its own devices.")
@click.option("--step", is_flag=True, help="Ask before every move; h holds, r resumes, a aborts.")
@click.option("--seed", type=SEED, default=1, show_default=True, help="Seed of the simulated errors (with --sim).")
@click.option("--report", type=FILE, help="Write the report to this HTML file.")
@click.option(
    "--journal", type=FILE, help="Keep the journal in this file (default: beside the report, else temporary)."
)
@transcript_option
@json_option
def run(as_json: bool, step: bool, sim: bool, wires: Path | None, transcript: Path | None, **request: Any) -> int:
    """Dock over real wires, to real devices or (--sim) simulated ones.

    \b
    Example: docking run sim/cells/lab-can.toml --sim --step
    """
    from docking import assemble

    choice = wire_choice(sim, wires)
    if not step and not sim:
        raise BadArgument("run", "real devices are docked step by step; add --step", value="unattended motion")
    wanted = assemble.RunRequest(
        request["cell"], request["job"], request["seed"], request["report"], request["journal"], language()
    )
    wanted = replace(wanted, transcript=transcript)
    summary = assemble.run_on_wires(wanted, choice, _say(as_json), step=step)
    return _ended(summary, as_json)


@cli.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option("--supervisor", required=True, help="Who asks for every step; the name goes to the journal.")
@click.option("--after", type=FILE, help="Journal of the run that left the part strained: its weighing is the zero.")
@click.option("--sim", is_flag=True, help="Use simulated devices on real wires.")
@click.option("--wires", type=FILE, help="Addresses that `docking sim` wrote; without it --sim starts its own devices.")
@click.option("--seed", type=SEED, default=1, show_default=True, help="Seed of the simulated errors (with --sim).")
@click.option("--journal", type=FILE, help="Keep the journal in this file (default: temporary).")
@json_option
def relieve(as_json: bool, supervisor: str, after: Path | None, sim: bool, wires: Path | None, **request: Any) -> int:
    """Take the strain out of a part that a stop or fault has left on the balls, by small steps of single axes.

    \b
    Every step (0.05 mm at 0.1 mm/s at most) is asked for by a supervisor at the terminal; it ends when a force rises.
    Example: docking relieve cell.toml job.toml --supervisor "A. Smith" --after runs/part.journal.jsonl
    """
    from docking import assemble

    if not supervisor.strip():
        raise BadArgument("--supervisor", "who asks for the steps must have a name", value=supervisor)
    choice = wire_choice(sim, wires)
    run = assemble.RunRequest(request["cell"], request["job"], request["seed"], None, request["journal"], language())
    wanted = assemble.ReliefRequest(run, supervisor.strip(), after)
    summary = assemble.relieve(wanted, choice, _say(as_json))
    if as_json:
        print_json(summary)
    else:
        print_text(tell(language(), summary["outcome"]))
        if summary["internal_force_n"] is not None:
            print_text(tell(language(), "relief", **summary))
    return EXIT_OF_OUTCOME[summary["outcome"]]


@cli.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Seed of the simulated errors.")
@click.option("--wires", type=FILE, help="Write the addresses of the wires to this JSON file.")
@click.option("--trace", type=FILE, help="Record commanded and actual position of every axis in this CSV file, 100 Hz.")
@click.option("--scenario", type=FILE, help="Let the faults in this TOML file happen, by time (at_s) only.")
@transcript_option
def sim(cell: Path, job: Path | None, seed: int, **files: Path | None) -> int:
    """Serve the simulated devices of a cell on real wires until interrupted.

    \b
    Example: docking sim sim/cells/lab-can.toml --wires wires.json
    """
    from docking import assemble

    request = assemble.RunRequest(cell, job, seed, None, None, language(), files["scenario"], files["transcript"])
    assemble.serve(request, files["wires"], _say(False), files["trace"])
    return EXIT_OK


@cli.group()
def study() -> None:
    """Long studies over many seeds; resumable, on all cores.

    \b
    Example: docking study dock sim/cells/lab-can.toml --seeds 100
    """


@study.command("dock")
@click.argument("cells", type=FILE, nargs=-1)
@click.option("--seeds", type=COUNT, default=100, show_default=True, help="How many seeds a cell.")
@click.option(
    "--out", type=FILE, default=Path("studies"), show_default=True, help="Where results are kept and resumed."
)
@click.option("--workers", type=COUNT, help="Processes (default: one a core).")
@click.option(
    "--stress", is_flag=True, help="Stress study: all unmodelled errors at stress size, false acceptance counted."
)
@click.option("--tolerance-mm", type=float, help="With --stress: the tolerance of every feature.")
@click.option("--error", "errors", multiple=True, help="NAME=SCALE of one unmodelled error; others stay as they are.")
@json_option
def study_dock(cells: tuple[Path, ...], as_json: bool, **options: Any) -> int:
    """Dock every reference cell (or CELLS) with many seeds and count the outcomes.

    \b
    Example: docking study dock sim/cells/lab-can.toml --seeds 100
    """
    from docking.study.dock import StudyRequest, study_dock, study_text

    result = study_dock(StudyRequest(cells=cells, **options), _say(as_json))
    if as_json:
        print_json(result)
    else:
        click.echo(study_text(result))
    return EXIT_OK


cli.add_command(fit)
study.add_command(study_screening)
study.add_command(study_pose)
study.add_command(study_real)
study.add_command(study_guidance)
cli.add_command(track)
study.add_command(study_tracking)
cli.add_command(layout)
cli.add_command(guide)
cli.add_command(devices)
cli.add_command(home)
cli.add_command(single)
cli.add_command(monitor)
cli.add_command(network)


def _say(as_json: bool) -> Callable[[str], None]:
    """Where progress goes: stdout for a person, stderr when stdout carries JSON."""
    return lambda text: print_text(text, err=as_json)


def _ended(summary: dict[str, Any], as_json: bool) -> int:
    if as_json:
        print_json(summary)
    else:
        print_text(_summary_text(summary))
    return EXIT_OF_OUTCOME[summary["outcome"]]


def _summary_text(summary: dict[str, Any]) -> str:
    lines = [tell(language(), summary["outcome"])]
    if summary["max_feature_error_mm"] is not None:
        lines.append(tell(language(), "features", **summary))
    if summary["true_max_feature_error_mm"] is not None:
        lines.append(tell(language(), "truth", **summary))
    lines.append(tell(language(), "moves", **summary))
    met = summary.get("scenario", {}).get("as_expected")
    if met is not None:
        lines.append(tell(language(), "scenario_met") if met else tell(language(), "scenario_missed"))
    return "\n".join(lines)


def _error_json(error: DockingError) -> dict[str, Any]:
    alarm = error.alarm(language=language())
    body: dict[str, Any] = {
        "code": alarm.code,
        "message": alarm.message,
        "where": alarm.where,
        "value": alarm.value,
        "limit": alarm.limit,
        "remedy": alarm.remedy,
    }
    if isinstance(error, ConfigInvalid):
        body["problems"] = list(error.problems)
    return {"error": body}


def _fail(error: DockingError, as_json: bool) -> int:
    if as_json:
        print_json(_error_json(error))
    else:
        print_text(f"{error.code}: {error.text(language())}\n    -> {error.remedy(language())}", err=True)
    return error.exit_code


def call(arguments: list[str]) -> int:
    """Run one command and return its exit code; every error becomes words (or JSON), never a traceback."""
    as_json = "--json" in arguments
    try:
        result = cli.main(arguments, prog_name="docking", standalone_mode=False)
        return result if isinstance(result, int) else EXIT_OK
    except click.UsageError as error:
        where = error.ctx.command_path if error.ctx else "docking"
        if not as_json and error.ctx:
            print_text(error.ctx.get_usage(), err=True)
        return _fail(BadArgument(where, error.format_message(), value=" ".join(arguments)), as_json)
    except DockingError as error:
        return _fail(error, as_json)
    except (KeyboardInterrupt, click.Abort):
        return _fail(StoppedByOperator("docking", "interrupted from the keyboard"), as_json)
    except Exception as error:  # noqa: BLE001 - the last resort: a user gets words, the traceback goes to a file
        return _fail(_defect(error), as_json)


def _defect(error: Exception) -> Defect:
    """The program's own error in one line; the whole story is kept in a file."""
    number, name = tempfile.mkstemp(prefix="docking-defect-", suffix=".txt")
    os.close(number)
    Path(name).write_text("".join(traceback.format_exception(error)), "utf-8")
    return Defect("docking", f"{type(error).__name__}: {error} (details in {name})")


def main() -> None:
    """Entry point of the `docking` program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A terminal without the characters of a language shows their codes instead of ending the run.
            stream.reconfigure(errors="backslashreplace")
    code = call(sys.argv[1:])
    try:
        sys.stdout.flush()
    except OSError:
        # Python would try again at its end, and end with a code of its own.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)
