"""The pose of a camera from the markers it sees, where the map does not help: the measured circle centres and PnP."""

from __future__ import annotations

import numpy as np

from docking.errors import NotLocalised
from docking.guidance.detection import MarkerDetector, MarkerSighting
from docking.guidance.opencv import opencv
from docking.guidance.pose_only import CameraFit, Sights, refine
from docking.guidance.types import Camera, Image, MarkerLayout
from docking.types import Pose

CIRCLE_SIGMA_PX = 0.1
"""Of a circle's centre in a hand-held picture: blur and an imperfect print included."""
_MOST_RMS_PX = 2.0
_CLEARER = 2.0
"""With one marker: the second planar solution must fit this many times worse."""


def locate_by_markers(image: Image, layout: MarkerLayout, camera: Camera) -> tuple[CameraFit, Sights]:
    """X_WC from all circles of known markers. Raises NotLocalised: none seen, two poses possible, or they disagree."""
    seen = [m for m in MarkerDetector.of(layout, camera).detect(image) if m.seen == len(m.circles_px) and m.poses]
    if not seen:
        raise NotLocalised("image", "no marker with all its circles is in view", value=0, limit=1)
    sights = _sights(seen, layout)
    fit = refine(camera, _start(seen, sights, camera), sights)
    if not (fit.inside.all() and fit.rms_px <= _MOST_RMS_PX):
        cause = f"the markers {', '.join(str(m.marker_id) for m in seen)} do not agree: has one been moved?"
        raise NotLocalised("image", cause, value=int(np.count_nonzero(fit.inside)), limit=len(sights))
    return fit, sights


def _sights(seen: list[MarkerSighting], layout: MarkerLayout) -> Sights:
    rows = [layout.ids.index(m.marker_id) for m in seen]
    pixels = np.concatenate([m.circles_px for m in seen])
    return Sights(layout.circles_mm[rows].reshape(-1, 3), pixels, np.full(len(pixels), CIRCLE_SIGMA_PX))


def _start(seen: list[MarkerSighting], sights: Sights, camera: Camera) -> Pose:
    """X_WC to begin with. One flat marker has two poses: the better one, if it is clearly better."""
    if len(seen) == 1 and len(seen[0].errors_px) > 1:
        best, second = seen[0].errors_px[:2]
        if not second >= _CLEARER * best:
            cause = f"marker {seen[0].marker_id} alone fits two poses"
            raise NotLocalised("image", cause, value=f"{second / best:.1f} times", limit=f"{_CLEARER:.0f} times")
    cv2 = opencv()
    rays = camera.undistort(sights.pixels)
    flat = cv2.SOLVEPNP_IPPE if len(seen) == 1 else cv2.SOLVEPNP_SQPNP
    good, rotvec, shift = cv2.solvePnP(sights.points_mm, rays, np.eye(3), None, flags=flat)
    if not good:
        raise NotLocalised("image", "the circles do not decide the pose", value=len(sights), limit=4)
    return Pose(cv2.Rodrigues(rotvec)[0], shift.ravel()).inverse()
