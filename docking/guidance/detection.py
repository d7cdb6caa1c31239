"""Markers in an image: ArUco square first, then the circle in the direction of each corner, then the marker's pose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import acos, degrees
from typing import Any

import numpy as np

from docking.guidance.circles import circle_conic, eccentricity_px, ellipse_of, find_ellipse
from docking.guidance.marker_sheet import predefined
from docking.guidance.opencv import opencv
from docking.guidance.types import Camera, Image, MarkerLayout
from docking.types import Array, Pose

SIGNS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
"""Corners and circles in the marker's axes (x right, y up, z towards the viewer), from the top-left clockwise."""
_REFINEMENTS = 2
_ENLARGED = (2, 3)
_LEAST_PERIMETER = 0.01
"""Of a square, against the longer side of the image."""


@dataclass(frozen=True)
class Gate:
    """Which detections of markers are good enough for the map ([Huo]): near, upright, all circles seen."""

    distance_mm: float = 500.0
    angle_deg: float = 15.0
    circles: int = 4


@dataclass(frozen=True, eq=False)
class MarkerSighting:
    """One marker in one image.

    `corners_px` (4, 2) of the ArUco square as OpenCV orders them; `circles_px` (4, 2) images of the circles' centres,
    NaN where one was not seen. `poses` X_CM of the marker, nearest to the observation first: two for a planar target,
    empty where nothing could be solved; `errors_px` their rms.
    """

    marker_id: int
    corners_px: Array
    circles_px: Array
    poses: tuple[Pose, ...] = ()
    errors_px: tuple[float, ...] = ()

    @property
    def seen(self) -> int:
        """Number of circles."""
        return int(np.sum(np.isfinite(self.circles_px[:, 0])))

    @property
    def distance_mm(self) -> float:
        """From the camera to the marker's centre, inf without a pose."""
        return float(np.linalg.norm(self.poses[0].t_mm)) if self.poses else float("inf")

    @property
    def angle_deg(self) -> float:
        """Between the marker's normal and the optical axis, 180 without a pose."""
        return degrees(acos(min(1.0, abs(float(self.poses[0].R[2, 2]))))) if self.poses else 180.0

    def passes(self, gate: Gate) -> bool:
        near = self.distance_mm <= gate.distance_mm and self.angle_deg <= gate.angle_deg
        return near and self.seen >= gate.circles


class MarkerDetector:
    """Finds the markers of one layout, or of one dictionary without circles."""

    def __init__(self, dictionary: str, layout: MarkerLayout | None = None, camera: Camera | None = None) -> None:
        """Raises ExtraMissing, BadArgument for a dictionary that OpenCV does not know."""
        aruco = opencv().aruco
        settings = aruco.DetectorParameters()
        settings.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._aruco = aruco.ArucoDetector(predefined(dictionary), settings)
        closely = aruco.DetectorParameters()
        closely.cornerRefinementMethod = aruco.CORNER_REFINE_APRILTAG
        closely.minMarkerPerimeterRate = _LEAST_PERIMETER
        self._closely = aruco.ArucoDetector(predefined(dictionary), closely)
        self._layout, self._camera = layout, camera

    @staticmethod
    def of(layout: MarkerLayout, camera: Camera) -> MarkerDetector:
        return MarkerDetector(layout.dictionary, layout, camera)

    def squares(self, image: Image) -> list[tuple[int, Array]]:
        """(id, corners (4, 2) px) of all ArUco squares, by id."""
        return _by_id(_squares(self._aruco, image))

    def small_squares(self, image: Image) -> list[tuple[int, Array]]:
        """As `squares`, for photographs with markers of ten pixels: looked for in enlarged copies too (0.5 s)."""
        cv2 = opencv()
        found: list[tuple[int, Array]] = []
        for factor in _ENLARGED:
            large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
            # Pixel centres are integers: the corner of the image, not the first centre, stays where it is.
            found += [(i, (corners + 0.5) / factor - 0.5) for i, corners in _squares(self._closely, large)]
        once: list[tuple[int, Array]] = []
        for marker_id, corners in [*found, *_squares(self._aruco, image)]:
            if not any(i == marker_id and _overlap(corners, c) for i, c in once):
                once.append((marker_id, corners))
        return _by_id(once)

    def detect(self, image: Image) -> list[MarkerSighting]:
        """The markers of the layout in a grey image; a marker seen twice is dropped: one of the two is false."""
        if self._layout is None or self._camera is None:
            raise ValueError("circles need a layout and a camera")
        squares = [(i, corners) for i, corners in self.squares(image) if i in self._layout.ids]
        ids = [i for i, _ in squares]
        once = [(i, corners) for i, corners in squares if ids.count(i) == 1]
        return [self._sighting(image, i, corners, self._layout, self._camera) for i, corners in once]

    @staticmethod
    def _sighting(image: Image, marker_id: int, corners: Array, layout: MarkerLayout, camera: Camera) -> MarkerSighting:
        square, circles = SIGNS * layout.side_mm / 2.0, SIGNS * layout.circle_offset_mm
        H = homography(square, corners)
        seen = np.full((4, 2), np.nan)
        for _ in range(_REFINEMENTS):
            seen = _circle_centres(image, H, circles, layout.circle_radius_mm)
            if np.isfinite(seen).all():
                H = homography(circles, seen)
        poses, errors = planar_poses(circles, seen, camera)
        if not poses:
            poses, errors = planar_poses(square, corners, camera)
        return MarkerSighting(marker_id, corners, seen, poses, errors)


