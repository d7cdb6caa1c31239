"""Commands about poses: a fit to somebody's own points, and the studies of screening, fit and real data."""

from __future__ import annotations

from pathlib import Path

import click

from docking.errors import EXIT_FAULT, EXIT_OK
from docking.terminal import FILE, json_option, print_json, print_text

NOISE = "Where MEASURED has no sigmas: iso:MM, tracker:X,Y,Z, total-station:X,Y,Z (station in the measured frame, mm)."
LOCK = "Entries of the pose that are held: x,y,z,alpha,beta,gamma, each with =VALUE (mm or deg) where it is not 0."
WEIGHTS = "NAME=WEIGHT,...: the point counts as if its variance were that much smaller; before a column `weight`."
TEMPERATURE = "Nominal points grow: kelvins above their reference, and expansion, as in 2.5@23.1e-6."


@click.command()
@click.argument("nominal", type=FILE)
@click.argument("measured", type=FILE)
@click.option(
    "--method",
    type=click.Choice(["ml", "svd", "three-point", "least-squares"]),
    default="ml",
    show_default=True,
    help="ml weighs every point by its covariance; the others weigh all alike.",
)
@click.option("--noise", metavar="SPEC", help=NOISE)
@click.option("--lock", metavar="LIST", help=LOCK)
@click.option(
    "--exclude", metavar="NAMES", multiple=True, help="Points left out before anything else: P1,P2 (repeatable)."
)
@click.option("--weights", metavar="LIST", help=WEIGHTS)
@click.option("--temperature", metavar="DT_K@ALPHA_PER_K", help=TEMPERATURE)
@click.option("--triangle", metavar="A,B,C", help="Corners for --method three-point (default: the largest triangle).")
@click.option("--report", type=FILE, help="Write residual vectors, histogram and tables to this HTML file.")
@json_option
def fit(nominal: Path, measured: Path, report: Path | None, as_json: bool, **options: object) -> int:
    """Fit the pose that takes NOMINAL points into MEASURED coordinates (CSV files).

    Points that cannot be right are named with a reason and left out; where no answer is safe there is none, and the
    exit code is 1. Header of the files: name,x_mm,y_mm,z_mm[,sx_mm,sy_mm,sz_mm][,weight]; passes of a point are rows of
    the same name; (0,0,0) is a lost beam.

    \b
    Example: docking fit nominal.csv measured.csv
      docking fit nominal.csv measured.csv --noise tracker:0,-9000,800 --report fit.html
      docking fit nominal.csv measured.csv --noise iso:0.05 --lock z,alpha=0.5 --json
      docking fit nominal.csv measured.csv --temperature 2.5@23.1e-6 --exclude T3,T7
      docking fit nominal.csv measured.csv --method svd --weights T1=4,T2=0.25
      docking fit nominal.csv measured.csv --method three-point --triangle A,B,C
    """
    from docking.fit_options import FitOptions
    from docking.fit_report import fit_json, fit_text, run_fit

    if report is not None:
        from docking.report.sheet import check_drawing

        check_drawing()
    result = run_fit(nominal, measured, FitOptions(**options))  # type: ignore[arg-type]
    if report is not None:
        from docking.report.fit_page import write_fit_page

        write_fit_page(result, f"{measured.name} fitted to {nominal.name}", report)
    answer = fit_json(result)
    if as_json:
        print_json(answer)
    else:
        print_text(fit_text(answer))
    return EXIT_FAULT if answer["refused"] else EXIT_OK


@click.command("screening")
@click.option("--draws", type=click.IntRange(min=1), default=400, show_default=True, help="Sets drawn for every case.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes (default: one a core).")
@json_option
def study_screening(draws: int, workers: int | None, as_json: bool) -> int:
    """Draw sets with wrong points and count how often all of them are found and no other.

    Mis-aimed, swapped and slid points among 7, 10, 15 and 20, two noise models, and clean sets. Exits with 1 when a bar
    is missed.

    \b
    Example: docking study screening --draws 1000
    """
    from docking.study.screening import study_screening, study_text

    result = study_screening(draws, workers, lambda text: print_text(text, err=as_json))
    if as_json:
        print_json(result)
    else:
        print_text(study_text(result))
    return EXIT_OK if result["held"] else EXIT_FAULT


@click.command("pose")
@click.option(
    "--draws", type=click.IntRange(min=1), default=20000, show_default=True, help="Draws of every figure, 100 or more."
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Another seed draws other errors."
)
@click.option("--out", type=FILE, default=Path("studies/pose"), show_default=True, help="Folder of page and pictures.")
@json_option
def study_pose(draws: int, seed: int, out: Path, as_json: bool) -> int:
    """Repeat the paper's study of the pose with many draws: Table 1, Fig. 2, Fig. 3, and where least squares may start.

    Writes pose.html, pose.json and the pictures into the folder, prints every bar, and exits with 1 when one is missed.
    The full number of draws takes about two minutes; bars are wider for fewer.

    \b
    Example: docking study pose --draws 2000 --out /tmp/pose
    """
    from docking.report.sheet import check_drawing

    check_drawing()
    from docking.study.pose import study_pose, study_text
    from docking.study.pose.page import make_folder, write_study

    make_folder(out)
    result = study_pose(draws, seed, lambda text: print_text(text, err=True))
    page = write_study(result, out)
    if as_json:
        print_json(result)
    else:
        print_text(f"{study_text(result)}\n{page}")
    return EXIT_OK if result["held"] else EXIT_FAULT


@click.command("real-data")
@click.argument("folder", type=FILE)
@json_option
def study_real(folder: Path, as_json: bool) -> int:
    """Fit other people's published measurements under FOLDER and compare with what they published.

    Needs the folders faro_epochs, helmert3d and clas12_svt as their authors publish them. Exits with 1 on a difference.

    \b
    Example: docking study real-data ../shared/data
    """
    from docking.study.real_data import real_text, study_real

    result = study_real(folder)
    if as_json:
        print_json(result)
    else:
        print_text(real_text(result))
    return EXIT_OK if result["held"] else EXIT_FAULT
