"""One image -> pose of its camera in the cell, or a named refusal: the library that commands and services call.

    image -> features -> key-frames alike (bag of words) -> matches -> PnP with RANSAC -> guided search -> robust pose

With a hint (the pose of the frame before) the search begins at the guided search. A pose is given only with enough
points that agree, spread over the image, and each says where it is from: `map` or `marker`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument, NotLocalised
from docking.guidance import guided
from docking.guidance.features import Features, extract, grey
from docking.guidance.frame_error import FrameError
from docking.guidance.marker_pose import locate_by_markers
from docking.guidance.opencv import opencv
from docking.guidance.pose_only import CameraFit, Sights, focal_misfit, refine, second_pose, seen_sigma_mm
from docking.guidance.types import ArMap, Camera, Image, MarkerLayout
from docking.guidance.vocabulary import Bags, bags_of, train
from docking.types import Array, Pose

Source = Literal["map", "marker"]
Rows = NDArray[np.intp]
_WIDE, _FEW = 3.0, 1000
"""How much wider the first search is than the others, and how many points it looks for."""
_MOST_SEARCHES = 7
_GROWTH = 1.01
"""A search that finds this many times the points of the one before is followed by another."""
_MOST_ADDED, _NEAR = 0.5, 0.2
"""Largest mean generation of the points that a pose may stand on, unless it is within so many depths of the hint."""
_LIMITS = 1.5
"""A pose that could draw a corner of the picture off by so many times the limit is none."""
_FOCUS, _FOCUS_SIGMAS, _FOCUS_TOLD = 0.01, 3.0, 0.015
"""The picture may ask for a focal length that is so much another, or so many of its sigmas, and no more; one that knows
it with a larger sigma than the last is not asked: there the errors of lens and map decide, which all its points share.
"""
COVERAGE = 2.0
"""Predicted errors are this many sigmas."""


@dataclass(frozen=True)
class LocaliseSettings:
    """What makes a pose believable, and how far it is searched.

    `map_sigma_mm` is the least standard deviation of a mapped place; the map's own figure counts where it is larger.
    `by_markers`: where the map does not help, markers in view may give the pose, and the pose says so.
    """

    candidates: int = 8
    least_matches: int = 15
    least_points: int = 40
    least_share: float = 0.15
    least_features: int = 200
    radius_px: float = 8.0
    ransac_px: float = 4.0
    most_rms_px: float = 3.5
    map_sigma_mm: float = 1.0
    limit_mm: float = 10.0
    by_markers: bool = True


@dataclass(frozen=True, eq=False)
class Localised:
    """The camera in the cell: X_WC, `cov` (6, 6) of [rotation rad, shift mm] in the camera's frame.

    `points` map points agree out of `expected` that the pose should see; `rms_px` of those; `depth_mm` their median
    depth. `map_sigma_mm` is the standard deviation of mapped places, shared by neighbouring points; `frame` what it is
    more away from the markers that hold it: those of the map, or those in view for a pose from markers. `generation` is
    0 where the points were in the map as built, and grows with those that tracking added.
    `feature_rows`, `point_rows` say which features of the image are which points of the map.
    """

    X_WC: Pose
    cov: Array
    source: Source
    points: int
    expected: int
    rms_px: float
    depth_mm: float
    map_sigma_mm: float
    generation: float
    camera: Camera
    frame: FrameError | None = None
    features: Features | None = None
    feature_rows: Rows = field(default_factory=lambda: np.zeros(0, np.intp))
    point_rows: Rows = field(default_factory=lambda: np.zeros(0, np.intp))

    def predicted_error_mm(self, p_W_mm: Array | None = None) -> float:
        """How far off a point of the cell may be drawn (COVERAGE sigmas, mm at its distance, across the line of sight).

        Without a point: at the median depth of the points seen, on the optical axis.
        """
        p_C = np.array([0.0, 0.0, self.depth_mm]) if p_W_mm is None else self.X_WC.inverse().apply(p_W_mm)
        away = 0.0 if self.frame is None else self.frame.away_sigma_mm(self.X_WC.apply(p_C))
        return COVERAGE * float(np.linalg.norm([seen_sigma_mm(self.cov, p_C), self.map_sigma_mm, away]))

    def corner_error_mm(self) -> float:
        """The predicted error at the worst corner of the picture, at the median depth, by this picture alone.

        Errors of the map are left out: they are the same whatever is seen.
        """
        camera = self.camera
        corners = np.array([[x, y] for x in (0.0, camera.width_px) for y in (0.0, camera.height_px)])
        rays = np.column_stack([camera.undistort(corners), np.ones(4)]) * self.depth_mm
        return COVERAGE * max(seen_sigma_mm(self.cov, ray) for ray in rays)

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the camera's position, mm: the largest of all directions."""
        return float(np.hypot(np.sqrt(np.linalg.eigvalsh(self.cov[3:, 3:])[-1]), self.map_sigma_mm))


