"""A map from images whose poses another program found: features are matched again, since localisation needs its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from docking.errors import MapNotBuilt
from docking.guidance.features import extract
from docking.guidance.growing_map import GrowingMap
from docking.guidance.guided import looks
from docking.guidance.images import Picture
from docking.guidance.map_builder import BuilderSettings
from docking.guidance.trajectory import Trajectory
from docking.guidance.types import ArMap, Camera
from docking.types import Pose

MOST_FRAMES = 120
_SAME_TIME = 0.5
"""Of the time between two images: a pose that is further away belongs to another image."""
_JOIN_PX = 6.0


def poses_by_time(trajectory: Trajectory, times_s: list[float]) -> dict[int, Pose]:
    """Image row -> X_WC of the pose nearest in time."""
    step = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    found = {}
    for row, t_s in enumerate(times_s):
        k = int(np.argmin(np.abs(trajectory.t_s - t_s)))
        if abs(float(trajectory.t_s[k]) - t_s) <= _SAME_TIME * step:
            found[row] = trajectory.pose(k)
    return found


def build_from_poses(
    camera: Camera,
    posed: Iterable[tuple[Picture, Pose]],
    settings: BuilderSettings,
    key_frame: Callable[[Picture], None] | None = None,
) -> ArMap:
    """The map of images with poses in a free frame. Raises MapNotBuilt when too little of them can be matched."""
    grown = GrowingMap(camera)
    for picture, X_WC in posed:
        frame = grown.add_frame(picture.name, picture.t_s, X_WC, extract(picture.image, settings.features))
        if len(grown.points):
            whole = grown.snapshot()
            grown.join(frame, whole, looks(whole), _JOIN_PX)
        for other in grown.frames[-2:-5:-1]:
            grown.add_between(other, frame)
        if key_frame is not None:
            key_frame(picture)
    if len(grown.frames) < 3 or len(grown.points) < settings.least_points:
        cause = f"{len(grown.frames)} images with poses share {len(grown.points)} points: do the poses belong to them?"
        raise MapNotBuilt("import", cause)
    grown.drop_single()
    grown.representative_descriptors()
    grown.fuse()
    for _ in range(2):
        grown.adjust(list(range(len(grown.frames))), 8)
    grown.drop_single()
    grown.representative_descriptors()
    return grown.snapshot()


def thinned(rows: list[int]) -> list[int]:
    """At most MOST_FRAMES of some rows, evenly."""
    if len(rows) <= MOST_FRAMES:
        return rows
    return [rows[int(k)] for k in np.linspace(0, len(rows) - 1, MOST_FRAMES).round()]
