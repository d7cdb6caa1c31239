"""The map from a hand-held scan with one camera: start from two views, then key-frame by key-frame, then all at once.

Frame and scale are free. No loop closing by appearance: points of the whole map are looked for in every key-frame, so
a scan that comes back meets its own points while the drift is small.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from docking.errors import MapNotBuilt, NotLocalised
from docking.geometry import exp_so3, log_so3
from docking.guidance.features import Features, extract
from docking.guidance.growing_map import GrowingFrame, GrowingMap
from docking.guidance.guided import looks, search, sights, visible
from docking.guidance.images import Picture
from docking.guidance.opencv import opencv
from docking.guidance.pose_only import CameraFit, Sights, refine
from docking.guidance.two_views import Rows, TwoViews, decided, match, start
from docking.guidance.types import ArMap, Camera
from docking.types import Pose

START_DEPTH = 1000.0
"""Median depth of the first points: the unit of the free map, so that its numbers look like mm."""


_RIVALS_KEPT = 4
_Taken = tuple[Picture, Features]


@dataclass(frozen=True)
class BuilderSettings:
    """How dense the map becomes. Overlap: share of the last key-frame's points still in view."""

    features: int = 1500
    overlap_least: float = 0.9
    overlap_wanted: float = 0.96
    held_share: float = 0.75
    seen_share: float = 0.15
    longest_s: float = 0.4
    longest_stride: int = 12
    least_points: int = 60
    start_parallax_deg: float = 2.0
    start_frames: int = 30
    window: int = 5
    window_iterations: int = 4
    most_lost: int = 20
    search_px: float = 30.0


