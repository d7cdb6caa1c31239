"""How far off the frame of a map may be at a place: it is held where the markers are, and drifts away from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.guidance.types import ArMap
from docking.types import Array

DRIFT_SHARE = 0.005
"""Standard deviation of a map's drift against the distance, far from the markers that hold it."""
_UNKNOWN_MM = 12.0
"""Where the circles could not be compared with their survey: as far as circles may disagree at all."""


@dataclass(frozen=True, eq=False)
class FrameError:
    """`circles_mm` (c, 3) of the markers that set the frame, W; `rms_mm` of these circles against their survey.

    Where markers contradict the majority together, `rms_mm` is their distance: the frame is not better than that.
    """

    circles_mm: Array
    rms_mm: float

    @staticmethod
    def of(ar_map: ArMap) -> FrameError:
        """From a map's layout and quality; no circles where it has no layout."""
        rms_mm, layout = ar_map.quality.marker_rms_mm, ar_map.layout
        if layout is None:
            return FrameError(np.zeros((0, 3)), rms_mm or 0.0)
        used = [k for k, i in enumerate(layout.ids) if i in ar_map.quality.markers_used]
        known_mm = max(ar_map.quality.doubt_mm, _UNKNOWN_MM if rms_mm is None else rms_mm)
        return FrameError(layout.circles_mm[used].reshape(-1, 3), known_mm)

    def away_sigma_mm(self, p_W_mm: Array) -> float:
        """Standard deviation (mm) that a place p_W (3,) has beyond that of the circles, by being away from them.

        Errors of the circles turn the frame about their middle; the map drifts away from them. The wider the circles
        span, the less of both.
        """
        if len(self.circles_mm) == 0:
            return 0.0
        distance = float(np.linalg.norm(self.circles_mm - p_W_mm, axis=1).min())
        if not distance > 0.0:
            return 0.0
        span = float(np.linalg.norm(np.ptp(self.circles_mm, axis=0)))
        return distance * float(np.hypot(self.rms_mm / max(span, 1e-9), DRIFT_SHARE * distance / (distance + span)))
