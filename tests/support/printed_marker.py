"""A printed marker seen by a camera, rendered by area sampling: the truth of where its circles are is exact."""

from __future__ import annotations

import numpy as np

from docking.guidance.marker_sheet import MarkerDrawing, code_bits
from docking.guidance.types import Camera, Image
from docking.types import Array, Pose

SAMPLES = 4
BLACK, WHITE = 30.0, 220.0


def marker_grey(drawing: MarkerDrawing, marker_id: int, x_mm: Array, y_mm: Array) -> Array:
    """Grey of points of the sheet, marker axes x right, y up about its centre."""
    bits = np.array(code_bits(drawing.dictionary, marker_id))
    cell = drawing.side_mm / len(bits)
    column = np.floor((x_mm + drawing.side_mm / 2.0) / cell).astype(int)
    row = np.floor((drawing.side_mm / 2.0 - y_mm) / cell).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < len(bits)) & (row < len(bits))
    black = np.zeros(x_mm.shape, bool)
    black[inside] = bits[row[inside], column[inside]]
    o = drawing.offset_mm
    for i, j in ((-o, o), (o, o), (o, -o), (-o, -o)):
        black |= np.hypot(x_mm - i, y_mm - j) <= drawing.radius_mm
    return np.where(black, BLACK, WHITE)


def circles_px(camera: Camera, X_CM: Pose, drawing: MarkerDrawing) -> Array:
    """True images (4, 2) of the circles' centres, order as in a marker file."""
    o = drawing.offset_mm
    return camera.project(X_CM.apply(np.array([[-o, o, 0.0], [o, o, 0.0], [o, -o, 0.0], [-o, -o, 0.0]])))


def rendered(camera: Camera, X_CM: Pose, drawing: MarkerDrawing, marker_id: int, sigma: float, seed: int) -> Image:
    """The image of one marker on a white sheet without end, with grey noise of `sigma`."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    u = (np.arange(camera.width_px)[:, None] + steps).ravel()
    v = (np.arange(camera.height_px)[:, None] + steps).ravel()
    rays = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    to_plane = np.linalg.inv(np.c_[X_CM.R[:, :2], X_CM.t_mm])
    hit = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) @ to_plane.T
    grey = marker_grey(drawing, marker_id, hit[..., 0] / hit[..., 2], hit[..., 1] / hit[..., 2])
    shape = (camera.height_px, SAMPLES, camera.width_px, SAMPLES)
    image = grey.reshape(shape).mean(axis=(1, 3)) + np.random.default_rng(seed).normal(0.0, sigma, shape[::2])
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
