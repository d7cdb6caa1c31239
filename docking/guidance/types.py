"""The nouns of guidance: camera, marker layout, key-frame, map.

Camera axes: x right, y down, z forward; pixel centres are integers (OpenCV). A pose `X_WC` takes camera coordinates
into the map's frame: `p_W = R p_C + t`. A map in the frame "cell" is in mm; a map in the frame "free" has a unit of
its own, and fields named `_mm` are in that unit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from docking.types import Array, Pose

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int32]
Image = NDArray[np.uint8]
"""Grey (h, w) or BGR (h, w, 3), 8 bits."""
MapFrame = Literal["cell", "free"]

_UNDISTORT_STEPS = 10


@dataclass(frozen=True)
class Camera:
    """Pin-hole camera with the radial and tangential distortion of Brown (OpenCV's order k1, k2, p1, p2, k3)."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def matrix(self) -> Array:
        """The (3, 3) camera matrix."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """(5,) k1, k2, p1, p2, k3."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @cached_property
    def widest(self) -> float:
        """Radius in undistorted normalised coordinates up to which the radial distortion grows.

        Beyond it the polynomial turns round and would bring what lies far beside the picture back into it.
        """
        slope_of_r2 = np.roots([7.0 * self.k3, 5.0 * self.k2, 3.0 * self.k1, 1.0])
        turns = [float(r2.real) for r2 in slope_of_r2 if abs(r2.imag) < 1e-9 and r2.real > 0.0]
        return float(np.sqrt(min(turns))) if turns else float("inf")

    def distort(self, xy: ArrayLike) -> Array:
        """Normalised image coordinates (..., 2) -> distorted normalised coordinates (..., 2)."""
        p = np.asarray(xy, dtype=np.float64)
        x, y = p[..., 0], p[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
                y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def to_pixels(self, xy: ArrayLike) -> Array:
        """Undistorted normalised coordinates (..., 2) -> pixels (..., 2)."""
        result: Array = self.distort(xy) * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)
        return result

    def project(self, points_C: ArrayLike) -> Array:
        """Points (..., 3) in the camera's frame -> pixels (..., 2).

        Points not in front of it, or so far aside that the lens model does not hold (`widest`), become NaN.
        """
        p = np.asarray(points_C, dtype=np.float64)
        depth = np.where(p[..., 2:] > 0.0, p[..., 2:], np.nan)
        xy = p[..., :2] / depth
        if self.widest < np.inf:
            xy = np.where(np.linalg.norm(xy, axis=-1, keepdims=True) < self.widest, xy, np.nan)
        return self.to_pixels(xy)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) -> undistorted normalised coordinates (..., 2): (x, y, 1) is the ray. Fixed-point steps."""
        observed = (np.asarray(pixels, dtype=np.float64) - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        xy: Array = observed
        if np.any(self.distortion):
            for _ in range(_UNDISTORT_STEPS):
                xy = xy - (self.distort(xy) - observed)
        return xy


@dataclass(frozen=True, eq=False)
class MarkerLayout:
    """Where the circle centres of the markers are in the cell.

    `circles_mm` (k, 4, 3) in the order top-left, top-right, bottom-right, bottom-left of the upright marker, frame W;
    `sigma_mm` (k, 4, 3) standard deviation of the survey. `dictionary` is OpenCV's name of the ArUco dictionary.
    """

    ids: tuple[int, ...]
    circles_mm: Array
    sigma_mm: Array
    dictionary: str
    side_mm: float
    circle_radius_mm: float
    circle_offset_mm: float

    def index(self, marker_id: int) -> int | None:
        """Row of a marker, None where the layout does not know it."""
        return self.ids.index(marker_id) if marker_id in self.ids else None


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """One image of the map.

    `X_WC` pose of the camera in the map's frame. `keypoints_px` (n, 2) as seen (distorted pixels), `octaves` (n,)
    pyramid level, `descriptors` (n, 32) ORB, `landmarks` (n,) row in `ArMap.points_mm` or -1. `t_s` time in the scan.
    """

    name: str
    t_s: float
    X_WC: Pose
    keypoints_px: Array
    octaves: Integers
    descriptors: Bytes
    landmarks: Integers


@dataclass(frozen=True)
class MapQuality:
    """What the build found out. `notices` are sentences a person must see (fallbacks, rejected markers).

    `doubt_mm` how far markers that agree with each other lie from where the majority puts them: moved together, or the
    map is bent. `markers_used` ids that set the frame; `markers_rejected` id -> why; `reset_keyframes` names of the
    key-frames that qualified for a new pose from circles alone; `scale` mm for one unit of the free map.
    """

    method: str = "free"
    markers_used: tuple[int, ...] = ()
    markers_rejected: dict[int, str] = field(default_factory=dict)
    reset_keyframes: tuple[str, ...] = ()
    scale: float = 1.0
    marker_rms_mm: float | None = None
    doubt_mm: float = 0.0
    reprojection_rms_px: float = 0.0
    build_s: float = 0.0
    optimise_s: float = 0.0
    notices: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ArMap:
    """Key-frames and points in one frame.

    `points_mm` (m, 3); `descriptors` (m, 32) one a point, that of the observation nearest to all others. `camera` is
    the one the map was adjusted with: localise with it, not with the file it came from. `layout` holds the markers.
    """

    frame: MapFrame
    camera: Camera
    keyframes: tuple[KeyFrame, ...]
    points_mm: Array
    descriptors: Bytes
    layout: MarkerLayout | None
    quality: MapQuality

    def observations(self) -> tuple[Integers, Integers, Array]:
        """(key-frame row (o,), point row (o,), pixels (o, 2)) of all observations, key-frame by key-frame."""
        seen = [np.flatnonzero(frame.landmarks >= 0) for frame in self.keyframes]
        rows = np.repeat(np.arange(len(seen), dtype=np.int32), [len(s) for s in seen])
        points = [frame.landmarks[s] for frame, s in zip(self.keyframes, seen, strict=True)]
        pixels = [frame.keypoints_px[s] for frame, s in zip(self.keyframes, seen, strict=True)]
        return rows, np.concatenate(points), np.concatenate(pixels)
