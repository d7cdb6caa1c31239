"""Commands of the guidance: markers, the map made from a scan, and where an image was taken in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from docking.errors import EXIT_OK, EXIT_OUT_OF_TOLERANCE, BadArgument
from docking.terminal import FILE, Range, json_option, language, print_json, print_text


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


@guide.command("build-map")
@click.argument("source", type=FILE)
@click.option("--camera", type=FILE, required=True, help="Calibration of the camera (TOML).")
@click.option("--markers", "layout", type=FILE, required=True, help="Measured circle centres in the cell (CSV).")
@click.option("--out", type=FILE, required=True, help="Folder of the map.")
@click.option(
    "--method",
    type=click.Choice(["published", "joint", "single-aruco"]),
    default="joint",
    show_default=True,
    help="joint: map, circles and camera in one adjustment; published: [Huo]; single-aruco: what the paper beats.",
)
@click.option(
    "--builder",
    type=click.Choice(["own", "colmap", "tum"]),
    default="own",
    show_default=True,
    help="own: from the images alone; colmap, tum: with the poses that another program found (--model).",
)
@click.option("--model", type=FILE, help="Folder of a COLMAP model (text or binary), or a TUM trajectory file.")
@click.option("--fps", type=Range(min=0.01), default=10.0, show_default=True, help="Images of a folder a s.")
@click.option(
    "--gate", metavar="MM,DEG,CIRCLES", default="500,15,4", show_default=True, help="Markers taken (published)."
)
@click.option("--hold-camera", is_flag=True, help="joint: take the calibration as exact.")
@json_option
def build_map_command(source: Path, out: Path, gate: str, hold_camera: bool, as_json: bool, **options: Any) -> int:
    """Build the map of the cell from a scan: a folder of images, or a video, that shows the markers.

    Says which markers set the frame, which disagree with their survey, and which key-frames were reset from circles.
    Exits with 3 when the published method finds no key-frame to reset: the map is then placed by the similarity alone.

    \b
    Example: docking guide build-map scan/ --camera camera.toml --markers markers.csv --out map/
      docking guide build-map scan.mp4 --camera camera.toml --markers markers.csv --out map/ --method published --json
      docking guide build-map scan/ --camera c.toml --markers m.csv --out map/ --builder tum --model slam.tum --fps 30
    """
    from docking.guidance.map_build import BuildRequest, build_map, map_json, map_text
    from docking.guidance.map_files import save_map
    from docking.guidance.map_methods import method_settings

    settings = method_settings(gate, hold_camera)
    request = BuildRequest(source, options.pop("camera"), options.pop("layout"), settings=settings, **options)
    ar_map = build_map(request)
    save_map(ar_map, out)
    if as_json:
        print_json(map_json(ar_map))
    else:
        print_text(map_text(ar_map))
    fallen_back = ar_map.quality.method == "published" and not ar_map.quality.reset_keyframes
    return EXIT_OUT_OF_TOLERANCE if fallen_back else EXIT_OK


@guide.command("export")
@click.argument("mapdir", type=FILE)
@click.option("--colmap", type=FILE, help="Write a COLMAP model (text) into this folder.")
@click.option("--tum", type=FILE, help="Write the poses of the key-frames to this trajectory file (TUM format, m).")
@json_option
def export(mapdir: Path, colmap: Path | None, tum: Path | None, as_json: bool) -> int:
    """Write a map for other programs.

    \b
    Example: docking guide export map/ --colmap model/ --tum keyframes.tum
    """
    from docking.guidance.colmap_files import write_model
    from docking.guidance.map_files import load_map
    from docking.guidance.trajectory import Trajectory, write_tum

    if colmap is None and tum is None:
        raise BadArgument("export", "say where to: --colmap or --tum", value=str(mapdir))
    ar_map = load_map(mapdir)
    if colmap is not None:
        write_model(ar_map, colmap)
    if tum is not None:
        write_tum(Trajectory.of([(frame.t_s, frame.X_WC) for frame in ar_map.keyframes]), tum)
    files = [str(path) for path in (colmap, tum) if path is not None]
    if as_json:
        print_json({"keyframes": len(ar_map.keyframes), "points": len(ar_map.points_mm), "files": files})
    else:
        print_text("\n".join(files))
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


@guide.command("overlay")
@click.argument("mapdir", type=FILE)
@click.argument("pictures", type=FILE)
@click.option("--journal", type=FILE, required=True, help="Journal of the run whose state is drawn.")
@click.option("--out", type=FILE, required=True, help="FILE.png for one picture, FILE.mp4 for a folder or video.")
@click.option("--job", type=FILE, help="The JOB file of the run, where it has moved since.")
@click.option("--camera", type=FILE, help="Calibration of another camera than that of the map (TOML).")
@click.option("--limit-mm", type=float, default=10.0, show_default=True, help="Largest predicted error that is drawn.")
@click.option("--fps", type=Range(min=0.01), default=10.0, show_default=True, help="Pictures of a folder a s.")
@json_option
def overlay(mapdir: Path, pictures: Path, as_json: bool, **options: Any) -> int:
    """Draw what a run's journal proves into pictures of the cell: component, targets, deviations, next move, next part.

    Refuses where the camera is not localised, or so uncertainly that the drawing could be off by more than the limit.

    \b
    Example: docking guide overlay map/ photo.jpg --journal run.journal.jsonl --out seen.png
      docking guide overlay map/ walk.mp4 --journal run.journal.jsonl --out seen.mp4
    """
    from docking.guidance.guide import Guide
    from docking.guidance.input_files import read_camera
    from docking.guide_overlay import OverlayRequest, write_overlay
    from docking.guide_scene import open_source

    camera = None if options["camera"] is None else read_camera(options["camera"])
    source = open_source(options["journal"], options["job"])
    wanted = (options["out"], options["limit_mm"], language(), options["fps"])
    result = write_overlay(OverlayRequest(Guide(mapdir, camera), pictures, source, *wanted))
    if as_json:
        print_json(result)
    else:
        print_text(f"{result['out']}: {result['drawn']} of {result['frames']} pictures drawn")
    return EXIT_OK


@guide.command("steps")
@click.argument("journal", type=FILE)
@click.option("--job", type=FILE, help="The JOB file of the run, where it has moved since.")
@click.option("--done", metavar="STEP", help="This step is done: written into the journal.")
@click.option("--undo", metavar="STEP", help="This step is not done after all: written into the journal.")
@click.option("--by", default="", help="Who says so.")
@json_option
def steps(journal: Path, job: Path | None, done: str | None, undo: str | None, by: str, as_json: bool) -> int:
    """List the work instructions of a run's job, and tick them off.

    \b
    Example: docking guide steps run.journal.jsonl --done fit-bracket --by "A. Smith"
    """
    from docking.guide_scene import open_source, step_states, tick

    if done is not None and undo is not None:
        raise BadArgument("--done", "one of --done and --undo at a time", value=done)
    named = done if done is not None else undo
    if named is not None:
        tick(journal, open_source(journal, job), named, by, done=done is not None)
    states = step_states(open_source(journal, job))
    if as_json:
        rows = [{"step": s.name, "order": s.order, "state": state, "tool": s.tool} for s, state in states]
        print_json({"steps": [{**row, "text": s.text(language())} for row, (s, _) in zip(rows, states, strict=True)]})
    else:
        tools = [f" [{s.tool}]" if s.tool else "" for s, _ in states]
        rows_text = zip(states, tools, strict=True)
        print_text("\n".join(f"{state:5} {s.order} {s.name}: {s.text(language())}{t}" for (s, state), t in rows_text))
    return EXIT_OK


@click.command("guidance")
@click.option("--scenes", type=click.IntRange(min=1), default=10, show_default=True, help="Rendered trajectories.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes (default: one a core).")
@click.option("--report", type=FILE, help="Write the table to this HTML file.")
@json_option
def study_guidance(scenes: int, workers: int | None, report: Path | None, as_json: bool) -> int:
    """Map rendered scans by every method and localise a walk in each: the published table, side by side.

    \b
    Example: docking study guidance --report guidance.html
    """
    from docking.study.guidance import GuidanceStudy, study_guidance, study_text

    result = study_guidance(GuidanceStudy(scenes, workers), lambda text: print_text(text, err=as_json))
    if report is not None:
        from docking.report.guidance_page import write_guidance_page

        write_guidance_page(result, study_text(result), report)
    if as_json:
        print_json(result)
    else:
        print_text(study_text(result))
    return EXIT_OK
