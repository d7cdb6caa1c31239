"""Three ways to put a free map into the cell: as published, jointly with the survey, from one ArUco marker.

published    [Huo] steps 2 to 6; the key-frames reset from circles are held, all points stay free: the observations of a
             held key-frame are the exactly marginalised prior that the paper asks for.
joint        one adjustment in which the circles are points with the survey as prior; the calibration may move within
             its own sigma.
single-aruco what the paper compares with: frame from the corners of one marker, scale from two views of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument, MarkersTooFew, NotLocalised
from docking.guidance.bundle import Bundle, adjust
from docking.guidance.detection import SIGNS, Gate, MarkerSighting, hull_share, planar_poses
from docking.guidance.features import SCALE
from docking.guidance.marker_survey import (
    Registered,
    RegistrationSettings,
    Sightings,
    accepted,
    in_cell,
    register,
    triangulated,
    views,
)
from docking.guidance.pose_only import Sights, refine
from docking.guidance.similarity import Similarity, closed_form
from docking.guidance.triangulation import triangulate
from docking.guidance.types import ArMap, MarkerLayout
from docking.types import Array, Pose

HUBER_SIGMAS = 2.0
CIRCLE_SIGMA_PX = 0.1
_OUTLIER_SIGMAS = 4.0
_RESET_PARALLAX_DEG = 2.0
_FEW_RESETS = 4
_LEAST_SCALE_BASE = 0.05
"""Distance of the two views that give the scale, against their distance from the marker."""

CAMERA_SIGMA = (0.003, 3.0, 3.0, 0.01, 0.01)
"""How wrong a calibration may be: log f, cx px, cy px, k1, k2."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A map in the cell and what was found out on the way: `scale` mm for one unit of the free map."""

    method: str
    ar_map: ArMap
    registered: Registered | None
    scale: float
    markers_used: tuple[int, ...]
    reset: tuple[int, ...] = ()
    notices: tuple[str, ...] = ()


def _as_published(
    ar_map: ArMap, registered: Registered, reset: tuple[int, ...] = (), notices: tuple[str, ...] = ()
) -> Placed:
    return Placed("published", ar_map, registered, registered.similarity.scale, registered.markers, reset, notices)


@dataclass(frozen=True)
class MethodSettings:
    """`camera_sigma` None holds the calibration."""

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    camera_sigma: tuple[float, ...] | None = CAMERA_SIGMA
    circle_sigma_px: float = CIRCLE_SIGMA_PX
    iterations: int = 10


def method_settings(gate: str, hold_camera: bool = False) -> MethodSettings:
    """Settings of a gate `MM,DEG,CIRCLES`. Raises BadArgument."""
    try:
        distance_mm, angle_deg, circles = (float(text) for text in gate.split(","))
    except ValueError as error:
        raise BadArgument("--gate", "three numbers MM,DEG,CIRCLES", value=gate) from error
    if not (distance_mm > 0.0 and 0.0 < angle_deg <= 90.0 and circles in (1.0, 2.0, 3.0, 4.0)):
        raise BadArgument("--gate", "a distance > 0, an angle up to 90 deg, 1 to 4 circles", value=gate)
    rules = RegistrationSettings(gate=Gate(distance_mm, angle_deg, int(circles)))
    return MethodSettings(rules, None if hold_camera else CAMERA_SIGMA)


def published(free: ArMap, layout: MarkerLayout, sightings: Sightings, settings: MethodSettings) -> Placed:
    """[Huo] steps 2 to 6. Without a qualifying key-frame the similarity alone is the answer, and a notice says so."""
    rules = settings.registration
    passed = accepted(sightings, rules.gate)
    registered = register(free, layout, passed, rules)
    placed = in_cell(free, registered.similarity)
    used = _of_markers(passed, registered)
    reset = _reset_poses(placed, layout, used, rules)
    if not reset:
        notice = "no key-frame qualifies for a reset (two markers, a quarter of the image): similarity only"
        return _as_published(placed, registered, (), (notice,))
    frames = tuple(replace(f, X_WC=reset.get(i, f.X_WC)) for i, f in enumerate(placed.keyframes))
    again = _retriangulated(replace(placed, keyframes=frames), sorted(reset))
    few = f"only {len(reset)} key-frames qualify for a reset: away from them the map stays as it drifted"
    notices = (few,) if len(reset) < _FEW_RESETS else ()
    return _as_published(_adjusted(again, sorted(reset), settings), registered, tuple(sorted(reset)), notices)