@dataclass(frozen=True, eq=False)
class Indexed:
    """A map made ready for looking things up. `generation` (m,) of its points: 0 as built, see `extension`."""

    ar_map: ArMap
    bags: Bags
    looks: guided.Looks
    generation: Array


def indexed(ar_map: ArMap) -> Indexed:
    """Train the vocabulary on the map's descriptors and index its key-frames."""
    frames = [frame.descriptors for frame in ar_map.keyframes]
    bags = bags_of(train(np.concatenate(frames)), frames)
    return Indexed(ar_map, bags, guided.looks(ar_map), np.zeros(len(ar_map.points_mm)))


class Localiser:
    """Localises images in one map. `camera` is that of the images (default: the camera the map was made with)."""

    def __init__(
        self, ar_map: ArMap | Indexed, camera: Camera | None = None, settings: LocaliseSettings | None = None
    ) -> None:
        self.index = ar_map if isinstance(ar_map, Indexed) else indexed(ar_map)
        self._stated = camera
        self.camera = camera or self.index.ar_map.camera
        self.settings = settings or LocaliseSettings()
        self._frame = FrameError.of(self.index.ar_map)

    @property
    def ar_map(self) -> ArMap:
        """The map that is looked up; in the frame of the cell, mm."""
        return self.index.ar_map

    def on(self, index: Indexed) -> Localiser:
        """The same on another map: a camera that was not stated is that of the map, as it was adjusted with it."""
        return Localiser(index, self._stated, self.settings)

    def localise(self, image: Image, hint: Pose | None = None) -> Localised:
        """The pose of one image (h, w) or (h, w, 3). Raises NotLocalised with the cause, BadArgument, ExtraMissing."""
        return self.locate(image, self.features(image), hint)

    def features(self, image: Image) -> Features:
        """The features of an image of this camera, if worth a search. Raises NotLocalised, BadArgument."""
        size, wanted = image.shape[1::-1], (self.camera.width_px, self.camera.height_px)
        if size != wanted:
            raise BadArgument(
                "image", "the camera's calibration is for another size", value=str(size), limit=str(wanted)
            )
        features = extract(image)
        if len(features.keypoints_px) < self.settings.least_features:
            cause = "the image shows too few features (dark, blurred or bare)"
            raise NotLocalised("image", cause, value=len(features.keypoints_px), limit=self.settings.least_features)
        return features

    def locate(self, image: Image, features: Features, hint: Pose | None = None) -> Localised:
        """The pose of an image and its features: near the hint, else anywhere in the map, else by markers in view."""
        try:
            return self._in_map(features, hint)
        except NotLocalised:
            layout = self.ar_map.layout
            if not self.settings.by_markers or layout is None:
                raise
            try:
                return self._by_markers(image, layout)
            except NotLocalised:
                pass
            raise

    def _in_map(self, features: Features, hint: Pose | None) -> Localised:
        if hint is not None:
            try:
                return self._settled(features, hint)
            except NotLocalised:
                pass  # The camera may have been carried elsewhere: the whole map is searched.
        return self._anywhere(features, hint)

    def _by_markers(self, image: Image, layout: MarkerLayout) -> Localised:
        fit, sights = locate_by_markers(grey(image), layout, self.camera)
        seen = int(np.count_nonzero(fit.inside))
        if second_pose(self.camera, fit, sights):
            raise self._refused("two poses fit the markers", seen, len(sights))
        depth = float(np.median(fit.X_WC.inverse().apply(sights.points_mm)[:, 2]))
        # A doubt about the markers of the map is one about these; away from those in view the pose swings.
        sigma = max(self.settings.map_sigma_mm, self._frame.rms_mm)
        frame = FrameError(sights.points_mm, self._frame.rms_mm)
        return Localised(
            fit.X_WC, fit.cov, "marker", seen, len(sights), fit.rms_px, depth, sigma, 0.0, self.camera, frame
        )

    def _anywhere(self, features: Features, hint: Pose | None) -> Localised:
        first: NotLocalised | None = None
        for row in self.index.bags.alike(features.descriptors, self.settings.candidates):
            try:
                return self._on_built(self._settled(features, self._from_frame(features, row)), hint)
            except NotLocalised as error:
                first = first or error
        raise first or NotLocalised(
            "image", "nothing in the map looks like it", value=0, limit=self.settings.least_matches
        )

    def _on_built(self, found: Localised, hint: Pose | None) -> Localised:
        """The pose, if it stands on the map as built: what tracking has added leads on from near by, never begins."""
        near = hint is not None and float(np.linalg.norm(found.X_WC.t_mm - hint.t_mm)) <= _NEAR * found.depth_mm
        if not (near or found.generation <= _MOST_ADDED):
            cause = "what is in view was added while tracking, and alone does not prove a place"
            raise self._refused(cause, found.points, found.points)
        return found

    def _from_frame(self, features: Features, row: int) -> Pose:
        """X_WC by PnP on the matches with one key-frame."""
        frame = self.ar_map.keyframes[row]
        known = np.flatnonzero(frame.landmarks >= 0)
        matcher = opencv().BFMatcher(opencv().NORM_HAMMING, crossCheck=True)
        pairs = matcher.match(features.descriptors, frame.descriptors[known]) if len(known) else ()
        close = [(m.queryIdx, known[m.trainIdx]) for m in pairs if m.distance <= guided.MOST_BITS]
        if len(close) < self.settings.least_matches:
            raise self._refused("nothing in the map looks like it", len(close), self.settings.least_matches)
        mine, theirs = np.array(close, dtype=np.intp).T
        sights = guided.sights(self.ar_map, features, mine, frame.landmarks[theirs].astype(np.intp))
        return self._pnp(sights)

    def _pnp(self, sights: Sights) -> Pose:
        cv2, s = opencv(), self.settings
        xy = self.camera.undistort(sights.pixels)
        good, rotvec, shift, inside = cv2.solvePnPRansac(
            sights.points_mm, xy, np.eye(3), None, iterationsCount=300, confidence=0.999,
            reprojectionError=s.ransac_px / self.camera.fx_px, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not good or inside is None or len(inside) < s.least_matches:
            count = 0 if inside is None else len(inside)
            raise self._refused("what looks alike is not in the same place", count, s.least_matches)
        X_CW = Pose(cv2.Rodrigues(rotvec)[0], shift.ravel())
        return refine(self.camera, X_CW.inverse(), sights.where(inside.ravel())).X_WC

    def _settled(self, features: Features, X_WC: Pose) -> Localised:
        """Guided search and robust pose, wide and then narrow; judged. Raises NotLocalised."""
        found = 0
        for radius, most in (
            (2.0 * self.settings.radius_px, _FEW),
            *[(self.settings.radius_px, None)] * _MOST_SEARCHES,
        ):
            wanted = guided.visible(self.ar_map, self.index.looks, self.camera, X_WC).thinned(most)
            rows, points = guided.search(self.ar_map, wanted, features, radius)
            if len(rows) < self.settings.least_matches:
                raise self._refused("the map is not seen where it should be", len(rows), self.settings.least_points)
            fit = refine(self.camera, X_WC, guided.sights(self.ar_map, features, rows, points))
            X_WC, before = fit.X_WC, found
            found = int(np.count_nonzero(fit.inside)) if most is None else 0
            if before and found <= _GROWTH * before:
                break
        return self._judged(features, rows, points, fit, len(wanted.points))

    def _judged(self, features: Features, rows: Rows, points: Rows, fit: CameraFit, expected: int) -> Localised:
        """The pose, if enough points agree. Every comparison is written so that NaN refuses."""
        s, inside = self.settings, fit.inside
        count = int(np.count_nonzero(inside))
        if not count >= s.least_points:
            raise self._refused("too few points agree", count, s.least_points)
        if not count >= s.least_share * expected:
            raise self._refused("most of what should be seen is not", count, int(s.least_share * expected))
        if not fit.rms_px <= s.most_rms_px:
            raise self._refused(f"points agree only within {fit.rms_px:.1f} px", count, s.least_points)
        p_C = fit.X_WC.inverse().apply(self.ar_map.points_mm[points[inside]])
        depth = float(np.median(p_C[:, 2]))
        sights = guided.sights(self.ar_map, features, rows, points)
        if second_pose(self.camera, fit, sights):
            raise self._refused("two poses fit what is seen, turned about the part in view", count, s.least_points)
        larger, sigma = focal_misfit(self.camera, fit, sights)
        if not (sigma > _FOCUS_TOLD or abs(larger) <= max(_FOCUS, _FOCUS_SIGMAS * sigma)):
            cause = f"the focal length is {100.0 * larger:+.1f} % off its calibration: another camera, zoom or focus?"
            raise self._refused(cause, count, count)
        generation = float(np.mean(self.index.generation[points[inside]]))
        sigma = max(s.map_sigma_mm, self._frame.rms_mm) * float((1.0 + generation) ** 1.5)
        found = Localised(
            fit.X_WC, fit.cov, "map", count, expected, fit.rms_px, depth, sigma, generation,
            self.camera, self._frame, features, rows[inside], points[inside],
        )  # fmt: skip
        reach = found.corner_error_mm()
        if not reach <= _LIMITS * s.limit_mm:
            raise self._refused(
                f"what is seen leaves the corners of the picture {reach:.0f} mm uncertain", count, count
            )
        return found

    def _refused(self, cause: str, count: int, needed: int) -> NotLocalised:
        return NotLocalised("image", cause, value=count, limit=needed)