class MapBuilder:
    """One scan: feed it with pictures, get the map."""

    def __init__(
        self, camera: Camera, settings: BuilderSettings, key_frame: Callable[[Picture], None] | None = None
    ) -> None:
        """`key_frame` is called once with every picture that becomes a key-frame (to look for markers in it)."""
        self.map = GrowingMap(camera)
        self.camera, self.settings = camera, settings
        self.skipped = 0
        self._told = key_frame or (lambda picture: None)
        self._stride = 1
        self._found = 0

    def build(self, scan: Iterable[Picture]) -> ArMap:
        """The map in a free frame. Raises MapNotBuilt when no start is found or the scan is lost soon."""
        self._follow(self._start(iter(scan)))
        if len(self.map.frames) < 3:
            raise MapNotBuilt("scan", f"only {len(self.map.frames)} key-frames hold together")
        self._finish()
        return self.map.snapshot()

    def _features(self, picture: Picture) -> Features:
        if picture.image.shape != (self.camera.height_px, self.camera.width_px):
            height, width = picture.image.shape
            cause = f"{picture.name} has {width} x {height} pixels, the calibration {self.camera.width_px} x"
            raise MapNotBuilt("scan", f"{cause} {self.camera.height_px}")
        return extract(picture.image, self.settings.features)

    def _start(self, pictures: Iterator[Picture]) -> Iterator[Picture]:
        """Make the first two key-frames; returns the pictures that come after them.

        A pair and its explanations wait for a picture that agrees with one of them: a wrong start bends the whole map.
        """
        first: _Taken | None = None
        waiting: list[tuple[_Taken, list[TwoViews], int]] = []
        since: list[Picture] = []
        for picture in pictures:
            taken = picture, self._features(picture)
            if first is None or len(since) >= self.settings.start_frames:
                first, waiting, since = taken, [], []
                continue
            for other, rivals, place in waiting[-_RIVALS_KEPT:]:
                two = decided(self.camera, rivals, other[1], taken[1])
                if two is not None:
                    self._first_map(first, other, two)
                    return chain(since[place:], [picture], pictures)
            since.append(picture)
            rivals = start(self.camera, first[1], taken[1])
            rivals = [two for two in rivals if two.parallax_deg >= self.settings.start_parallax_deg]
            if rivals:
                waiting.append((taken, rivals, len(since)))
        raise MapNotBuilt("scan", "no images with parallax and common features that leave one explanation")

    def _first_map(self, a: _Taken, b: _Taken, two: TwoViews) -> None:
        scale = START_DEPTH / float(np.median(two.points[:, 2]))
        first = self.map.add_frame(a[0].name, a[0].t_s, Pose.identity(), a[1])
        X_AB = Pose(two.X_AB.R, two.X_AB.t_mm * scale)
        second = self.map.add_frame(b[0].name, b[0].t_s, X_AB, b[1])
        rows = self.map.add_points(two.points * scale, b[1].descriptors[two.rows_b])
        first.landmarks[two.rows_a] = rows
        second.landmarks[two.rows_b] = rows
        self.map.adjust([0, 1], 10)
        self._told(a[0])
        self._told(b[0])

    def _follow(self, pictures: Iterator[Picture]) -> None:
        """Key-frames as far apart as the overlap allows; pictures in between are looked at only when needed."""
        waiting: deque[Picture] = deque()
        lost = 0
        while True:
            while len(waiting) < self._stride and (picture := next(pictures, None)) is not None:
                waiting.append(picture)
                if picture.t_s - self.map.frames[-1].t_s >= self.settings.longest_s:
                    break
            if not waiting:
                return
            taken = self._next(waiting)
            if taken is None:
                waiting.popleft()
                lost, self._stride = lost + 1, 1
                self.skipped += 1
                if lost > self.settings.most_lost:
                    return
                continue
            lost = 0
            for _ in range(taken):
                waiting.popleft()

    def _next(self, waiting: deque[Picture]) -> int | None:
        """Take the furthest picture that overlaps enough; how many pictures that uses up, None if none does."""
        ahead = min(self._stride, len(waiting))
        while ahead >= 1:
            picture = waiting[ahead - 1]
            features = self._features(picture)
            tracked = self._track(picture, features)
            overlap = self._overlap(tracked[0]) if tracked else 0.0
            close = overlap >= self.settings.overlap_least and self._holds(tracked)
            if tracked and (close or ahead == 1):
                self._insert(picture, features, *tracked)
                longer = overlap > self.settings.overlap_wanted
                self._stride = min(max(1, ahead + (1 if longer else 0)), self.settings.longest_stride)
                return ahead
            ahead //= 2
        return None

    def _holds(self, tracked: tuple[Pose, Rows, Rows] | None) -> bool:
        """Whether nearly as many points are found again as in the last key-frame: blur asks for shorter steps."""
        return tracked is not None and len(tracked[1]) >= self.settings.held_share * self._found

    def _overlap(self, X_WC: Pose) -> float:
        """Share of the last key-frame's points that lie in the image of another pose."""
        last = self.map.frames[-1].landmarks
        points = self.map.points[last[last >= 0]]
        pixels = self.camera.project(X_WC.inverse().apply(points))
        inside = (pixels > 0.0) & (pixels < (self.camera.width_px, self.camera.height_px))
        return float(np.mean(np.all(inside, axis=1))) if len(points) else 0.0

    def _track(self, picture: Picture, features: Features) -> tuple[Pose, Rows, Rows] | None:
        """(X_WC, rows of features, rows of points) of a picture in the map as it is."""
        whole = self.map.snapshot()
        seen_from = looks(whole)
        fit = self._predicted_fit(whole, features, picture.t_s) or self._matched_fit(features)
        if fit is None:
            return None
        try:
            wanted = visible(whole, seen_from, self.camera, fit.X_WC)
            rows, points = search(whole, wanted, features, 6.0)
            fit = refine(self.camera, fit.X_WC, sights(whole, features, rows, points))
        except NotLocalised:
            return None
        least = max(self.settings.least_points, self.settings.seen_share * len(wanted.points))
        if np.count_nonzero(fit.inside) < least:
            return None
        return fit.X_WC, rows[fit.inside], points[fit.inside]

    def _predicted_fit(self, whole: ArMap, features: Features, t_s: float) -> CameraFit | None:
        """From the pose that the last motion goes on to."""
        before, last = self.map.frames[-2], self.map.frames[-1]
        share = (t_s - last.t_s) / max(last.t_s - before.t_s, 1e-9)
        moved = before.X_WC.inverse() @ last.X_WC
        guess = last.X_WC @ Pose(exp_so3(log_so3(moved.R) * share), moved.t_mm * share)
        try:
            wanted = visible(whole, looks(whole), self.camera, guess)
            found = search(whole, wanted, features, self.settings.search_px)
            fit = refine(self.camera, guess, sights(whole, features, *found))
        except NotLocalised:
            return None
        enough = max(self.settings.least_points, 0.5 * len(found[0]))
        return fit if np.count_nonzero(fit.inside) >= enough else None

    def _matched_fit(self, features: Features) -> CameraFit | None:
        """From descriptors alone, against the last key-frames: after a jerk, or when the scan was lost."""
        for frame in self.map.frames[-1:-4:-1]:
            known = np.flatnonzero(frame.landmarks >= 0)
            rows_a, rows_b = match(frame.features, features, known, np.arange(len(features.octaves)))
            if len(rows_a) < self.settings.least_points:
                continue
            fit = self._ransac(frame, rows_a, features, rows_b)
            if fit is not None:
                return fit
        return None

    def _ransac(self, frame: GrowingFrame, rows_a: Rows, features: Features, rows_b: Rows) -> CameraFit | None:
        cv2 = opencv()
        points = self.map.points[frame.landmarks[rows_a]]
        pixels = features.keypoints_px[rows_b]
        rays = self.camera.undistort(pixels)
        limit = 4.0 / self.camera.fx_px
        done, turn, shift, inside = cv2.solvePnPRansac(
            points, rays, np.eye(3), None, iterationsCount=200, reprojectionError=limit, flags=cv2.SOLVEPNP_AP3P
        )
        if not done or inside is None or len(inside) < self.settings.least_points // 2:
            return None
        chosen = inside.ravel()
        X_WC = Pose(cv2.Rodrigues(turn)[0], shift.ravel()).inverse()
        try:
            return refine(self.camera, X_WC, Sights(points[chosen], pixels[chosen], np.ones(len(chosen))))
        except NotLocalised:
            return None

    def _insert(self, picture: Picture, features: Features, X_WC: Pose, rows: Rows, points: Rows) -> None:
        frame = self.map.add_frame(picture.name, picture.t_s, X_WC, features)
        frame.landmarks[rows] = points
        self._found = len(rows)
        for other in self.map.frames[-2:-5:-1]:
            self.map.add_between(other, frame)
        newest = len(self.map.frames) - 1
        self.map.adjust(
            list(range(max(0, newest - self.settings.window + 1), newest + 1)), self.settings.window_iterations
        )
        self._told(picture)

    def _finish(self) -> None:
        """Drop what is seen once, look for every point everywhere, adjust all."""
        everything = list(range(len(self.map.frames)))
        self.map.drop_single()
        self.map.representative_descriptors()
        self.map.fuse()
        for _ in range(2):
            self.map.adjust(everything, 5)
        self.map.drop_single()
        self.map.representative_descriptors()