def joint(free: ArMap, layout: MarkerLayout, sightings: Sightings, settings: MethodSettings) -> Placed:
    """One adjustment of key-frames, points, circles and (within its sigma) the camera."""
    rules = settings.registration
    passed = accepted(sightings, rules.wide_gate)
    registered = register(free, layout, passed, rules)
    placed = in_cell(free, registered.similarity)
    bundle = _bundle(placed, np.zeros(len(placed.keyframes), bool))
    bundle = _with_circles(bundle, layout, passed, registered, settings)
    moved = _moved(placed, bundle, settings)
    return Placed("joint", moved, registered, registered.similarity.scale, registered.markers)


def single_aruco(free: ArMap, layout: MarkerLayout, sightings: Sightings, settings: MethodSettings) -> Placed:
    """The start that the paper compares with: the corners of one marker give frame and scale. No circle is used."""
    del settings
    poses = [
        [(s.marker_id, _corner_pose(s, layout, free)) for s in frame if layout.index(s.marker_id) is not None]
        for frame in sightings
    ]
    first = next(((row, marker, X) for row, frame in enumerate(poses) for marker, X in frame if X is not None), None)
    if first is None:
        raise MarkersTooFew("markers", "no marker of the layout in any key-frame", value=0, limit=1)
    row, marker, X_CM = first
    others = [(i, X) for i, frame in enumerate(poses) for m, X in frame if m == marker and i > row and X is not None]
    scale = _scale(free, row, X_CM, others)
    index = layout.index(marker)
    assert index is not None
    square = np.c_[SIGNS * layout.circle_offset_mm, np.zeros(4)]
    plane = closed_form(square, layout.circles_mm[index])
    X_WM = Pose(plane.R, plane.t_mm)
    X_WC = X_WM @ X_CM.inverse()
    camera = free.keyframes[row].X_WC
    R = X_WC.R @ camera.R.T
    similarity = Similarity(scale, R, X_WC.t_mm - scale * R @ camera.t_mm)
    notice = f"frame and scale from marker {marker} alone, first seen in {free.keyframes[row].name}"
    return Placed("single-aruco", in_cell(free, similarity), None, scale, (marker,), (), (notice,))


def _corner_pose(sighting: MarkerSighting, layout: MarkerLayout, free: ArMap) -> Pose | None:
    poses, _ = planar_poses(SIGNS * layout.side_mm / 2.0, sighting.corners_px, free.camera)
    return poses[0] if poses else None


def _scale(free: ArMap, row: int, X_CM: Pose, others: list[tuple[int, Pose]]) -> float:
    """mm for one unit of the map, from two poses of the camera about one marker: the first two far enough apart."""
    here = X_CM.inverse().t_mm
    for other, X in others:
        moved = float(np.linalg.norm(X.inverse().t_mm - here))
        apart = float(np.linalg.norm(free.keyframes[other].X_WC.t_mm - free.keyframes[row].X_WC.t_mm))
        if moved > _LEAST_SCALE_BASE * float(np.linalg.norm(here)) and apart > 0.0:
            return moved / apart
    raise MarkersTooFew("markers", "one marker must be seen from two places to give the scale", value=1, limit=2)


def _of_markers(sightings: Sightings, registered: Registered) -> Sightings:
    """Without the circles that do not agree: their pixels become NaN."""
    good = set(zip(registered.circles.marker.tolist(), registered.circles.circle.tolist(), strict=True))

    def cleaned(s: MarkerSighting) -> MarkerSighting:
        keep = np.array([(s.marker_id, c) in good for c in range(4)])
        return replace(s, circles_px=np.where(keep[:, None], s.circles_px, np.nan))

    return tuple(tuple(c for c in map(cleaned, frame) if c.seen) for frame in sightings)


