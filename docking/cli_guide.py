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
