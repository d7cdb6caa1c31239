"""Commands about moving bodies: a recording followed through gaps, and the study of the published claim."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from docking.errors import EXIT_FAULT, EXIT_OK, BadArgument
from docking.terminal import FILE, Range, json_option, print_json, print_text, wire_choice

CLEAR = "\x1b[H\x1b[J"
METHODS = ("published", "repaired", "ins", "ins-smoothed", "encoders", "auto")
GRADES = ("tactical", "mems", "adis16448", "consumer")


@click.command()
@click.argument("files", nargs=-1, required=True, type=FILE)
@click.option(
    "--method", type=click.Choice(METHODS), default="auto", show_default=True, help="What follows the points."
)
@click.option("--occlude", metavar="START:LENGTH", multiple=True, help="Hide all points so long, s (repeatable).")
@click.option(
    "--occlude-every", metavar="PERIOD:LENGTH", help="Hide all points in the last LENGTH s of every PERIOD s."
)
@click.option("--grade", type=click.Choice(GRADES), default="consumer", show_default=True, help="The inertial sensor.")
@click.option(
    "--sigma-mm", type=float, default=1.0, show_default=True, help="Noise of a coordinate where none is stated."
)
@click.option(
    "--creeping", is_flag=True, help="The body may move evenly and slowly: a quiet sensor is no sign of rest."
)
@click.option(
    "--joint", metavar="FIRST:SECOND:AX,AY,AZ", multiple=True, help="A hinge between two bodies (repeatable)."
)
@click.option("--plot", type=FILE, help="Draw path, error and predicted error into this HTML file.")
@click.option("--live", is_flag=True, help="FILES is one CELL file: show the pose of its part by its devices.")
@click.option("--seconds", type=Range(min=0.1), help="With --live: end after so long (default: Ctrl-C).")
@click.option("--sim", is_flag=True, help="With --live: look at simulated devices on real wires.")
@click.option("--wires", type=FILE, help="With --live --sim: addresses that `docking sim` wrote.")
@json_option
def track(files: tuple[Path, ...], plot: Path | None, live: bool, as_json: bool, **options: object) -> int:
    """Follow a body through a recording, with points hidden on purpose, and say how far off it was.

    With --live: show where the part of a CELL with [live] is, how well that is known, and what is wrong with a source.
    Reads only. With --json the last values are printed at the end.

    FILES are CSV with the headers of docs/tracking.md (inertial samples, points, attitude, encoders, nominal points),
    a BROAD .mat, or EuRoC CSV files. Several files of nominal points are several bodies, joined by --joint.

    \b
    Example: docking track trial.mat --occlude-every 10:3 --method ins
      docking track imu.csv points.csv attitude.csv --occlude 12:3 --plot track.html
      docking track imu0/data.csv state_groundtruth_estimate0/data.csv --grade adis16448 --occlude-every 10:3 --json
      docking track base.csv arm.csv points.csv base.imu.csv --joint base:arm:0,1,0 --json
      docking track sim/cells/lab-can-tracked.toml --live --sim --seconds 5
    """
    if live:
        return _live(files, options, as_json)
    _refuse_without_live(files, options)
    from docking.recordings import nominal_files
    from docking.track_report import run_track, track_text

    if plot is not None:
        from docking.report.sheet import check_drawing

        check_drawing()
    if options["joint"] or len(nominal_files(files)) > 1:
        return _bodies(files, options, plot, as_json)
    result = run_track(files, options)
    if plot is not None:
        from docking.report.track_page import write_track_page

        write_track_page(result, plot)
    if as_json:
        print_json(result.as_json())
    else:
        print_text(track_text(result))
    return EXIT_OK


def _bodies(files: tuple[Path, ...], options: dict[str, object], plot: Path | None, as_json: bool) -> int:
    from docking.track_bodies import bodies_text, run_bodies

    result = run_bodies(files, options)
    if plot is not None:
        from docking.report.track_page import write_bodies_page

        write_bodies_page(result, plot)
    if as_json:
        print_json(result.as_json())
    else:
        print_text(bodies_text(result))
    return EXIT_OK


def _live(files: tuple[Path, ...], options: dict[str, object], as_json: bool) -> int:
    from docking.assemble.live_look import live_text, look_live
    from docking.assemble.looking import LookRequest

    if len(files) != 1:
        raise BadArgument("--live", "one CELL file is needed", value=len(files), limit=1)
    wires, seconds = options["wires"], options["seconds"]
    choice = wire_choice(bool(options["sim"]), wires if isinstance(wires, Path) else None)
    screen = CLEAR if sys.stdout.isatty() else ""

    def show(values: dict[str, Any]) -> None:
        if not as_json:
            print_text(screen + live_text(values))

    request = LookRequest(files[0], choice)
    values = look_live(request, seconds if isinstance(seconds, float) else None, show)
    if as_json:
        print_json(values)
    return EXIT_OK


def _refuse_without_live(files: tuple[Path, ...], options: dict[str, object]) -> None:
    """Options of --live would be taken and have no effect; a TOML file alone is no recording."""
    if len(files) == 1 and files[0].suffix == ".toml":
        raise BadArgument(str(files[0]), "the part of a CELL is followed with --live", value="no recording")
    for name in ("seconds", "sim", "wires"):
        if options.pop(name):
            raise BadArgument(f"--{name}", "belongs to --live")


@click.command("tracking")
@click.option(
    "--runs", type=click.IntRange(min=1), default=24, show_default=True, help="Runs of four gaps for a grade."
)
@click.option("--workers", type=click.IntRange(min=1), help="Processes (default: one a core).")
@click.option("--report", type=FILE, help="Write distributions and table to this HTML file.")
@json_option
def study_tracking(runs: int, workers: int | None, report: Path | None, as_json: bool) -> int:
    """Simulate moving bodies and see what every method makes of gaps of 3 s, for four grades of inertial sensor.

    Says where the published claim (1 to 2 cm kept through 3 s) holds. Exits with 1 when a bar is missed.

    \b
    Example: docking study tracking --runs 24 --report tracking.html
    """
    from docking.study.tracking import study_text, study_tracking

    if workers is not None and not workers >= 1:
        raise BadArgument("--workers", "at least one is needed", value=workers, limit=1)
    if report is not None:
        from docking.report.sheet import check_drawing

        check_drawing()
    result = study_tracking(runs, workers, lambda text: print_text(text, err=as_json))
    if report is not None:
        from docking.report.tracking_study_page import write_tracking_study_page

        write_tracking_study_page(result, report)
    if as_json:
        print_json(result)
    else:
        print_text(study_text(result))
    return EXIT_OK if result["held"] else EXIT_FAULT
