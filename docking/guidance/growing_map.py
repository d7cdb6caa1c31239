"""A map while it grows: key-frames, points, which feature is which point; adding points and adjusting parts of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from docking.guidance.bundle import Bundle, adjust
from docking.guidance.features import SCALE, Features
from docking.guidance.guided import Looks, Visible, bits_apart, looks, search, visible
from docking.guidance.triangulation import parallax_deg, triangulate
from docking.guidance.two_views import match
from docking.guidance.types import ArMap, Bytes, Camera, Integers, KeyFrame, MapQuality
from docking.types import Array, Pose

Rows = NDArray[np.intp]

HUBER_SIGMAS = 2.0
OUTLIER_SIGMAS = 3.5
LEAST_PARALLAX_DEG = 1.0
_NEW_POINT_SIGMAS = 2.5
_FUSE_PX = 4.0


@dataclass(eq=False)
class GrowingFrame:
    """A key-frame of a growing map: `landmarks` (n,) rows of points or -1, `rays` (n, 2) normalised coordinates."""

    name: str
    t_s: float
    X_WC: Pose
    features: Features
    rays: Array
    landmarks: Integers


class GrowingMap:
    """Key-frames and points in a free frame."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.frames: list[GrowingFrame] = []
        self.points: Array = np.zeros((0, 3))
        self.descriptors: Bytes = np.zeros((0, 32), np.uint8)

    def add_frame(self, name: str, t_s: float, X_WC: Pose, features: Features) -> GrowingFrame:
        rays = self.camera.undistort(features.keypoints_px)
        landmarks = np.full(len(features.octaves), -1, np.int32)
        self.frames.append(GrowingFrame(name, t_s, X_WC, features, rays, landmarks))
        return self.frames[-1]

    def add_points(self, points: Array, descriptors: Bytes) -> Integers:
        """Rows of the points added."""
        rows = np.arange(len(self.points), len(self.points) + len(points), dtype=np.int32)
        self.points = np.concatenate([self.points, points])
        self.descriptors = np.concatenate([self.descriptors, descriptors])
        return rows

    def snapshot(self, first: int = 0) -> ArMap:
        """The map as it is, of the key-frames from `first` on."""
        frames = tuple(_key_frame(frame) for frame in self.frames[first:])
        return ArMap("free", self.camera, frames, self.points, self.descriptors, None, MapQuality())

    def rows(self, frames: list[int]) -> tuple[Rows, Rows, Rows]:
        """(key-frame, feature, point) of all observations of some key-frames."""
        seen = [np.flatnonzero(self.frames[i].landmarks >= 0) for i in frames]
        owner = np.repeat(np.array(frames, dtype=np.intp), [len(s) for s in seen])
        points = [self.frames[i].landmarks[s] for i, s in zip(frames, seen, strict=True)]
        return owner, np.concatenate(seen), np.concatenate(points).astype(np.intp)

    def add_between(self, a: GrowingFrame, b: GrowingFrame) -> int:
        """Triangulate features of two key-frames that are no points yet; how many came out well."""
        free_a, free_b = np.flatnonzero(a.landmarks < 0), np.flatnonzero(b.landmarks < 0)
        rows_a, rows_b = match(a.features, b.features, free_a, free_b)
        near = self._epipolar(a, b, rows_a, rows_b)
        rows_a, rows_b = rows_a[near], rows_b[near]
        n = len(rows_a)
        if n == 0:
            return 0
        X = (a.X_WC.inverse(), b.X_WC.inverse())
        R = np.concatenate([np.broadcast_to(x.R, (n, 3, 3)) for x in X])
        t = np.concatenate([np.broadcast_to(x.t_mm, (n, 3)) for x in X])
        points = triangulate(R, t, np.concatenate([a.rays[rows_a], b.rays[rows_b]]), np.tile(np.arange(n), 2), n)
        good = parallax_deg(a.X_WC.t_mm, b.X_WC.t_mm, points) > LEAST_PARALLAX_DEG
        good &= self._fits(a, rows_a, points) & self._fits(b, rows_b, points)
        landmarks = self.add_points(points[good], b.features.descriptors[rows_b[good]])
        a.landmarks[rows_a[good]] = landmarks
        b.landmarks[rows_b[good]] = landmarks
        return int(good.sum())

    def _epipolar(self, a: GrowingFrame, b: GrowingFrame, rows_a: Rows, rows_b: Rows) -> NDArray[np.bool_]:
        """Matches whose feature in b lies on the line that its ray in a draws there."""
        X_BA = b.X_WC.inverse() @ a.X_WC
        ray = np.c_[a.rays[rows_a], np.ones(len(rows_a))] @ X_BA.R.T
        line = np.cross(X_BA.t_mm, ray)
        other = np.c_[b.rays[rows_b], np.ones(len(rows_b))]
        distance = np.abs(np.einsum("ki,ki->k", line, other)) / np.hypot(line[:, 0], line[:, 1])
        sigma = SCALE ** b.features.octaves[rows_b] / self.camera.fx_px
        near: NDArray[np.bool_] = distance < _NEW_POINT_SIGMAS * sigma
        return near

    def _fits(self, frame: GrowingFrame, rows: Rows, points: Array) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            error = frame.features.keypoints_px[rows] - self.camera.project(frame.X_WC.inverse().apply(points))
            size = np.linalg.norm(error, axis=1) / SCALE ** frame.features.octaves[rows]
            good: NDArray[np.bool_] = size < _NEW_POINT_SIGMAS
        return good

    def adjust(self, free: list[int], iterations: int) -> float:
        """Adjust the key-frames `free` and all points they see; the others that see those points are held.

        Observations that do not fit are dropped. Returns the rms in px of those that stay.
        """
        _, _, points = self.rows(free)
        wanted = np.zeros(len(self.points), bool)
        wanted[points] = True
        others = [i for i in range(len(self.frames)) if i not in free and self._sees(i, wanted)]
        owner, feature, point = self.rows([*free, *others])
        keep = wanted[point] & (np.bincount(point, minlength=len(self.points)) >= 2)[point]
        owner, feature, point = owner[keep], feature[keep], point[keep]
        used, slot = np.unique(owner, return_inverse=True)
        X = [self.frames[i].X_WC.inverse() for i in used]
        pixels, sigma = self._observed(used, owner, feature)
        held = ~np.isin(used, free)
        if not held.any():
            held[0] = True
        bundle = Bundle(
            self.camera,
            np.array([x.R for x in X]),
            np.array([x.t_mm for x in X]),
            self.points,
            slot,
            point,
            pixels,
            sigma,
            np.full(len(sigma), HUBER_SIGMAS),
            held,
        )
        done = adjust(bundle, iterations)
        self.points = done.points
        for k in np.flatnonzero(~held):
            self.frames[used[k]].X_WC = Pose(done.R[k], done.t[k]).inverse()
        size = np.linalg.norm(done.residuals_px, axis=1)
        bad = ~(size / sigma <= OUTLIER_SIGMAS)
        self._drop(owner[bad], feature[bad])
        return float(np.sqrt(np.mean(size[~bad] ** 2)))

    def _sees(self, frame: int, wanted: NDArray[np.bool_]) -> bool:
        landmarks = self.frames[frame].landmarks
        return bool(np.count_nonzero(wanted[landmarks[landmarks >= 0]]) >= 10)

    def _observed(self, used: Rows, owner: Rows, feature: Rows) -> tuple[Array, Array]:
        pixels, sigma = np.empty((len(owner), 2)), np.empty(len(owner))
        for i in used:
            mine, features = owner == i, self.frames[i].features
            pixels[mine] = features.keypoints_px[feature[mine]]
            sigma[mine] = SCALE ** features.octaves[feature[mine]]
        return pixels, sigma

    def _drop(self, owner: Rows, feature: Rows) -> None:
        for i in np.unique(owner):
            self.frames[i].landmarks[feature[owner == i]] = -1

    def drop_single(self) -> None:
        """Forget points that fewer than two key-frames see."""
        counts = np.zeros(len(self.points), int)
        for frame in self.frames:
            np.add.at(counts, frame.landmarks[frame.landmarks >= 0], 1)
        renumbered = np.full(len(self.points) + 1, -1, np.int32)
        keep = np.flatnonzero(counts >= 2)
        renumbered[keep] = np.arange(len(keep), dtype=np.int32)
        for frame in self.frames:
            frame.landmarks = renumbered[frame.landmarks]
        self.points, self.descriptors = self.points[keep], self.descriptors[keep]

    def fuse(self) -> int:
        """Look for every point in every key-frame that should see it and does not; how many were found."""
        whole = self.snapshot()
        seen_from = looks(whole)
        return sum(self.join(frame, whole, seen_from, _FUSE_PX) for frame in self.frames)

    def join(self, frame: GrowingFrame, whole: ArMap, seen_from: Looks, radius_px: float) -> int:
        """Match features of a key-frame that are no points yet with points that it does not see yet."""
        wanted = visible(whole, seen_from, self.camera, frame.X_WC)
        missing = ~np.isin(wanted.points, frame.landmarks)
        free = np.flatnonzero(frame.landmarks < 0)
        seen = frame.features
        part = Features(seen.keypoints_px[free], seen.octaves[free], seen.descriptors[free])
        asked = Visible(wanted.points[missing], wanted.pixels[missing], wanted.level[missing])
        rows, points = search(whole, asked, part, radius_px)
        frame.landmarks[free[rows]] = points
        return len(rows)

    def representative_descriptors(self) -> None:
        """Every point takes the descriptor, among its observations, that is nearest to the others' majority."""
        owner, feature, point = self.rows(list(range(len(self.frames))))
        descriptors = np.concatenate(
            [self.frames[i].features.descriptors[feature[owner == i]] for i in np.unique(owner)]
        )
        order = np.argsort(point, kind="stable")
        bits = np.unpackbits(descriptors[order], axis=1).astype(np.float32)
        seen, starts, counts = np.unique(point[order], return_index=True, return_counts=True)
        ends = np.append(starts, len(point))
        sums = csr_array((np.ones(len(point), np.float32), np.arange(len(point)), ends)) @ bits
        majority = np.packbits(2.0 * sums > counts[:, None], axis=1)
        apart = bits_apart(descriptors[order], np.repeat(majority, counts, axis=0))
        # Sorted by point, then by distance: the first of every point is its best.
        best = np.lexsort((apart, point[order]))[starts]
        self.descriptors[seen] = descriptors[order][best]


def _key_frame(frame: GrowingFrame) -> KeyFrame:
    pixels, octaves, descriptors = frame.features
    return KeyFrame(frame.name, frame.t_s, frame.X_WC, pixels, octaves, descriptors, frame.landmarks.copy())
