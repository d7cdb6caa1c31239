"""A stream of images: the pose of each, guided by the one before; found again after a loss; the map grows if wanted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import MapFrameDiffers, NotLocalised
from docking.geometry import exp_so3, log_so3
from docking.guidance.extension import Seen, extended, far_enough, little_known
from docking.guidance.localiser import Indexed, Localised, Localiser
from docking.guidance.types import ArMap, Image
from docking.types import Pose

_SAME_PLACE_MM = 1.0
_REACH_MM, _FASTEST_MM_S = 50.0, 2000.0
"""A hand-held camera moves slower than this."""
_LONGEST_GAP_S = 1.0
"""After so long without a pose the last one says nothing about the next."""


@dataclass
class TrackCounts:
    """What a stream went through so far."""

    frames: int = 0
    localised: int = 0
    losses: int = 0
    relocalised: int = 0
    keyframes_added: int = 0
    points_added: int = 0


class Tracker:
    """One stream of images in one map. `read_only` leaves the map as it is (default); else it is extended."""

    def __init__(self, localiser: Localiser, *, read_only: bool = True) -> None:
        self.localiser = localiser
        self.read_only = read_only
        self.counts = TrackCounts()
        self._past: list[tuple[float, Pose]] = []
        self._anchor: Seen | None = None

    def step(self, name: str, t_s: float, image: Image) -> Localised:
        """The pose of the next image. Raises NotLocalised.

        After that the stream is lost, and the next image is searched for in the whole map.
        """
        self.counts.frames += 1
        try:
            features = self.localiser.features(image)
            found = self.localiser.locate(image, features, self._predicted(t_s))
            self._check_jump(t_s, found)
        except NotLocalised:
            self.counts.losses += int(bool(self._past))
            self._past, self._anchor = [], None
            raise
        self.counts.localised += 1
        self.counts.relocalised += int(not self._past and self.counts.losses > 0)
        self._past = [*self._past[-1:], (t_s, found.X_WC)]
        if not self.read_only and found.source == "map":
            self._extend(Seen(name, t_s, found, features))
        return found

    def swap(self, index: Indexed) -> None:
        """Go on in another map of the same cell (built again after the scene changed), from the next image on.

        Poses stay in the frame of the cell; a registered device stays registered. Raises MapFrameDiffers for a map that
        is not in that frame, or whose markers stand at other places.
        """
        check_same_frame(self.localiser.ar_map, index.ar_map)
        self.localiser = self.localiser.on(index)
        self._anchor = None

    def _predicted(self, t_s: float) -> Pose | None:
        """X_WC at t_s, with the velocity of the last two poses in the camera's frame."""
        if not self._past or not 0.0 <= t_s - self._past[-1][0] <= _LONGEST_GAP_S:
            return None
        last_s, last = self._past[-1]
        if len(self._past) < 2:
            return last
        before_s, before = self._past[0]
        share = (t_s - last_s) / (last_s - before_s) if last_s > before_s else 0.0
        step = before.inverse() @ last
        return last @ Pose(exp_so3(share * log_so3(step.R)), share * step.t_mm)

    def _check_jump(self, t_s: float, found: Localised) -> None:
        """No hand moves so far between two images: one of the two poses is wrong, and neither is known to be right."""
        if not self._past or not 0.0 <= t_s - self._past[-1][0] <= _LONGEST_GAP_S:
            return
        reach = _REACH_MM + _FASTEST_MM_S * (t_s - self._past[-1][0])
        moved = float(np.linalg.norm(found.X_WC.t_mm - self._past[-1][1].t_mm))
        if not moved <= reach:
            cause = f"it would have jumped by {moved:.0f} mm since the image before"
            raise NotLocalised("image", cause, value=found.points, limit=found.points)

    def _extend(self, seen: Seen) -> None:
        """Grow the map from the anchor and this image, if both see enough that it does not know."""
        anchor = self._anchor
        if anchor is not None and not far_enough(anchor, seen):
            return
        self._anchor = seen
        grown = extended(self.localiser.index, anchor, seen) if anchor is not None and little_known(seen) else None
        if grown is not None:
            self.counts.keyframes_added += 2
            self.counts.points_added += len(grown.ar_map.points_mm) - len(self.localiser.ar_map.points_mm)
            self.localiser = self.localiser.on(grown)
            self._anchor = None


def check_same_frame(now: ArMap, then: ArMap) -> None:
    """Raises MapFrameDiffers unless poses in the map `then` mean the same as in `now`: markers at the same places."""
    if then.frame != "cell":
        raise MapFrameDiffers(
            "map", "it is in a frame of its own, not in that of the cell", value=then.frame, limit="cell"
        )
    ids = set(now.layout.ids if now.layout else ()) & set(then.layout.ids if then.layout else ())
    if now.layout is None or then.layout is None or not ids:
        raise MapFrameDiffers("map", "no marker is common to both maps", value=0, limit=1)
    rows = [(now.layout.ids.index(i), then.layout.ids.index(i)) for i in ids]
    moved = [float(np.max(np.abs(now.layout.circles_mm[a] - then.layout.circles_mm[b]))) for a, b in rows]
    # A marker may have been moved and surveyed anew; a frame that has moved takes most of them along.
    if not np.median(moved) <= _SAME_PLACE_MM:
        raise MapFrameDiffers(
            "map", "the markers' places differ, mm", value=float(np.median(moved)), limit=_SAME_PLACE_MM
        )
