"""A scanned wall without images: a free map, and the sightings of markers in its key-frames, exact or not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from docking.geometry import exp_so3
from docking.guidance.detection import MarkerSighting
from docking.guidance.marker_survey import Sightings
from docking.guidance.similarity import Similarity
from docking.guidance.types import ArMap, Camera, KeyFrame, MapQuality, MarkerLayout
from docking.types import Array, Pose

CAMERA = Camera(960, 720, 800.0, 800.0, 480.0, 360.0)
FREE = Similarity(0.7, exp_so3([0.3, -0.2, 0.5]), np.array([100.0, -50.0, 20.0]))
"""From the cell into the free map."""
_SQUARE = np.array([[-42.0, 42.0, 0.0], [42.0, 42.0, 0.0], [42.0, -42.0, 0.0], [-42.0, -42.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Wall:
    """The free map, its markers, what is seen of them, and the true poses X_WC."""

    free: ArMap
    layout: MarkerLayout
    sightings: Sightings
    truth: tuple[Pose, ...]


def layout_of_wall(markers: int = 6) -> MarkerLayout:
    """Markers in groups of three along x, each turned a little, survey without error."""
    rows = []
    for k in range(markers):
        centre = np.array([300.0 + 900.0 * (k // 3) + 130.0 * (k % 3), 400.0 + 180.0 * (k % 2), 5.0 * (k % 3)])
        rows.append(_SQUARE @ exp_so3([0.0, 0.0, 0.05 * k]).T + centre)
    return MarkerLayout(
        tuple(range(markers)), np.array(rows), np.full((markers, 4, 3), 0.1), "DICT_4X4_50", 50.0, 9.0, 42.0
    )


def marked_wall(frames: int = 14, points: int = 900, noise_px: float = 0.3, seed: int = 0) -> Wall:
    """A scan along 1.6 m of wall at 0.44 m, the camera upside down as in a hand (x right, y down, looking at -z)."""
    rng = np.random.default_rng(seed)
    layout = layout_of_wall()
    P = np.c_[rng.uniform(0.0, 1800.0, points), rng.uniform(100.0, 900.0, points), rng.uniform(-100.0, 60.0, points)]
    look = exp_so3([np.pi, 0.0, 0.0])
    truth, key_frames, sightings = [], [], []
    for i in range(frames):
        centre = [150.0 + 1400.0 * i / (frames - 1), 480.0 + 30.0 * np.sin(i), 440.0 + 15.0 * np.cos(i)]
        X = Pose(look @ exp_so3(rng.normal(0.0, 0.03, 3)), np.array(centre))
        truth.append(X)
        pixels = _inside(CAMERA.project(X.inverse().apply(P)))
        seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
        z = pixels[seen] + rng.normal(0.0, noise_px, (len(seen), 2))
        key_frames.append(_key_frame(i, FREE.apply_pose(X), z, seen, rng))
        sightings.append(tuple(_sightings(X, layout, noise_px / 20.0, rng)))
    free_points = FREE.apply(P)
    descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    free = ArMap("free", CAMERA, tuple(key_frames), free_points, descriptors, None, MapQuality())
    return Wall(free, layout, tuple(sightings), tuple(truth))


def _inside(pixels: Array) -> Array:
    inside = np.all((pixels > 0.0) & (pixels < (CAMERA.width_px, CAMERA.height_px)), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _key_frame(i: int, X: Pose, pixels: Array, seen: NDArray[np.intp], rng: np.random.Generator) -> KeyFrame:
    count = len(seen)
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    return KeyFrame(f"{i:04d}.png", 0.1 * i, X, pixels, np.zeros(count, np.int32), descriptors, seen.astype(np.int32))


def _sightings(X: Pose, layout: MarkerLayout, noise_px: float, rng: np.random.Generator) -> list[MarkerSighting]:
    found = []
    for index, marker in enumerate(layout.ids):
        circles = _inside(CAMERA.project(X.inverse().apply(layout.circles_mm[index])))
        if np.isfinite(circles[:, 0]).sum() < 3:
            continue
        centre = layout.circles_mm[index].mean(axis=0)
        R = np.c_[circles_axes(layout.circles_mm[index])]
        X_CM = X.inverse() @ Pose(R, centre)
        corners = CAMERA.project(X_CM.apply(_SQUARE * 25.0 / 42.0)) + rng.normal(0.0, 10.0 * noise_px, (4, 2))
        seen = circles + rng.normal(0.0, noise_px, (4, 2))
        found.append(MarkerSighting(marker, corners, seen, (X_CM,), (noise_px,)))
    return found


def circles_axes(circles_mm: Array) -> Array:
    """Axes (3, 3) of a marker: x right, y up, z towards the viewer, as columns."""
    x, y = circles_mm[1] - circles_mm[0], circles_mm[0] - circles_mm[3]
    x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def drifted(wall: Wall, bend_rad_per_m: float) -> Wall:
    """The same map after a drift: it bends about y as the scan goes on, by so much a metre."""

    def bent(points: Array, X: Pose | None = None) -> tuple[Array, Array]:
        angle = bend_rad_per_m * (points[..., 0] - 150.0) / 1000.0
        z = points[..., 2] + 0.5 * angle * (points[..., 0] - 150.0)
        return np.stack([points[..., 0], points[..., 1], z], axis=-1), angle

    back = _inverse(FREE)
    frames = []
    for frame in wall.free.keyframes:
        X = back.apply_pose(frame.X_WC)
        moved, angle = bent(X.t_mm)
        frames.append(replace(frame, X_WC=FREE.apply_pose(Pose(exp_so3([0.0, -float(angle), 0.0]) @ X.R, moved))))
    points = FREE.apply(bent(back.apply(wall.free.points_mm))[0])
    return replace(wall, free=replace(wall.free, keyframes=tuple(frames), points_mm=points))


def _inverse(s: Similarity) -> Similarity:
    return Similarity(1.0 / s.scale, s.R.T, -s.R.T @ s.t_mm / s.scale)


def ate_mm(ar_map: ArMap, truth: tuple[Pose, ...]) -> float:
    """RMS distance of the key-frames from their true places, not aligned."""
    error = [frame.X_WC.t_mm - X.t_mm for frame, X in zip(ar_map.keyframes, truth, strict=True)]
    return float(np.sqrt(np.mean(np.sum(np.square(error), axis=1))))
