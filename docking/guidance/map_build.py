"""From a scan to a map in the cell: what `docking guide build-map` and a later web service call."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import isnan
from pathlib import Path
from typing import Any, Literal

import numpy as np

from docking.errors import BadArgument
from docking.guidance.colmap_files import read_model
from docking.guidance.detection import MarkerDetector, MarkerSighting
from docking.guidance.images import FOLDER_FPS, Picture, pictures
from docking.guidance.input_files import read_camera, read_layout
from docking.guidance.map_builder import BuilderSettings, MapBuilder
from docking.guidance.map_doubts import doubts
from docking.guidance.map_methods import (
    MethodSettings,
    Placed,
    joint,
    marker_rms_mm,
    published,
    reprojection_rms_px,
    single_aruco,
)
from docking.guidance.marker_survey import Sightings, refuse_bent
from docking.guidance.posed_map import build_from_poses, poses_by_time, thinned
from docking.guidance.trajectory import read_tum
from docking.guidance.types import ArMap, Camera, MapQuality, MarkerLayout
from docking.types import Pose

Method = Literal["published", "joint", "single-aruco"]
Builder = Literal["own", "colmap", "tum"]
METHODS: tuple[Method, ...] = ("published", "joint", "single-aruco")
BUILDERS: tuple[Builder, ...] = ("own", "colmap", "tum")
_PLACE = {"published": published, "joint": joint, "single-aruco": single_aruco}


@dataclass(frozen=True)
class BuildRequest:
    """`source` folder of images or video; `model` the COLMAP folder or TUM file of the importing builders."""

    source: Path
    camera: Path
    markers: Path
    method: Method = "joint"
    builder: Builder = "own"
    model: Path | None = None
    fps: float = FOLDER_FPS
    settings: MethodSettings = field(default_factory=MethodSettings)
    building: BuilderSettings = field(default_factory=BuilderSettings)


@dataclass(frozen=True, eq=False)
class Scanned:
    """A free map, the markers seen in each of its key-frames, and what it took."""

    free: ArMap
    sightings: Sightings
    build_s: float
    notices: tuple[str, ...] = ()


def build_map(request: BuildRequest) -> ArMap:
    """The map in the cell's frame, with its quality. Raises coded errors; falls back only with a notice."""
    layout = read_layout(request.markers)
    scanned = scan(request, layout)
    return place(scanned, layout, request.method, request.settings)


def scan(request: BuildRequest, layout: MarkerLayout) -> Scanned:
    """The free map of a scan and the markers in its key-frames; one scan serves all methods."""
    begun = time.perf_counter()
    camera, posed = _opened(request)
    detector = MarkerDetector.of(layout, camera)
    sightings: list[tuple[MarkerSighting, ...]] = []

    def look(picture: Picture) -> None:
        sightings.append(tuple(detector.detect(picture.image)))

    notices: tuple[str, ...] = ()
    if posed is None:
        builder = MapBuilder(camera, request.building, look)
        free = builder.build(pictures(request.source, request.fps))
        if builder.skipped:
            notices = (f"{builder.skipped} images could not be tracked and are not in the map",)
    else:
        free = build_from_poses(camera, posed, request.building, look)
    return Scanned(free, tuple(sightings), time.perf_counter() - begun, notices)


def _opened(request: BuildRequest) -> tuple[Camera, Iterator[tuple[Picture, Pose]] | None]:
    """The camera, and the images with poses of an importing builder."""
    camera = read_camera(request.camera)
    if request.builder == "own":
        return camera, None
    if request.model is None:
        raise BadArgument("--model", f"the builder {request.builder} needs the poses of the other program", value="")
    if request.builder == "colmap":
        model = read_model(request.model)
        return model.camera, _named(request, model.poses)
    return camera, _timed(request, request.model)


def _named(request: BuildRequest, poses: dict[str, Pose]) -> Iterator[tuple[Picture, Pose]]:
    names = sorted(poses)
    wanted = {names[row] for row in thinned(list(range(len(names))))}
    for picture in pictures(request.source, request.fps):
        if picture.name in wanted:
            yield picture, poses[picture.name]


def _timed(request: BuildRequest, path: Path) -> Iterator[tuple[Picture, Pose]]:
    # Read twice rather than kept: a long video does not fit into memory.
    found = poses_by_time(read_tum(path), [picture.t_s for picture in pictures(request.source, request.fps)])
    wanted = set(thinned(sorted(found)))
    for row, picture in enumerate(pictures(request.source, request.fps)):
        if row in wanted:
            yield picture, found[row]


