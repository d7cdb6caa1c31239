"""Commands of the guidance: markers, the map made from a scan, and where an image was taken in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from docking.errors import EXIT_OK
from docking.terminal import FILE, json_option, print_json, print_text


@click.group()
def guide() -> None:
    """The operator's camera in the cell: print markers, build a map from a scan, localise images in it.

    Needs the extra: pip install '.[guidance]'

    \b
    Example: docking guide build-map scan/ --camera camera.toml --markers markers.csv --out map/
    """


@guide.command("markers")
@click.option("--out", type=FILE, required=True, help="FILE.pdf or FILE.svg; with several pages FILE-2.svg and so on.")
@click.option("--ids", metavar="LIST", default="0-8", show_default=True, help="Markers to draw, as in 0-3,7.")
@click.option("--dictionary", default="DICT_4X4_50", show_default=True, help="OpenCV's name of the ArUco dictionary.")
@click.option("--side-mm", type=float, default=50.0, show_default=True, help="Side of the black square.")
@click.option("--radius-mm", type=float, default=9.0, show_default=True, help="Radius of the circles.")
@click.option("--offset-mm", type=float, default=42.0, show_default=True, help="Circles at (+-offset, +-offset).")
@click.option("--page", type=click.Choice(["A4", "A3", "letter"]), default="A4", show_default=True)
@json_option
def markers(out: Path, page: str, as_json: bool, **marker: Any) -> int:
    """Draw markers to print at their true size: an ArUco square with a circle in the direction of each corner.

    Print without scaling and measure the bar on the sheet before using them.

    \b
    Example: docking guide markers --out markers.pdf --ids 0-8
    """
    from docking.guidance.marker_sheet import MarkerDrawing, read_ids, write_sheets

    drawing = MarkerDrawing(marker["dictionary"], marker["side_mm"], marker["radius_mm"], marker["offset_mm"])
    files, ids = write_sheets(out, read_ids(marker["ids"]), drawing, page), read_ids(marker["ids"])
    if as_json:
        print_json({"files": [str(file) for file in files], "markers": list(ids)})
    else:
        print_text("\n".join(f"{file}" for file in files))
    return EXIT_OK


@guide.command("localise")
@click.argument("mapdir", type=FILE)
@click.argument("source", type=FILE)
@click.option("--tum", type=FILE, help="Write the poses to this trajectory file (TUM format, m).")
@click.option("--camera", type=FILE, help="Calibration of another camera than that of the map (TOML).")
@click.option(
    "--source",
    "origin",
    type=click.Choice(["auto", "map"]),
    default="auto",
    show_default=True,
    help="map: never by markers in view; auto: by them where the map does not help.",
)
@click.option("--extend", is_flag=True, help="Let the map grow while tracking (default: read-only).")
@click.option("--save", type=FILE, help="With --extend: write the map that has grown into this folder.")
@json_option
def localise(mapdir: Path, source: Path, extend: bool, as_json: bool, origin: str, **files: Path | None) -> int:
    """Say where in the cell an image, every image of a folder or of a video was taken, or why that is not known.

    \b
    Example: docking guide localise map/ photo.jpg
      docking guide localise map/ walk.mp4 --tum walk.tum --json
    """
    from docking.guidance.batch import batch_json, batch_text, localise_all
    from docking.guidance.guide import Guide
    from docking.guidance.input_files import read_camera
    from docking.guidance.localiser import LocaliseSettings
    from docking.guidance.map_files import save_map
    from docking.guidance.trajectory import write_tum

    camera = None if files["camera"] is None else read_camera(files["camera"])
    opened = Guide(mapdir, camera, LocaliseSettings(by_markers=origin == "auto"))
    batch = localise_all(opened.stream(read_only=not extend), source)
    if files["tum"] is not None:
        write_tum(batch.trajectory(), files["tum"])
    if extend and files["save"] is not None:
        save_map(batch.ar_map, files["save"])
    if as_json:
        print_json(batch_json(batch))
    else:
        print_text(batch_text(batch))
    return EXIT_OK


@guide.command("evaluate")
@click.argument("trajectory", type=FILE)
@click.option("--truth", type=FILE, required=True, help="The true trajectory (TUM format, m).")
@click.option(
    "--align",
    type=click.Choice(["none", "se3", "sim3"]),
    default="none",
    show_default=True,
    help="Fit a rigid motion or a similarity first; the unaligned figures are given all the same.",
)
@json_option
def evaluate(trajectory: Path, truth: Path, align: str, as_json: bool) -> int:
    """Judge a trajectory by its absolute error (ATE): distances to the true positions at the same moments.

    The unaligned error is what a user of the cell meets: errors of frame and scale count. With --json the figures are
    those of --align, and `unaligned` holds the others.

    \b
    Example: docking guide evaluate walk.tum --truth truth.tum --align se3
    """
    from typing import cast

    from docking.guidance.trajectory import Alignment, error_json, error_text, read_tum, trajectory_error

    judged, true = read_tum(trajectory), read_tum(truth)
    errors = [trajectory_error(judged, true)]
    if align != "none":
        errors.append(trajectory_error(judged, true, cast(Alignment, align)))
    if as_json:
        print_json({**error_json(errors[-1]), "unaligned": error_json(errors[0])})
    else:
        print_text("\n".join(error_text(error) for error in errors))
    return EXIT_OK
