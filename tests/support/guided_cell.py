"""The laboratory cell before a textured wall with six markers: pictures of it, and a small map of that wall."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from docking.guidance.detection import MarkerDetector
from docking.guidance.images import Picture
from docking.guidance.map_build import Scanned, place
from docking.guidance.map_builder import BuilderSettings
from docking.guidance.map_methods import MethodSettings
from docking.guidance.posed_map import build_from_poses
from docking.guidance.types import ArMap, Camera, Image, MarkerLayout
from docking.types import Array, Pose
from sim.camera import Lens, SimulatedCamera
from sim.scenery import Scenery, WallSize, box, looking, on_wall, wall_scenery, with_patches

LENS = Lens(640, 480, 530.0, 319.5, 239.5, noise=1.5)
CAMERA = Camera(640, 480, 530.0, 530.0, 319.5, 239.5)
WALL = WallSize(1600.0, 1000.0, boxes=6, groups=2)
X_WP = on_wall(-350.0, 700.0, 500.0)
UP = (0.0, 0.0, 1.0)


class GuidedCell(NamedTuple):
    """What a test needs: the scenery without the component, the survey, the map."""

    scenery: Scenery
    layout: MarkerLayout
    ar_map: ArMap


def view(x_mm: float, z_mm: float, distance_mm: float = 900.0, turn_mm: float = 0.0, roll_deg: float = 0.0) -> Pose:
    """X_WC of a camera before the wall, that looks at a place `turn_mm` beside the one it stands before."""
    return looking(
        np.array([x_mm + turn_mm, 700.0, z_mm + 0.3 * turn_mm]),
        np.array([x_mm, 700.0 - distance_mm, z_mm]),
        roll_deg,
        UP,
    )


def layout_of(scenery: Scenery, noise_mm: float = 0.0) -> MarkerLayout:
    """The survey of its markers."""
    circles = np.array([marker.circles_mm for marker in scenery.markers])
    circles = circles + np.random.default_rng(5).normal(0.0, noise_mm, circles.shape)
    ids = tuple(marker.marker_id for marker in scenery.markers)
    return MarkerLayout(ids, circles, np.full(circles.shape, 0.1), "DICT_4X4_50", 50.0, 9.0, 42.0)


@cache
def guided_cell() -> GuidedCell:
    """Made once in a test process, in about two seconds."""
    scenery = wall_scenery(3, WALL, X_WP)
    layout = layout_of(scenery)
    camera = SimulatedCamera(scenery.patches, LENS, seed=2)
    rows = ((950.0, 850.0, 60.0), (1050.0, 750.0, -60.0))
    poses = [view(x, z, d, t) for z, d, t in rows for x in range(0, 1000, 140)]
    posed = [(Picture(f"{k:04d}", k / 10.0, camera.picture(X)), X) for k, X in enumerate(poses)]
    detector = MarkerDetector.of(layout, CAMERA)
    seen = []
    free = build_from_poses(
        CAMERA, posed, BuilderSettings(features=1200), lambda p: seen.append(tuple(detector.detect(p.image)))
    )
    settings = MethodSettings(camera_sigma=None)
    return GuidedCell(scenery, layout, place(Scanned(free, tuple(seen), 0.0), layout, "joint", settings))


def left_half() -> ArMap:
    """The map without the key-frames of the right half, and without the points that only they see."""
    ar_map = guided_cell().ar_map
    kept = [f for f in ar_map.keyframes if f.X_WC.t_mm[0] < 150.0]
    used = np.unique(np.concatenate([f.landmarks[f.landmarks >= 0] for f in kept]))
    rows = np.full(len(ar_map.points_mm), -1, np.int32)
    rows[used] = np.arange(len(used))
    frames = tuple(
        replace(f, landmarks=np.where(f.landmarks >= 0, rows[f.landmarks], -1).astype(np.int32)) for f in kept
    )
    return replace(ar_map, keyframes=frames, points_mm=ar_map.points_mm[used], descriptors=ar_map.descriptors[used])


def picture(X_WC: Pose, seed: int = 9, **shake: float) -> Image:
    """A picture of the cell as it was mapped."""
    return SimulatedCamera(guided_cell().scenery.patches, LENS, seed).picture(X_WC, **shake)


def with_component(X_WC_part: Pose, size_mm: Array) -> Scenery:
    """The cell with a box in the component's place, its middle at the origin of C."""
    return with_patches(guided_cell().scenery, box(X_WC_part, size_mm, np.random.default_rng(4)))


def write_layout(layout: MarkerLayout, path: Path) -> None:
    """The survey as a user's file."""
    rows = [
        f"{i},{k},{','.join(f'{v:.4f}' for v in layout.circles_mm[row, k])}"
        for row, i in enumerate(layout.ids)
        for k in range(4)
    ]
    head = "# DICT_4X4_50, ArUco side 50 mm, circles radius 9 mm at (+-42, +-42) mm"
    path.write_text("\n".join([head, "marker_id,circle,x_mm,y_mm,z_mm", *rows]) + "\n", "utf-8")
