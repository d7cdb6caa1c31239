"""From a free map to the cell: circles triangulated in the map, compared with their survey ([Huo] steps 2 and 3).

A marker that was moved, swapped or typed wrongly is named and left out; where no clear majority agrees, all is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from docking.errors import MapNotBuilt, MarkersDisagree, MarkersTooFew
from docking.guidance.detection import Gate, MarkerSighting
from docking.guidance.similarity import Similarity, closed_form, collinear, consistent, refined
from docking.guidance.triangulation import dlt, parallax_deg
from docking.guidance.types import ArMap, Camera, KeyFrame, MarkerLayout
from docking.types import Array

Sightings = tuple[tuple[MarkerSighting, ...], ...]
"""Of every key-frame: its markers."""


_SIZE_SHARE = 0.1


@dataclass(frozen=True)
class RegistrationSettings:
    """`gate` for the method as published; `wide_gate` where every observation has a weight of its own (joint).

    Circles agree within `tolerance_mm`, less where the markers stand close together: a map drifts by a share of its
    size, so a small one must fit better. `shape_mm`: how far a circle may be from the figure of its marker's four.
    """

    gate: Gate = field(default_factory=Gate)
    wide_gate: Gate = field(default_factory=lambda: Gate(distance_mm=2000.0, angle_deg=50.0, circles=1))
    tolerance_mm: float = 12.0
    near_tolerance_mm: float = 2.0
    drift_share: float = 0.005
    shape_mm: float = 1.5
    least_share: float = 0.6
    least_parallax_deg: float = 1.0
    spread_px: float = 4.0
    hull_share: float = 0.25


@dataclass(frozen=True, eq=False)
class Circles:
    """Circles seen in two views or more: `marker` and `circle` (c,), `points` (c, 3) in the map, `known_mm` (c, 3)."""

    marker: Array
    circle: Array
    points: Array
    known_mm: Array


@dataclass(frozen=True, eq=False)
class Registered:
    """The similarity, the circles that agree with it, and why the others do not (marker id -> words).

    `doubt_mm`: how far off markers are that agree with each other but not with the majority, 0 without such.
    """

    similarity: Similarity
    circles: Circles
    rejected: dict[int, str]
    doubt_mm: float = 0.0

    @property
    def markers(self) -> tuple[int, ...]:
        return tuple(sorted({int(i) for i in self.circles.marker}))

    @property
    def rms_mm(self) -> float:
        """Of the circles after the similarity."""
        error = self.similarity.apply(self.circles.points) - self.circles.known_mm
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def accepted(sightings: Sightings, gate: Gate) -> Sightings:
    """The sightings that pass a gate."""
    return tuple(tuple(s for s in frame if s.passes(gate)) for frame in sightings)


def views(sightings: Sightings, marker: int, circle: int) -> list[tuple[int, Array]]:
    """(key-frame row, pixel (2,)) of every view of one circle."""
    return [
        (row, s.circles_px[circle])
        for row, frame in enumerate(sightings)
        for s in frame
        if s.marker_id == marker and np.isfinite(s.circles_px[circle, 0])
    ]


def triangulated(
    frames: tuple[KeyFrame, ...],
    camera: Camera,
    layout: MarkerLayout,
    sightings: Sightings,
    settings: RegistrationSettings,
) -> tuple[Circles, dict[int, str]]:
    """All circles with parallax, and markers that are not at one place (moved in the scan, or a number used twice)."""
    rows, rejected = [], {}
    for index, marker in enumerate(layout.ids):
        for circle in range(4):
            seen = views(sightings, marker, circle)
            if len(seen) < 2:
                continue
            poses, pixels = [frames[row].X_WC for row, _ in seen], np.array([pixel for _, pixel in seen])
            point = dlt(poses, camera.undistort(pixels))
            centres = np.array([X.t_mm for X in poses])
            widest = max(float(parallax_deg(centres[0], c, point[None])[0]) for c in centres[1:])
            if not (widest >= settings.least_parallax_deg):
                continue
            errors = np.array([camera.project(X.inverse().apply(point)) for X in poses]) - pixels
            if not (float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) <= settings.spread_px):
                rejected[marker] = "its views do not meet in one place: moved during the scan, or the number used twice"
                continue
            rows.append((marker, circle, point, layout.circles_mm[index, circle]))
    rows = [row for row in rows if row[0] not in rejected]
    columns = [np.array([row[i] for row in rows]) for i in range(4)]
    return Circles(columns[0], columns[1], columns[2].reshape(-1, 3), columns[3].reshape(-1, 3)), rejected


def refuse_bent(ar_map: ArMap, layout: MarkerLayout, sightings: Sightings, settings: RegistrationSettings) -> None:
    """Raises MapNotBuilt where the views of most markers do not meet: then not they have moved, the map is wrong."""
    circles, apart = triangulated(ar_map.keyframes, ar_map.camera, layout, sightings, settings)
    meet = {int(marker) for marker in circles.marker}
    if len(apart) >= max(2, len(meet)):
        cause = f"the views of {len(apart)} of {len(apart) + len(meet)} markers do not meet: the map is bent, "
        cause += "the calibration is of another camera, or its poses are of other pictures"
        raise MapNotBuilt("markers", cause)


def register(ar_map: ArMap, layout: MarkerLayout, sightings: Sightings, settings: RegistrationSettings) -> Registered:
    """The similarity into the cell. Raises MarkersTooFew, MarkersDisagree."""
    _refuse_other_unit(layout)
    circles, rejected = triangulated(ar_map.keyframes, ar_map.camera, layout, sightings, settings)
    if len(circles.points) < 3 or collinear(circles.known_mm):
        cause = "; ".join(f"marker {i}: {why}" for i, why in rejected.items())
        raise MarkersTooFew("markers", cause, value=len(circles.points), limit=3)
    tolerance_mm = _tolerance_mm(circles, settings)
    similarity, agree = consistent(circles.points, circles.known_mm, tolerance_mm)
    rejected |= _reasons(circles, similarity, agree)
    agree &= _shapes(circles, similarity, agree, settings.shape_mm, rejected)
    if agree.sum() < 3 or not (agree.mean() > settings.least_share) or collinear(circles.known_mm[agree]):
        cause = f"only {int(agree.sum())} of {len(agree)} circles agree within {tolerance_mm:.1f} mm; "
        raise MarkersDisagree("markers", cause + "; ".join(f"marker {i}: {why}" for i, why in rejected.items()))
    kept = Circles(*(column[agree] for column in (circles.marker, circles.circle, circles.points, circles.known_mm)))
    doubt_mm = _doubt_mm(circles, similarity, settings, set(rejected))
    return Registered(refined(similarity, kept.points, kept.known_mm), kept, rejected, doubt_mm)


def _doubt_mm(circles: Circles, similarity: Similarity, settings: RegistrationSettings, rejected: set[int]) -> float:
    """How far off rejected markers are of which two form the figure of the survey.

    One marker alone was moved; two that moved alike stand on something that moved, or the map is bent between them and
    the majority. Nobody can say which, so the frame is not better than that anywhere.
    """
    moved = similarity.apply(circles.points)
    doubt = 0.0
    for a, b in combinations(sorted(rejected), 2):
        mine = (circles.marker == a) | (circles.marker == b)
        if not all(np.count_nonzero(circles.marker == i) >= 2 for i in (a, b)):
            continue
        known = circles.known_mm[mine]
        extent = float(np.linalg.norm(np.ptp(known, axis=0)))
        if _shape_error(moved[mine], known) <= settings.near_tolerance_mm + settings.drift_share * extent:
            doubt = max(doubt, float(np.linalg.norm(moved[mine] - known, axis=1).max()))
    return doubt


def _refuse_other_unit(layout: MarkerLayout) -> None:
    """A similarity takes any unit and any mixture of markers: the size of the marker itself must tell."""
    sides = np.linalg.norm(layout.circles_mm - np.roll(layout.circles_mm, 1, axis=1), axis=2)
    apart_mm, stated_mm = float(np.median(sides)), 2.0 * layout.circle_offset_mm
    if not (abs(apart_mm / stated_mm - 1.0) <= _SIZE_SHARE):
        cause = f"circles are {apart_mm:.4g} mm apart in the survey, {stated_mm:.4g} mm on the marker: another unit?"
        raise MarkersDisagree("markers", cause)


def _tolerance_mm(circles: Circles, settings: RegistrationSettings) -> float:
    extent = float(np.linalg.norm(np.ptp(circles.known_mm, axis=0)))
    return min(settings.tolerance_mm, settings.near_tolerance_mm + settings.drift_share * extent)


def _shapes(
    circles: Circles, similarity: Similarity, agree: NDArray[np.bool_], shape_mm: float, rejected: dict[int, str]
) -> NDArray[np.bool_]:
    """Which circles fit the other three of their marker; the drift of a map cannot bend so small a figure."""
    good = np.ones(len(circles.points), bool)
    for marker in np.unique(circles.marker[agree]):
        mine = np.flatnonzero((circles.marker == marker) & agree)
        if len(mine) < 4:
            continue
        moved, known = similarity.apply(circles.points[mine]), circles.known_mm[mine]
        whole = _shape_error(moved, known)
        if whole <= shape_mm:
            continue
        without = [_shape_error(np.delete(moved, k, 0), np.delete(known, k, 0)) for k in range(len(mine))]
        worst = int(np.argmin(without))
        good[mine[worst]] = False
        circle = int(circles.circle[mine[worst]])
        rejected[int(marker)] = f"circle {circle} does not fit the other three ({whole:.1f} mm): a typing error?"
    return good


def _shape_error(moved: Array, known: Array) -> float:
    """Largest distance (mm) after the best rigid motion."""
    R, t = closed_form(moved, known).R, known.mean(axis=0)
    return float(np.linalg.norm((moved - moved.mean(axis=0)) @ R.T + t - known, axis=1).max())


def _reasons(circles: Circles, similarity: Similarity, agree: NDArray[np.bool_]) -> dict[int, str]:
    """Words for every marker of which a circle does not agree."""
    error = similarity.apply(circles.points) - circles.known_mm
    words = {}
    for marker in sorted({int(i) for i in circles.marker[~agree]}):
        mine = circles.marker == marker
        off = np.linalg.norm(error[mine], axis=1)
        wrong = [int(c) for c in circles.circle[mine & ~agree]]
        if len(wrong) < int(mine.sum()):
            names = ", ".join(str(c) for c in wrong)
            words[marker] = f"circle {names} is {float(off.max()):.1f} mm off, the others agree: a typing error?"
        else:
            words[marker] = f"{float(np.mean(off)):.1f} mm away from its survey: moved, swapped or typed wrongly"
    return words


def in_cell(ar_map: ArMap, similarity: Similarity) -> ArMap:
    """The map in the cell's frame, mm."""
    frames = tuple(replace(frame, X_WC=similarity.apply_pose(frame.X_WC)) for frame in ar_map.keyframes)
    return replace(ar_map, frame="cell", keyframes=frames, points_mm=similarity.apply(ar_map.points_mm))