def _reset_poses(
    placed: ArMap, layout: MarkerLayout, sightings: Sightings, rules: RegistrationSettings
) -> dict[int, Pose]:
    """Step 4: poses from circles alone of key-frames with two markers and a hull of a quarter of the image.

    The start is the pose in the map: of the two poses that a plane allows it is on the side of the right one.
    """
    reset = {}
    for row, frame in enumerate(sightings):
        if len(frame) < 2 or hull_share(frame, placed.camera) < rules.hull_share:
            continue
        seen = [(s, c) for s in frame for c in range(4) if np.isfinite(s.circles_px[c, 0])]
        rows = [layout.index(s.marker_id) for s, _ in seen]
        points = np.array([layout.circles_mm[i, c] for i, (_, c) in zip(rows, seen, strict=True) if i is not None])
        pixels = np.array([s.circles_px[c] for s, c in seen])
        try:
            fit = refine(placed.camera, placed.keyframes[row].X_WC, Sights(points, pixels, np.ones(len(points))))
        except NotLocalised:
            continue
        reset[row] = fit.X_WC
    return reset


def _retriangulated(placed: ArMap, reset: list[int]) -> ArMap:
    """Step 5: points that two reset key-frames or more see, where the rays cross well."""
    owner, point, pixels = placed.observations()
    mine = np.isin(owner, reset)
    owner, point, pixels = owner[mine], point[mine], pixels[mine]
    seen, slot, counts = np.unique(point, return_inverse=True, return_counts=True)
    X = [frame.X_WC.inverse() for frame in placed.keyframes]
    R, t = np.array([x.R for x in X]), np.array([x.t_mm for x in X])
    rays = placed.camera.undistort(pixels)
    found = triangulate(R[owner], t[owner], rays, slot, len(seen))
    error = np.linalg.norm(_projected(placed, R[owner], t[owner], found[slot]) - pixels, axis=1)
    worst = np.zeros(len(seen))
    np.maximum.at(worst, slot, np.nan_to_num(error, nan=np.inf))
    centres = np.array([placed.keyframes[i].X_WC.t_mm for i in owner])
    good = (counts >= 2) & (worst < _OUTLIER_SIGMAS) & (_parallax(centres, found, slot) > _RESET_PARALLAX_DEG)
    points = placed.points_mm.copy()
    points[seen[good]] = found[good]
    return replace(placed, points_mm=points)


def _projected(placed: ArMap, R: Array, t: Array, points: Array) -> Array:
    return placed.camera.project(np.einsum("oij,oj->oi", R, points) + t)


def _parallax(centres: Array, points: Array, slot: NDArray[np.integer]) -> Array:
    """Widest angle (n,) at a point between the first of its rays and any other."""
    ray = centres - points[slot]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    _, first = np.unique(slot, return_index=True)
    cos = np.einsum("oi,oi->o", ray, ray[first][slot])
    least = np.ones(len(points))
    np.minimum.at(least, slot, np.nan_to_num(cos, nan=1.0))
    result: Array = np.degrees(np.arccos(np.clip(least, -1.0, 1.0)))
    return result


def _adjusted(placed: ArMap, held: list[int], settings: MethodSettings) -> ArMap:
    """Step 6 with the reset key-frames held."""
    mask = np.zeros(len(placed.keyframes), bool)
    mask[held] = True
    return _moved(placed, _bundle(placed, mask), replace(settings, camera_sigma=None))