def _squares(detector: Any, image: Image) -> list[tuple[int, Array]]:
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return []
    return [(int(i), np.asarray(c, np.float64).reshape(4, 2)) for i, c in zip(ids.ravel(), corners, strict=True)]


def _by_id(squares: list[tuple[int, Array]]) -> list[tuple[int, Array]]:
    return sorted(squares, key=lambda item: (item[0], item[1][0, 0]))


def _overlap(a: Array, b: Array) -> bool:
    """Whether two squares are one: their centres are closer than half a side."""
    side = float(np.linalg.norm(a[0] - a[1]))
    return float(np.linalg.norm(a.mean(axis=0) - b.mean(axis=0))) < 0.5 * side


def _circle_centres(image: Image, H: Array, circles: Array, radius_mm: float) -> Array:
    """Images of the circles' centres (4, 2), NaN where there is no whole circle."""
    seen = np.full((4, 2), np.nan)
    for k, centre in enumerate(circles):
        found = find_ellipse(image, ellipse_of(circle_conic(H, centre, radius_mm)))
        if found is not None:
            seen[k] = found.centre_px - eccentricity_px(H, centre, radius_mm)
    return seen


def homography(plane: Array, pixels: Array) -> Array:
    """H (3, 3) that takes four points (4, 2) of a plane to four pixels (4, 2), exactly."""
    rows = []
    for (x, y), (u, v) in zip(plane, pixels, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    solution = np.linalg.solve(np.array(rows), pixels.ravel())
    return np.array([*solution, 1.0]).reshape(3, 3)


def planar_poses(plane: Array, pixels: Array, camera: Camera) -> tuple[tuple[Pose, ...], tuple[float, ...]]:
    """Both poses X_CM that a planar target (k, 2) allows, with their errors px, best first; none for < 4 points."""
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < 4:
        return (), ()
    cv2 = opencv()
    points = np.c_[plane[seen], np.zeros(int(seen.sum()))]
    rays = camera.undistort(pixels[seen])
    count, turns, shifts, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    found = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        X = Pose(cv2.Rodrigues(turn)[0], shift.ravel())
        error = camera.project(X.apply(points)) - pixels[seen]
        if np.all(np.isfinite(error)):
            found.append((float(np.sqrt(np.mean(np.sum(error**2, axis=1)))), X))
    found.sort(key=lambda item: item[0])
    return tuple(X for _, X in found), tuple(error for error, _ in found)


def hull_share(sightings: Iterable[MarkerSighting], camera: Camera) -> float:
    """Area of the convex hull of all circles seen, against the image."""
    points = np.concatenate([s.circles_px[np.isfinite(s.circles_px[:, 0])] for s in sightings])
    if len(points) < 3:
        return 0.0
    cv2 = opencv()
    area = float(cv2.contourArea(cv2.convexHull(points.astype(np.float32))))
    return area / (camera.width_px * camera.height_px)
