"""Guided search: the map's points are projected with a predicted pose, and each looks for its feature near by."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from docking.guidance.features import LEVELS, SCALE, Features
from docking.guidance.pose_only import Sights
from docking.guidance.types import ArMap, Bytes, Camera
from docking.types import Array, Pose

Rows = NDArray[np.intp]

MOST_BITS = 60
"""Hamming distance of 256 bits up to which two features may be the same point."""
_NEIGHBOURS = 12
_NEXT_BEST = 0.85
"""The second best neighbour must be this much worse, or lie on another level of the pyramid."""
_LEVEL_SLACK = 1.6
_WIDEST_COS = 0.5
_BORDER_PX = 8.0


@dataclass(frozen=True, eq=False)
class Looks:
    """From where every point of a map was seen.

    `toward` (m, 3) mean unit direction point -> camera, `reach_mm` (m,) distance at which it stands on pyramid level 0.
    """

    toward: Array
    reach_mm: Array


@dataclass(frozen=True, eq=False)
class Visible:
    """Points a camera at a predicted pose can see: rows in the map (v,), pixels (v, 2), pyramid level (v,) expected."""

    points: Rows
    pixels: Array
    level: Array

    def thinned(self, most: int | None) -> Visible:
        """At most so many of them, evenly; all with None."""
        if most is None or len(self.points) <= most:
            return self
        some = slice(None, None, -(-len(self.points) // most))
        return Visible(self.points[some], self.pixels[some], self.level[some])


def looks(ar_map: ArMap) -> Looks:
    """How the points of a map were seen by its key-frames; a point never seen stays invisible (reach 0)."""
    frames, points, _ = ar_map.observations()
    octaves = np.concatenate([f.octaves[f.landmarks >= 0] for f in ar_map.keyframes])
    centres = np.array([f.X_WC.t_mm for f in ar_map.keyframes])
    offset = centres[frames] - ar_map.points_mm[points]
    distance = np.linalg.norm(offset, axis=1)
    count = np.maximum(np.bincount(points, minlength=len(ar_map.points_mm)), 1)
    toward = np.stack([_summed(points, column / distance, len(count)) for column in offset.T], axis=1)
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    log_reach = _summed(points, np.log(distance) + octaves * log(SCALE), len(count)) / count
    seen = np.bincount(points, minlength=len(count)) > 0
    return Looks(toward / np.maximum(length, 1e-12), np.where(seen, np.exp(log_reach), 0.0))


def _summed(rows: NDArray[np.int32], values: Array, size: int) -> Array:
    return np.bincount(rows, weights=values, minlength=size).astype(np.float64)


def visible(ar_map: ArMap, seen_from: Looks, camera: Camera, X_WC: Pose) -> Visible:
    """The points that a camera at X_WC can see: inside the image, from a direction and distance like in the map."""
    p_C = X_WC.inverse().apply(ar_map.points_mm)
    pixels = camera.project(p_C)
    with np.errstate(invalid="ignore"):
        inside = np.all(
            (pixels > _BORDER_PX) & (pixels < (camera.width_px - _BORDER_PX, camera.height_px - _BORDER_PX)), 1
        )
    offset = X_WC.t_mm - ar_map.points_mm
    distance = np.linalg.norm(offset, axis=1)
    facing = np.einsum("ni,ni->n", offset, seen_from.toward) > _WIDEST_COS * distance
    level = np.log(np.maximum(seen_from.reach_mm, 1e-9) / np.maximum(distance, 1e-9)) / log(SCALE)
    on_level = (level > -_LEVEL_SLACK) & (level < LEVELS - 1 + _LEVEL_SLACK)
    rows = np.flatnonzero(inside & facing & on_level)
    return Visible(rows, pixels[rows], level[rows])


def bits_apart(a: Bytes, b: Bytes) -> Rows:
    """Hamming distances (...,) of descriptors (..., 32)."""
    differing = np.ascontiguousarray(a).view(np.uint64) ^ np.ascontiguousarray(b).view(np.uint64)
    result: Rows = np.bitwise_count(differing).sum(axis=-1, dtype=np.intp)
    return result


def search(ar_map: ArMap, wanted: Visible, features: Features, radius_px: float) -> tuple[Rows, Rows]:
    """(rows of `features`, rows of the map's points) that match within `radius_px` of the projection.

    Each feature and each point is used once; where two points claim a feature the nearer descriptor has it.
    """
    if len(features.keypoints_px) == 0 or len(wanted.points) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    tree = cKDTree(features.keypoints_px)
    _, found = tree.query(wanted.pixels, k=_NEIGHBOURS, distance_upper_bound=radius_px)
    there = found < len(features.keypoints_px)
    near: Rows = np.where(there, found, 0)
    bits = bits_apart(features.descriptors[near], ar_map.descriptors[wanted.points][:, None])
    bits[~there | (np.abs(features.octaves[near] - wanted.level[:, None]) > _LEVEL_SLACK)] = 256
    order = np.argsort(bits, axis=1, kind="stable")
    line = np.arange(len(near))
    best, second = bits[line, order[:, 0]], bits[line, order[:, 1]]
    same_level = features.octaves[near[line, order[:, 0]]] == features.octaves[near[line, order[:, 1]]]
    good = (best <= MOST_BITS) & ~(same_level & (best > _NEXT_BEST * second))
    return _claimed(near[line, order[:, 0]][good], wanted.points[good], best[good])


def _claimed(features: Rows, points: Rows, bits: Rows) -> tuple[Rows, Rows]:
    """Every feature once, for the point with the nearest descriptor."""
    order = np.argsort(bits, kind="stable")
    _, first = np.unique(features[order], return_index=True)
    chosen = order[first]
    return features[chosen], points[chosen]


def sights(ar_map: ArMap, features: Features, rows: Rows, points: Rows) -> Sights:
    """The matched features as observations; a corner of pyramid level o is known to SCALE^o pixels."""
    sigma_px = SCALE ** features.octaves[rows].astype(np.float64)
    return Sights(ar_map.points_mm[points], features.keypoints_px[rows], sigma_px)