def _bundle(placed: ArMap, held: NDArray[np.bool_]) -> Bundle:
    owner, point, pixels = placed.observations()
    X = [frame.X_WC.inverse() for frame in placed.keyframes]
    sigma = SCALE ** np.concatenate([f.octaves[f.landmarks >= 0] for f in placed.keyframes])
    return Bundle(
        placed.camera,
        np.array([x.R for x in X]),
        np.array([x.t_mm for x in X]),
        placed.points_mm,
        owner,
        point,
        pixels,
        sigma,
        np.full(len(sigma), HUBER_SIGMAS),
        held,
    )


def _with_circles(
    bundle: Bundle, layout: MarkerLayout, sightings: Sightings, registered: Registered, settings: MethodSettings
) -> Bundle:
    """The circles become points with the survey as prior; their observations are as sharp as their centres."""
    circles, first = registered.circles, len(bundle.points)
    owner, point, pixels, sigmas = [], [], [], []
    for k, (marker, circle) in enumerate(zip(circles.marker, circles.circle, strict=True)):
        seen = views(sightings, int(marker), int(circle))
        owner += [row for row, _ in seen]
        point += [first + k] * len(seen)
        pixels += [pixel for _, pixel in seen]
        index = layout.index(int(marker))
        assert index is not None
        sigmas.append(layout.sigma_mm[index, int(circle)])
    count = len(owner)
    return replace(
        bundle,
        points=np.concatenate([bundle.points, circles.known_mm]),
        frame_rows=np.concatenate([bundle.frame_rows, np.array(owner, dtype=np.int64)]),
        point_rows=np.concatenate([bundle.point_rows, np.array(point, dtype=np.int64)]),
        pixels=np.concatenate([bundle.pixels, np.array(pixels)]),
        sigma_px=np.concatenate([bundle.sigma_px, np.full(count, settings.circle_sigma_px)]),
        robust_at=np.concatenate([bundle.robust_at, np.full(count, 5.0)]),
        prior_rows=np.arange(first, first + len(circles.points)),
        prior_points=circles.known_mm,
        prior_sigma=np.array(sigmas),
        camera_sigma=None if settings.camera_sigma is None else np.array(settings.camera_sigma),
    )


def _moved(placed: ArMap, bundle: Bundle, settings: MethodSettings) -> ArMap:
    """The map after an adjustment; observations that no longer fit lose their point."""
    done = adjust(
        replace(bundle, camera_sigma=bundle.camera_sigma if settings.camera_sigma else None), settings.iterations
    )
    count = sum(int(np.count_nonzero(f.landmarks >= 0)) for f in placed.keyframes)
    size = np.linalg.norm(done.residuals_px[:count], axis=1) / bundle.sigma_px[:count]
    bad, frames, at = ~(size <= _OUTLIER_SIGMAS), [], 0
    for i, frame in enumerate(placed.keyframes):
        landmarks = frame.landmarks.copy()
        seen = np.flatnonzero(landmarks >= 0)
        landmarks[seen[bad[at : at + len(seen)]]] = -1
        at += len(seen)
        frames.append(replace(frame, X_WC=Pose(done.R[i], done.t[i]).inverse(), landmarks=landmarks))
    return replace(placed, camera=done.camera, keyframes=tuple(frames), points_mm=done.points[: len(placed.points_mm)])


def marker_rms_mm(ar_map: ArMap, layout: MarkerLayout, sightings: Sightings, rules: RegistrationSettings) -> float:
    """RMS distance of circles triangulated in the finished map from their survey, markers that disagree left out."""
    circles, _ = triangulated(ar_map.keyframes, ar_map.camera, layout, sightings, rules)
    if len(circles.points) == 0:
        return float("nan")
    error = np.linalg.norm(circles.points - circles.known_mm, axis=1)
    return float(np.sqrt(np.mean(error**2)))


def reprojection_rms_px(ar_map: ArMap) -> float:
    """RMS of all observations of the map."""
    owner, point, pixels = ar_map.observations()
    X = [frame.X_WC.inverse() for frame in ar_map.keyframes]
    R, t = np.array([x.R for x in X]), np.array([x.t_mm for x in X])
    error = _projected(ar_map, R[owner], t[owner], ar_map.points_mm[point]) - pixels
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
