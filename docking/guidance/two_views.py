"""The start of a map: relative pose of two images from essential matrix and homography, whichever explains more.

A wall is a plane: there the essential matrix is ill-determined and the homography is right; before boxes it is the
other way round. Both give several poses; the one with the most points in front of both cameras wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.guidance.features import Features
from docking.guidance.opencv import opencv
from docking.guidance.triangulation import parallax_deg, triangulate
from docking.guidance.types import Camera
from docking.types import Array, Pose

Rows = NDArray[np.intp]

_RANSAC_PX = 1.5
_CONFIDENCE = 0.999
_REPROJECTION_PX = 2.5
_NEXT_BEST = 0.8
"""Another pose that explains more than this share of the points makes the start ambiguous."""
_SAME_ROTATION = 0.02
_MOST_BITS = 64


@dataclass(frozen=True, eq=False)
class TwoViews:
    """X_AB of the second camera in the first (unit baseline), the matches used and their points in the first camera."""

    X_AB: Pose
    rows_a: Rows
    rows_b: Rows
    points: Array
    parallax_deg: float
    ambiguous: bool


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


def start(camera: Camera, a: Features, b: Features) -> TwoViews | None:
    """The relative pose of two images, or None where no pose explains them."""
    rows_a, rows_b = match(a, b, np.arange(len(a.octaves)), np.arange(len(b.octaves)))
    if len(rows_a) < 50:
        return None
    rays_a, rays_b = camera.undistort(a.keypoints_px[rows_a]), camera.undistort(b.keypoints_px[rows_b])
    judged = [_judge(camera, X, rays_a, rays_b) for X in _candidates(camera, rays_a, rays_b)]
    judged.sort(key=lambda item: -int(item[1].sum()))
    if not judged:
        return None
    X_AB, good, points = judged[0]
    if good.sum() < 50:
        return None
    rivals = [item for item in judged[1:] if np.linalg.norm(item[0].R - X_AB.R) > _SAME_ROTATION]
    ambiguous = any(item[1].sum() > _NEXT_BEST * good.sum() for item in rivals)
    angle = float(np.median(parallax_deg(np.zeros(3), X_AB.t_mm, points[good])))
    return TwoViews(X_AB, rows_a[good], rows_b[good], points[good], angle, ambiguous)


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
