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
_LEAST_MARKERS = 2
"""One marker fits its own four circles wherever it hangs: only a second one shows that neither was moved."""


def locate_by_markers(image: Image, layout: MarkerLayout, camera: Camera) -> tuple[CameraFit, Sights]:
    """X_WC from all circles of known markers. Raises NotLocalised: fewer than two in view, or they disagree."""
    seen = [m for m in MarkerDetector.of(layout, camera).detect(image) if m.seen == len(m.circles_px) and m.poses]
    if len(seen) < _LEAST_MARKERS:
        cause = f"marker {seen[0].marker_id} alone does not prove its place" if seen else "no whole marker is in view"
        raise NotLocalised("image", cause, value=len(seen), limit=_LEAST_MARKERS)
    sights = _sights(seen, layout)
    fit = refine(camera, _start(sights, camera), sights)
    if not (fit.inside.all() and fit.rms_px <= _MOST_RMS_PX):
        cause = f"the markers {', '.join(str(m.marker_id) for m in seen)} do not agree: has one been moved?"
        raise NotLocalised("image", cause, value=int(np.count_nonzero(fit.inside)), limit=len(sights))
    return fit, sights


def _sights(seen: list[MarkerSighting], layout: MarkerLayout) -> Sights:
    rows = [layout.ids.index(m.marker_id) for m in seen]
    pixels = np.concatenate([m.circles_px for m in seen])
    return Sights(layout.circles_mm[rows].reshape(-1, 3), pixels, np.full(len(pixels), CIRCLE_SIGMA_PX))


def _start(sights: Sights, camera: Camera) -> Pose:
    """X_WC to begin with."""
    cv2 = opencv()
    rays = camera.undistort(sights.pixels)
    good, rotvec, shift = cv2.solvePnP(sights.points_mm, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not good:
        raise NotLocalised("image", "the circles do not decide the pose", value=len(sights), limit=4)
    return Pose(cv2.Rodrigues(rotvec)[0], shift.ravel()).inverse()
