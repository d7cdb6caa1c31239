"""The start of a map: relative pose of two images from essential matrix and homography, whichever explains more.

A wall is a plane: there the essential matrix is ill-determined and the homography is right; before boxes it is the
other way round. Both give several poses; the one with the most points in front of both cameras wins. Two views of a
plane alone leave two poses that fit alike: a third view tells which of the planes is real.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.errors import NotLocalised
from docking.guidance.features import Features
from docking.guidance.opencv import opencv
from docking.guidance.pose_only import Sights, refine
from docking.guidance.triangulation import parallax_deg, triangulate
from docking.guidance.types import Camera
from docking.types import Array, Pose

Rows = NDArray[np.intp]

_RANSAC_PX = 1.5
_CONFIDENCE = 0.999
_REPROJECTION_PX = 2.5
_NEXT_BEST = 0.5
"""Another pose that explains more than this share of the points makes the start ambiguous."""
_SAME_POSE = 0.1
"""Distance of two poses, rotation and unit baseline together, below which they are one explanation."""
_CLEARLY = 0.75
"""The better rival misses so much less."""
_MOST_MISSED_PX = 3.0
"""In a third image, at the median: blur included."""
_LEAST_MATCHES = 50
_UNIT = 100.0
"""Brings a scene with a baseline of 1 to lengths like mm."""
_MOST_BITS = 64


@dataclass(frozen=True, eq=False)
class TwoViews:
    """One explanation: X_AB of the second camera in the first (unit baseline), matches, points in the first camera."""

    X_AB: Pose
    rows_a: Rows
    rows_b: Rows
    points: Array
    parallax_deg: float


def match(a: Features, b: Features, rows_a: Rows, rows_b: Rows) -> tuple[Rows, Rows]:
    """Rows of `a` and `b` that are each other's nearest descriptors, among the rows given."""
    if len(rows_a) == 0 or len(rows_b) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    cv2 = opencv()
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a.descriptors[rows_a], b.descriptors[rows_b])
    pairs = [(m.queryIdx, m.trainIdx) for m in found if m.distance <= _MOST_BITS]
    if not pairs:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    first, second = np.array(pairs, dtype=np.intp).T
    return rows_a[first], rows_b[second]


def start(camera: Camera, a: Features, b: Features) -> list[TwoViews]:
    """The relative poses that explain two images, best first: none, one, or rivals; a third view must agree."""
    rows_a, rows_b = match(a, b, np.arange(len(a.octaves)), np.arange(len(b.octaves)))
    if len(rows_a) < _LEAST_MATCHES:
        return []
    rays_a, rays_b = camera.undistort(a.keypoints_px[rows_a]), camera.undistort(b.keypoints_px[rows_b])
    judged = [_judge(camera, X, rays_a, rays_b) for X in _candidates(camera, rays_a, rays_b)]
    judged.sort(key=lambda item: -int(item[1].sum()))
    if not judged or judged[0][1].sum() < _LEAST_MATCHES:
        return []
    found: list[TwoViews] = []
    for X_AB, good, points in judged:
        apart = [np.linalg.norm(np.c_[f.X_AB.R - X_AB.R, f.X_AB.t_mm - X_AB.t_mm]) for f in found]
        if good.sum() <= _NEXT_BEST * judged[0][1].sum() or min(apart, default=1.0) < _SAME_POSE:
            continue
        angle = float(np.median(parallax_deg(np.zeros(3), X_AB.t_mm, points[good])))
        found.append(TwoViews(X_AB, rows_a[good], rows_b[good], points[good], angle))
    return found


def decided(camera: Camera, rivals: list[TwoViews], b: Features, c: Features) -> TwoViews | None:
    """Of the explanations the one that a third image agrees with, None while it agrees with several or with none."""
    misses = sorted((_miss_px(camera, two, b, c), k) for k, two in enumerate(rivals))
    if not (misses[0][0] <= _MOST_MISSED_PX):
        return None
    if len(misses) > 1 and not (misses[0][0] <= _CLEARLY * misses[1][0]):
        return None
    return rivals[misses[0][1]]


def _miss_px(camera: Camera, two: TwoViews, b: Features, c: Features) -> float:
    """Median distance in a third image between points of one explanation and their features, at the best pose."""
    rows_b, rows_c = match(b, c, two.rows_b, np.arange(len(c.octaves)))
    if len(rows_b) < _LEAST_MATCHES:
        return float("inf")
    place = np.full(len(b.octaves), -1)
    place[two.rows_b] = np.arange(len(two.rows_b))
    points, pixels = two.points[place[rows_b]] * _UNIT, c.keypoints_px[rows_c]
    try:
        fit = refine(camera, Pose(two.X_AB.R, two.X_AB.t_mm * _UNIT), Sights(points, pixels, np.ones(len(points))))
    except NotLocalised:
        return float("inf")
    miss = np.linalg.norm(camera.project(fit.X_WC.inverse().apply(points)) - pixels, axis=1)
    return float(np.nanmedian(miss)) if np.isfinite(miss).any() else float("inf")


def _candidates(camera: Camera, rays_a: Array, rays_b: Array) -> list[Pose]:
    """Possible X_AB from both models."""
    cv2 = opencv()
    limit = _RANSAC_PX / camera.fx_px
    poses = []
    E, _ = cv2.findEssentialMat(rays_a, rays_b, np.eye(3), cv2.USAC_DEFAULT, _CONFIDENCE, limit)
    if E is not None and E.shape == (3, 3):
        first, second, shift = cv2.decomposeEssentialMat(E)
        poses += [(R, s * shift.ravel()) for R in (first, second) for s in (1.0, -1.0)]
    H, _ = cv2.findHomography(rays_a, rays_b, cv2.USAC_DEFAULT, limit, confidence=_CONFIDENCE)
    if H is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        poses += [(R, shift.ravel()) for R, shift in zip(turns, shifts, strict=True)]
    moved = [(R, shift / np.linalg.norm(shift)) for R, shift in poses if np.linalg.norm(shift) > 1e-9]
    return [Pose(R, shift).inverse() for R, shift in moved]


def _judge(camera: Camera, X_AB: Pose, rays_a: Array, rays_b: Array) -> tuple[Pose, NDArray[np.bool_], Array]:
    """(pose, which matches it explains, their points)."""
    X_BA = X_AB.inverse()
    n = len(rays_a)
    R = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), np.broadcast_to(X_BA.R, (n, 3, 3))])
    t = np.concatenate([np.zeros((n, 3)), np.broadcast_to(X_BA.t_mm, (n, 3))])
    points = triangulate(R, t, np.concatenate([rays_a, rays_b]), np.tile(np.arange(n), 2), n)
    good = np.ones(n, bool)
    for X, rays in ((Pose.identity(), rays_a), (X_BA, rays_b)):
        local = X.apply(points)
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.linalg.norm(local[:, :2] / local[:, 2:] - rays, axis=1) * camera.fx_px
        good &= (local[:, 2] > 0.0) & (error < _REPROJECTION_PX)
    return X_AB, good, points
