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
_LEAST_SPAN = 0.5
_DOUBTFUL_RMS_MM = 3.0
_STRAIN_SIGMAS, _LEAST_STRAIN_MM, _HIDDEN = 3.0, 0.4, 10.0
"""Circles of a joint map further from the survey than so many sigmas (at least so many mm) strain it; a group that was
moved by 10 mm leaves 1 mm at its circles."""
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
    named = tuple(f"marker {marker} is not used: {why}" for marker, why in rejected.items())
    rms = marker_rms_mm(ar_map, layout, scanned.sightings, settings.registration)
    return replace(
        quality,
        markers_used=placed.markers_used,
        markers_rejected=rejected,
        reset_keyframes=tuple(ar_map.keyframes[row].name for row in placed.reset),
        scale=placed.scale,
        marker_rms_mm=None if isnan(rms) else rms,
        doubt_mm=_doubt_mm(placed, layout, quality.method, rms),
        reprojection_rms_px=reprojection_rms_px(ar_map),
        build_s=scanned.build_s,
        notices=(*scanned.notices, *named, *placed.notices, *_doubts(placed, layout, quality.method, rms)),
    )


def _doubt_mm(placed: Placed, layout: MarkerLayout, method: str, rms_mm: float) -> float:
    """How far off the frame may be where markers contradict each other, or the pictures contradict the survey."""
    if placed.registered is None:
        return 0.0
    return max(placed.registered.doubt_mm, _strained_mm(layout, rms_mm) if method == "joint" else 0.0)


def _strained_mm(layout: MarkerLayout, rms_mm: float) -> float:
    """What a joint map may hide: it bends to a wrong survey, and leaves a tenth of the error at the circles."""
    allowed_mm = max(_LEAST_STRAIN_MM, _STRAIN_SIGMAS * float(np.sqrt(np.mean(np.sum(layout.sigma_mm**2, axis=2)))))
    return 0.0 if isnan(rms_mm) or rms_mm <= allowed_mm else _HIDDEN * rms_mm


def _doubts(placed: Placed, layout: MarkerLayout, method: str, rms_mm: float) -> tuple[str, ...]:
    """What a person must know before trusting the frame."""
    if method == "single-aruco":
        return ()
    used = [layout.circles_mm[k] for k, marker in enumerate(layout.ids) if marker in placed.markers_used]
    known = np.concatenate(used) if used else np.zeros((1, 3))
    cameras = np.array([frame.X_WC.t_mm for frame in placed.ar_map.keyframes])
    span, size = (float(np.linalg.norm(np.ptp(points, axis=0))) for points in (known, cameras))
    doubts = []
    apart_mm, strained_mm = 0.0 if placed.registered is None else placed.registered.doubt_mm, 0.0
    if method == "joint":
        strained_mm = _strained_mm(layout, rms_mm)
    if strained_mm > 0.0:
        doubts.append(
            f"the circles lie {rms_mm:.2f} mm rms from their survey, more than its sigmas allow: "
            "some have moved together, or the survey is worse than it says"
        )
    if apart_mm > 0.0:
        doubts.append(
            f"markers that agree with each other lie {apart_mm:.0f} mm from where the others put them: moved together, "
            "or the map is bent (calibration?). Scan again, or take the moved ones out of the survey"
        )
    if span < _LEAST_SPAN * size:
        doubts.append(f"the markers span {span:.0f} mm of a scan of {size:.0f} mm: far from them the frame is a guess")
    if not (rms_mm <= _DOUBTFUL_RMS_MM):
        how = "cannot be triangulated" if isnan(rms_mm) else f"lie {rms_mm:.1f} mm rms from their survey"
        doubts.append(f"the circles {how} in the finished map: do not trust it")
    return tuple(doubts)


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


def map_text(ar_map: ArMap) -> str:
    """The same for a person."""
    quality, rms = ar_map.quality, ar_map.quality.marker_rms_mm
    lines = [
        f"{len(ar_map.keyframes)} key-frames, {len(ar_map.points_mm)} points, method {quality.method}",
        f"markers used: {', '.join(str(marker) for marker in quality.markers_used)}",
        f"circles against their survey: {'not seen' if rms is None else f'{rms:.2f} mm rms'}",
        f"reprojection {quality.reprojection_rms_px:.2f} px rms; scan {quality.build_s:.1f} s, "
        f"optimisation {quality.optimise_s:.2f} s",
    ]
    if quality.method == "published":
        lines.insert(2, f"key-frames reset from circles: {', '.join(quality.reset_keyframes) or 'none'}")
    return "\n".join([*lines, *(f"NOTE: {notice}" for notice in quality.notices)])
