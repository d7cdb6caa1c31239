"""The map grows while it is used: points triangulated between two localised images join it, in the frame of the cell.

No surveyed circle holds them, so each carries its generation: 0 for the points of the map as built, one more than the
points its cameras were localised by. A pose from points of generation g has (1 + g)^1.5 times the standard deviation
of mapped places (measured on rendered walks out of the map).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from docking.guidance import guided
from docking.guidance.features import Features
from docking.guidance.localiser import Indexed, Localised
from docking.guidance.opencv import opencv
from docking.guidance.types import ArMap, Camera, Integers, KeyFrame
from docking.types import Array, Pose

LEAST_PARALLAX_RAD = np.deg2rad(5.0)
"""With less, the depth of a point is known to a few hundredths of it only, and the next pose leans on that."""
_MOST_PX = 2.0
_LEAST_NEW = 30
_LEAST_BASE = 0.15
"""Distance of the two cameras, in depths of the scene."""
MOST_GENERATION = 2.0
"""Where the camera leans on points further from the surveyed circles than this, the map grows no more."""
_ENOUGH_SHARE = 0.3
"""An image of whose features this share is known needs no new points."""

Rows = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Seen:
    """A localised image that may become a key-frame."""

    name: str
    t_s: float
    found: Localised
    features: Features


def far_enough(anchor: Seen, image: Seen) -> bool:
    """Whether two images are from places far enough apart to triangulate."""
    base = float(np.linalg.norm(anchor.found.X_WC.t_mm - image.found.X_WC.t_mm))
    return base > _LEAST_BASE * image.found.depth_mm


def little_known(image: Seen) -> bool:
    """Whether the map knows too little of what an image shows, and enough to place what is added."""
    few = image.found.points < _ENOUGH_SHARE * len(image.features.keypoints_px)
    return few and image.found.generation < MOST_GENERATION


def extended(index: Indexed, anchor: Seen, image: Seen) -> Indexed | None:
    """The map with the two images and what they see together; None where that is too little."""
    free_a, free_b = _unknown(anchor), _unknown(image)
    rows_a, rows_b = _matches(anchor.features, free_a, image.features, free_b)
    points, good = _triangulated(anchor, rows_a, image, rows_b)
    if np.count_nonzero(good) < _LEAST_NEW:
        return None
    rows_a, rows_b, points = rows_a[good], rows_b[good], points[good]
    fresh = np.arange(len(points)) + len(index.ar_map.points_mm)
    frames = (_keyframe(anchor, rows_a, fresh), _keyframe(image, rows_b, fresh))
    ar_map = replace(
        index.ar_map,
        keyframes=(*index.ar_map.keyframes, *frames),
        points_mm=np.vstack([index.ar_map.points_mm, points]),
        descriptors=np.vstack([index.ar_map.descriptors, image.features.descriptors[rows_b]]),
    )
    generation = max(anchor.found.generation, image.found.generation) + 1.0
    return _indexed(index, ar_map, frames, np.full(len(points), generation))


def _indexed(index: Indexed, ar_map: ArMap, frames: tuple[KeyFrame, ...], generation: Array) -> Indexed:
    bags = index.bags
    for frame in frames:
        bags = bags.with_frame(frame.descriptors)
    return Indexed(ar_map, bags, guided.looks(ar_map), np.concatenate([index.generation, generation]))


def _unknown(seen: Seen) -> Rows:
    """Rows of the features that are no point of the map yet."""
    return np.setdiff1d(np.arange(len(seen.features.keypoints_px)), seen.found.feature_rows)


def _matches(a: Features, rows_a: Rows, b: Features, rows_b: Rows) -> tuple[Rows, Rows]:
    cv2 = opencv()
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    pairs = matcher.match(a.descriptors[rows_a], b.descriptors[rows_b]) if len(rows_a) and len(rows_b) else ()
    close = [(m.queryIdx, m.trainIdx) for m in pairs if m.distance <= guided.MOST_BITS]
    table = np.array(close, dtype=np.intp).reshape(-1, 2)
    return rows_a[table[:, 0]], rows_b[table[:, 1]]


def _triangulated(a: Seen, rows_a: Rows, b: Seen, rows_b: Rows) -> tuple[Array, NDArray[np.bool_]]:
    """(points W (n, 3), which of them both images agree on at enough parallax)."""
    rays = [
        _rays(s.found.camera, s.found.X_WC, s.features.keypoints_px[rows]) for s, rows in ((a, rows_a), (b, rows_b))
    ]
    origin = b.found.X_WC.t_mm - a.found.X_WC.t_mm
    # Nearest points of two lines: p = c_a + s u, q = c_b + t v, with u.v = c.
    u, v = rays
    c = np.einsum("ni,ni->n", u, v)
    ou, ov = u @ origin, v @ origin
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (ou - c * ov) / (1.0 - c * c), (c * ou - ov) / (1.0 - c * c)
    points = (a.found.X_WC.t_mm + s[:, None] * u + b.found.X_WC.t_mm + t[:, None] * v) / 2.0
    good = (s > 0.0) & (t > 0.0) & (np.arccos(np.clip(c, -1.0, 1.0)) > LEAST_PARALLAX_RAD)
    for seen, rows in ((a, rows_a), (b, rows_b)):
        error = seen.found.camera.project(seen.found.X_WC.inverse().apply(points)) - seen.features.keypoints_px[rows]
        with np.errstate(invalid="ignore"):
            good &= np.linalg.norm(error, axis=1) < _MOST_PX
    return points, good


def _rays(camera: Camera, X_WC: Pose, pixels: Array) -> Array:
    """Unit directions (n, 3) in W."""
    xy = camera.undistort(pixels)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ X_WC.R.T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), dtype=np.float64)


def _keyframe(seen: Seen, rows: Rows, fresh: Rows) -> KeyFrame:
    landmarks: Integers = np.full(len(seen.features.keypoints_px), -1, dtype=np.int32)
    landmarks[seen.found.feature_rows] = seen.found.point_rows
    landmarks[rows] = fresh
    f = seen.features
    return KeyFrame(seen.name, seen.t_s, seen.found.X_WC, f.keypoints_px, f.octaves, f.descriptors, landmarks)
