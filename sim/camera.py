"""Pictures of a simulated cell: a textured wall, boxes and markers, seen by a hand-held camera with its own faults.

Everything visible is made of flat patches with a texture. A patch is brought into the picture by the homography of its
plane, at twice the resolution and averaged, nearest last; the picture is then distorted as the true lens does.
Camera axes: x right, y down, z forward; pixel centres at integers. Nothing here is shared with the judged program.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from docking.errors import ExtraMissing
from docking.types import Array, Pose

Picture = NDArray[np.uint8]
_OVERSAMPLING = 2
_NEAREST_MM = 50.0


def opencv() -> Any:
    """OpenCV. Raises ExtraMissing."""
    try:
        return import_module("cv2")
    except ImportError as error:
        raise ExtraMissing("sim.camera", str(error), value="OpenCV", limit="pip install '.[guidance]'") from error


@dataclass(frozen=True)
class Lens:
    """The true camera: sizes px, focal length px, principal point px, radial distortion, grey noise (1 sigma)."""

    width_px: int = 960
    height_px: int = 720
    f_px: float = 800.0
    cx_px: float = 479.5
    cy_px: float = 359.5
    k1: float = 0.0
    k2: float = 0.0
    noise: float = 2.0


@dataclass(frozen=True, eq=False)
class Patch:
    """A flat rectangle: corner `origin_mm` (3,) in W, sides `u_mm`, `v_mm` (3,) along the texture's columns and rows.

    `layer` is drawn over all smaller ones: the wall, what is stuck on it, what stands before it. Within a layer the
    nearer covers the farther.
    """

    origin_mm: Array
    u_mm: Array
    v_mm: Array
    texture: Picture
    layer: int = 0

    @property
    def corners_mm(self) -> Array:
        """(4, 3), around the rectangle."""
        o, u, v = self.origin_mm, self.u_mm, self.v_mm
        return np.array([o, o + u, o + u + v, o + v])

    @property
    def normal(self) -> Array:
        """Towards the side from which the texture is seen upright: columns to the right, rows down."""
        return np.cross(self.v_mm, self.u_mm)


class SimulatedCamera:
    """Takes pictures of patches through a lens; the noise comes from `seed`."""

    def __init__(self, patches: tuple[Patch, ...], lens: Lens, seed: int = 1) -> None:
        self.patches, self.lens = patches, lens
        self._rng = np.random.default_rng(seed)
        self._maps = _distortion_maps(lens)

    def picture(self, X_WC: Pose, *, blur_px: float = 0.0) -> Picture:
        """The grey picture (h, w) from X_WC; `blur_px` is a horizontal shake during the exposure."""
        cv2, lens = opencv(), self.lens
        sharp = np.full(
            (lens.height_px * _OVERSAMPLING + 2 * _MARGIN, lens.width_px * _OVERSAMPLING + 2 * _MARGIN), 60, np.uint8
        )
        X_CW = X_WC.inverse()
        seen = [p for p in self.patches if float(p.normal @ (X_WC.t_mm - p.origin_mm)) > 0.0]
        for patch in sorted(seen, key=lambda p: (p.layer, -float(X_CW.apply(p.corners_mm)[:, 2].mean()))):
            _paint(sharp, patch, X_CW, lens)
        bent = cv2.remap(sharp, *self._maps, cv2.INTER_LINEAR)
        small = cv2.resize(bent, (lens.width_px, lens.height_px), interpolation=cv2.INTER_AREA).astype(np.float32)
        if blur_px > 0.0:
            length = max(1, round(blur_px))
            small = cv2.filter2D(small, -1, np.full((1, length), 1.0 / length, np.float32))
        noisy = small + self._rng.normal(0.0, lens.noise, small.shape).astype(np.float32)
        taken: Picture = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
        return taken


_MARGIN = 80
"""Pixels of the fine picture around it, for a lens that draws the edge inwards."""


def _fine(lens: Lens) -> tuple[float, float, float]:
    """Focal length and principal point in the fine, undistorted picture: pixel i covers fine pixels 2 i and 2 i + 1."""
    k = float(_OVERSAMPLING)
    return lens.f_px * k, (lens.cx_px + 0.5) * k - 0.5 + _MARGIN, (lens.cy_px + 0.5) * k - 0.5 + _MARGIN


def _paint(sharp: Picture, patch: Patch, X_CW: Pose, lens: Lens) -> None:
    """Draw one patch where it is seen; patches that come behind the camera are left out."""
    cv2 = opencv()
    corners = X_CW.apply(patch.corners_mm)
    if not np.all(corners[:, 2] > _NEAREST_MM):
        return
    f, cx, cy = _fine(lens)
    outline = corners[:, :2] / corners[:, 2:] * f + (cx, cy)
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 1, sharp.shape[::-1])
    if not np.all(high > low):
        return
    height, width = patch.texture.shape
    # Texture pixel (i, j) has its centre at ((i + 1/2) / width, (j + 1/2) / height) of the sides.
    o, u, v = X_CW.apply(patch.origin_mm), X_CW.R @ patch.u_mm / width, X_CW.R @ patch.v_mm / height
    K = np.array([[f, 0.0, cx - low[0]], [0.0, f, cy - low[1]], [0.0, 0.0, 1.0]])
    H = K @ np.column_stack([u, v, o + 0.5 * u + 0.5 * v])
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    texture = _reduced(patch.texture, corners, f)
    if texture.shape != patch.texture.shape:
        sx, sy = width / texture.shape[1], height / texture.shape[0]
        H = H @ np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    drawn = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round((outline - low) * 16.0).astype(np.int32), 255, cv2.LINE_8, 4)
    part = sharp[low[1] : high[1], low[0] : high[0]]
    part[mask > 0] = drawn[mask > 0]


def _reduced(texture: Picture, corners: Array, f: float) -> Picture:
    """The texture at about the resolution it is seen with: a finer one would flicker."""
    cv2 = opencv()
    seen_px = f * np.linalg.norm(corners[1] - corners[0]) / corners[:, 2].min()
    factor = texture.shape[1] / max(seen_px, 1.0)
    if factor < 1.5:
        return texture
    size = [max(2, round(n / factor)) for n in texture.shape[::-1]]
    reduced: Picture = cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
    return reduced


@cache
def _distortion_maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where every fine pixel of the distorted picture comes from in the undistorted one (Newton on the radius)."""
    k = float(_OVERSAMPLING)
    columns = np.arange(lens.width_px * _OVERSAMPLING)
    rows = np.arange(lens.height_px * _OVERSAMPLING)[:, None]
    x = ((columns + 0.5) / k - 0.5 - lens.cx_px) / lens.f_px
    y = ((rows + 0.5) / k - 0.5 - lens.cy_px) / lens.f_px
    seen = np.hypot(x, y)
    true = seen.copy()
    for _ in range(20):
        value = true * (1.0 + lens.k1 * true**2 + lens.k2 * true**4) - seen
        true -= value / (1.0 + 3.0 * lens.k1 * true**2 + 5.0 * lens.k2 * true**4)
    stretch = np.where(seen > 0.0, true / np.maximum(seen, 1e-12), 1.0)
    f, cx, cy = _fine(lens)
    return (x * stretch * f + cx).astype(np.float32), (y * stretch * f + cy).astype(np.float32)
