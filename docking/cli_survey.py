"""Commands about measuring: what a layout of targets is worth, how stations hang together."""

from __future__ import annotations

from pathlib import Path

import click

from docking.errors import EXIT_FAULT, EXIT_OK
from docking.terminal import FILE, json_option, print_json, print_text


@click.command()
@click.argument("cell", type=FILE)
@click.argument("job", type=FILE, required=False)
@click.option(
    "--part", type=click.Choice(["component", "mate"]), default="component", show_default=True, help="Whose targets."
)
@click.option("--passes", type=click.IntRange(min=1), help="Readings of every target (default: measuring.passes).")
@click.option("--candidates", type=FILE, help="CSV of places for one more target, in the part's frame.")
@click.option("--plot", type=FILE, help="Draw targets, features, station and uncertainties into this HTML file.")
@json_option
def layout(as_json: bool, plot: Path | None, **asked: object) -> int:
    """Say what the targets of a job will be worth before anything is measured.

    Expected sigma of every docking feature, weak directions of the pose, what each target is worth and how large an
    error of it would go unnoticed, and where one more target helps most. Exits with 1 when the tolerances cannot be
    proved.

    \b
    Example: docking layout sim/cells/fuselage-can.toml --plot layout.html
    """
    from docking.layout_study import LayoutRequest, layout_json, layout_text, study_layout

    study = study_layout(LayoutRequest(**asked))  # type: ignore[arg-type]
    if plot is not None:
        from docking.report.layout_page import write_layout_page

        write_layout_page(study, plot)
    if as_json:
        print_json(layout_json(study))
    else:
        print_text(layout_text(study))
    return EXIT_OK if study.provable else EXIT_FAULT


@click.command()
@click.argument("files", type=FILE, nargs=-1, required=True)
@click.option("--ers", type=FILE, help="CSV of reference points in W, with sigmas; without it W is the first station.")
@click.option(
    "--noise",
    default="tracker",
    show_default=True,
    metavar="SPEC",
    help="Where a file has no sigmas: iso:MM, tracker, total-station.",
)
@click.option("--report", type=FILE, help="Write map, residuals and tables to this HTML file.")
@json_option
def network(files: tuple[Path, ...], ers: Path | None, noise: str, report: Path | None, as_json: bool) -> int:
    """Tie several stations together over the points that they share; FILES is one point file a station.

    Gives every station's pose and every point in W with their covariances. A single bad observation is named and left
    out. Exits with 1 when stations cannot be tied together or the residuals are larger than the sigmas let expect.

    \b
    Header: name,x_mm,y_mm,z_mm[,sx_mm,sy_mm,sz_mm], in the station's own frame; passes are rows of the same name.
    Example: docking network east.csv west.csv --ers ers.csv --report network.html
    """
    from docking.network_report import network_json, network_of, network_text

    found = network_of(files, ers, noise)
    if report is not None:
        from docking.report.network_page import write_network_page

        write_network_page(found, report)
    if as_json:
        print_json(network_json(found))
    else:
        print_text(network_text(found))
    return EXIT_OK if found.consistent else EXIT_FAULT