def place(scanned: Scanned, layout: MarkerLayout, method: Method, settings: MethodSettings) -> ArMap:
    """The free map put into the cell by one method."""
    if method != "single-aruco":
        refuse_bent(scanned.free, layout, scanned.sightings, settings.registration)
    begun = time.perf_counter()
    placed = _PLACE[method](scanned.free, layout, scanned.sightings, settings)
    took = time.perf_counter() - begun
    known = _trusted(layout, placed)
    quality = _quality(scanned, placed, known, MapQuality(method=method, optimise_s=took), settings)
    return replace(placed.ar_map, layout=known, quality=quality)


def _trusted(layout: MarkerLayout, placed: Placed) -> MarkerLayout:
    """The layout without the markers that do not agree: localisation must not use them either."""
    rejected = placed.registered.rejected if placed.registered is not None else {}
    rows = [k for k, marker in enumerate(layout.ids) if marker not in rejected]
    ids = tuple(layout.ids[k] for k in rows)
    return replace(layout, ids=ids, circles_mm=layout.circles_mm[rows], sigma_mm=layout.sigma_mm[rows])


def _quality(
    scanned: Scanned, placed: Placed, layout: MarkerLayout, quality: MapQuality, settings: MethodSettings
) -> MapQuality:
    registered, ar_map = placed.registered, placed.ar_map
    rejected = registered.rejected if registered is not None else {}
    named = tuple(_named_marker(marker, why, placed) for marker, why in rejected.items())
    rms = marker_rms_mm(ar_map, layout, scanned.sightings, settings.registration)
    found = doubts(placed, scanned.free.camera, layout, settings, rms)
    return replace(
        quality,
        markers_used=placed.markers_used,
        markers_rejected=rejected,
        reset_keyframes=tuple(ar_map.keyframes[row].name for row in placed.reset),
        scale=placed.scale,
        marker_rms_mm=None if isnan(rms) else rms,
        doubt_mm=max((doubt.mm for doubt in found), default=0.0),
        reprojection_rms_px=reprojection_rms_px(ar_map),
        build_s=scanned.build_s,
        notices=(*scanned.notices, *named, *placed.notices, *(doubt.words for doubt in found)),
    )


def _named_marker(marker: int, why: str, placed: Placed) -> str:
    """A marker that disagrees as a whole is not used at all, one with a wrong circle by its others."""
    if marker in placed.markers_used:
        return f"marker {marker} is used only by its other circles, and not to localise by: {why}"
    return f"marker {marker} is not used: {why}"


def map_json(ar_map: ArMap) -> dict[str, Any]:
    """What `build-map --json` prints."""
    quality = ar_map.quality
    return {
        "method": quality.method,
        "keyframes": len(ar_map.keyframes),
        "points": len(ar_map.points_mm),
        "observations": len(ar_map.observations()[0]),
        "markers_used": list(quality.markers_used),
        "markers_rejected": {str(marker): why for marker, why in quality.markers_rejected.items()},
        "reset_keyframes": list(quality.reset_keyframes),
        "scale": quality.scale,
        "marker_rms_mm": quality.marker_rms_mm,
        "doubt_mm": quality.doubt_mm,
        "reprojection_rms_px": quality.reprojection_rms_px,
        "build_s": quality.build_s,
        "optimise_s": quality.optimise_s,
        "camera": {key: getattr(ar_map.camera, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2")},
        "notices": list(quality.notices),
    }


def _whence(ar_map: ArMap) -> str:
    """Where the key-frames were taken: all that shows a survey with two columns exchanged, if the markers are flat."""
    at = np.array([frame.X_WC.t_mm for frame in ar_map.keyframes])
    return (
        ", ".join(f"{n} {low:.0f} to {high:.0f}" for n, low, high in zip("xyz", at.min(0), at.max(0), strict=True))
        + " mm"
    )


def map_text(ar_map: ArMap) -> str:
    """The same for a person."""
    quality, rms = ar_map.quality, ar_map.quality.marker_rms_mm
    lines = [
        f"{len(ar_map.keyframes)} key-frames, {len(ar_map.points_mm)} points, method {quality.method}",
        f"markers used: {', '.join(str(marker) for marker in quality.markers_used)}",
        f"circles against their survey: {'not seen' if rms is None else f'{rms:.2f} mm rms'}",
        f"reprojection {quality.reprojection_rms_px:.2f} px rms; scan {quality.build_s:.1f} s, "
        f"optimisation {quality.optimise_s:.2f} s",
        f"scanned from {_whence(ar_map)} of the cell: was the camera there?",
    ]
    if quality.method == "published":
        lines.insert(2, f"key-frames reset from circles: {', '.join(quality.reset_keyframes) or 'none'}")
    return "\n".join([*lines, *(f"NOTE: {notice}" for notice in quality.notices)])
