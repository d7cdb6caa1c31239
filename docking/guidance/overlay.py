"""The picture of the cell with what is true in it: component, targets, deviations, the next move, the next part.

Nothing is drawn where the camera's pose could put it off by more than the limit; every picture says how old and how
good what it shows is.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from docking.errors import NotLocalised, OverlayUncertain
from docking.guidance.lettering import Colour, Letters
from docking.guidance.localiser import Localised
from docking.guidance.opencv import opencv
from docking.guidance.scene import Line, Mark, PartToPlace, Scene, Tone
from docking.guidance.types import Image
from docking.types import Array

COLOURS: Final[dict[Tone, Colour]] = {
    "good": (90, 200, 60),
    "close": (0, 190, 255),
    "bad": (60, 60, 240),
    "plain": (240, 220, 130),
    "dim": (170, 170, 170),
    "next": (255, 120, 220),
}
"""Okabe-Ito-like tones, apart in brightness too; words say the same for those who do not see the colours."""
_NEAREST_MM = 20.0
_STEPS_PER_LINE, _JUDGED = 24, 4
"""Lines are drawn in so many pieces, and judged at the end of every fourth."""
_AXIS_MM = 60.0


def draw(image: Image, found: Localised, scene: Scene, limit_mm: float) -> Image:
    """The picture (h, w, 3) with the scene in it. Raises OverlayUncertain where the anchor is too uncertain.

    Things further away than the anchor may be too uncertain alone: they are left out, and their number is said.
    """
    predicted = found.predicted_error_mm(scene.anchor_mm)
    if not predicted <= limit_mm:
        depth = float(found.X_WC.inverse().apply(scene.anchor_mm)[2])
        cause = f"{found.points} points from the {found.source}, {depth:.0f} mm away"
        raise OverlayUncertain("overlay", cause, value=round(predicted, 1), limit=limit_mm)
    picture = _Picture(image, found, limit_mm)
    for line in scene.lines:
        picture.line(line)
    for part in scene.parts:
        picture.part(part)
    for mark in scene.marks:
        picture.mark(mark)
    picture.margin(scene, predicted)
    return picture.finished()


def draw_refusal(image: Image, scene: Scene, error: NotLocalised | OverlayUncertain, text: str) -> Image:
    """The picture with nothing in it but why."""
    colour = _coloured(image)
    letters = Letters(_letter_size(colour))
    letters.put(8, 8, scene.captions["refused"].format(code=error.code, text=text), COLOURS["bad"])
    return letters.drawn(colour)


def _coloured(image: Image) -> Image:
    if image.ndim == 3:
        return image.copy()
    result: Image = opencv().cvtColor(image, opencv().COLOR_GRAY2BGR)
    return result


def _letter_size(image: Image) -> int:
    return max(12, int(image.shape[0]) // 45)


class _Picture:
    """One image being drawn on."""

    def __init__(self, image: Image, found: Localised, limit_mm: float) -> None:
        self._image = _coloured(image)
        self._found, self._limit_mm = found, limit_mm
        self._X_CW = found.X_WC.inverse()
        self._letters = Letters(_letter_size(self._image))
        self._left_out = 0

    def _pixels(self, points_W_mm: Array) -> Array:
        """Pixels (n, 2); NaN behind the camera, or so near that the projection means nothing."""
        p_C = self._X_CW.apply(points_W_mm)
        p_C = np.where(p_C[:, 2:] > _NEAREST_MM, p_C, np.nan)
        pixels = self._found.camera.project(p_C)
        size = self._image.shape[1]
        return np.where(np.abs(pixels) < 20 * size, pixels, np.nan)

    def _in_picture(self, points_W_mm: Array) -> NDArray[np.bool_]:
        """Which points (n, 3) the picture shows."""
        pixels = self._pixels(points_W_mm)
        inside: NDArray[np.bool_] = np.all((pixels >= 0.0) & (pixels < self._image.shape[1::-1]), axis=1)
        return inside

    def _certain(self, *places_W_mm: Array) -> bool:
        """Whether a thing that reaches to these places may be drawn; counts those that may not."""
        if not all(self._X_CW.apply(place)[2] > _NEAREST_MM for place in places_W_mm):
            return False
        good = all(self._found.predicted_error_mm(place) <= self._limit_mm for place in places_W_mm)
        self._left_out += int(not good)
        return good

    def line(self, line: Line) -> None:
        """The pieces of a line that are certain enough: the far end of a long one may not be."""
        share = np.linspace(0.0, 1.0, _STEPS_PER_LINE, endpoint=False)[:, None]
        fine = np.concatenate([*(a + share * (b - a) for a, b in pairwise(line.points_mm)), line.points_mm[-1:]])
        if not np.any(self._in_picture(fine)):
            return
        ends = fine[::_JUDGED]
        good = [self._found.predicted_error_mm(end) <= self._limit_mm for end in ends]
        for k, both in enumerate(pairwise(good)):
            if all(both):
                self._stroke(fine[k * _JUDGED : (k + 1) * _JUDGED + 1], line.tone, 2)
        self._left_out += int(not all(good))

    def _stroke(self, points_W_mm: Array, tone: Tone, width: int) -> None:
        pixels = self._pixels(points_W_mm)
        for a, b in pairwise(pixels):
            if np.all(np.isfinite([a, b])):
                opencv().line(self._image, _at(a), _at(b), COLOURS[tone], width, opencv().LINE_AA)

    def part(self, part: PartToPlace) -> None:
        """The edges of a part at its place, or its axes; where it reaches too far for that, only what it is."""
        if not self._certain(part.X_WP.t_mm):
            return
        if self._certain(*part.X_WP.apply(_reach_mm(part))):
            self._shape(part)
        where = self._pixels(part.X_WP.t_mm[None])[0]
        if part.words and np.all(np.isfinite(where)):
            self._letters.put(where[0] + 10, where[1] + 10, part.words, COLOURS[part.tone])

    def _shape(self, part: PartToPlace) -> None:
        if part.mesh is not None:
            self._faces(part)
            return
        for axis in np.eye(3) * _AXIS_MM:
            self._stroke(part.X_WP.apply(np.array([np.zeros(3), axis])), part.tone, 2)

    def _faces(self, part: PartToPlace) -> None:
        """Faces as a veil, sharp edges as lines."""
        mesh = part.mesh
        assert mesh is not None
        pixels = self._pixels(part.X_WP.apply(mesh.points_mm))
        whole = np.all(np.isfinite(pixels[mesh.triangles]), axis=(1, 2))
        veil = self._image.copy()
        for corners in np.round(pixels[mesh.triangles[whole]]).astype(np.int32):
            opencv().fillConvexPoly(veil, corners, COLOURS[part.tone])
        self._image = opencv().addWeighted(veil, 0.25, self._image, 0.75, 0.0)
        for a, b in mesh.edges():
            if np.all(np.isfinite(pixels[[a, b]])):
                opencv().line(self._image, _at(pixels[a]), _at(pixels[b]), COLOURS[part.tone], 1, opencv().LINE_AA)

    def mark(self, mark: Mark) -> None:
        if not self._certain(mark.at_mm):
            return
        at = self._pixels(mark.at_mm[None])[0]
        if not np.all(np.isfinite(at)):
            return
        cv2, colour = opencv(), COLOURS[mark.tone]
        if mark.kind == "feature":
            cv2.drawMarker(self._image, _at(at), colour, cv2.MARKER_DIAMOND, 16, 2, cv2.LINE_AA)
        else:
            cv2.circle(self._image, _at(at), 6 if mark.kind == "target" else 3, colour, 2, cv2.LINE_AA)
        if mark.vector_mm is not None:
            tip = self._pixels((mark.at_mm + mark.magnified * mark.vector_mm)[None])[0]
            if np.all(np.isfinite(tip)):
                cv2.arrowedLine(self._image, _at(at), _at(tip), colour, 2, cv2.LINE_AA, 0, 0.2)
        self._letters.put(at[0] + 9, at[1] - self._letters.size_px, mark.words, colour)

    def margin(self, scene: Scene, predicted_mm: float) -> None:
        """Head, quality, steps."""
        found, line = self._found, self._letters.size_px + 8
        words: dict[str, Any] = {
            "source": scene.captions[f"source_{found.source}"],
            "points": found.points,
            "rms_px": found.rms_px,
            "predicted_mm": predicted_mm,
            "depth_mm": float(self._X_CW.apply(scene.anchor_mm)[2]),
        }
        rows = [*scene.head, (scene.captions["quality"].format(**words), "plain")]
        if self._left_out:
            rows.append((scene.captions["left_out"].format(count=self._left_out, limit_mm=self._limit_mm), "close"))
        for k, (text, tone) in enumerate(rows):
            self._letters.put(8, 8 + k * line, text, COLOURS[tone], fixed=True)
        foot = self._image.shape[0] - 8 - len(scene.steps) * line
        for k, (text, tone) in enumerate(scene.steps):
            self._letters.put(8, foot + k * line, text, COLOURS[tone], fixed=True)

    def finished(self) -> Image:
        return self._letters.drawn(self._image)


def _reach_mm(part: PartToPlace) -> Array:
    """How far a part reaches in its own frame: the corners (8, 3) of its box, or the tips (3, 3) of its axes."""
    if part.mesh is None:
        return np.eye(3) * _AXIS_MM
    both = np.array([part.mesh.points_mm.min(axis=0), part.mesh.points_mm.max(axis=0)])
    return np.array([[both[i, 0], both[j, 1], both[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _at(pixel: Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
