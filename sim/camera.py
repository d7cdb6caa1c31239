"""Pictures of a simulated cell: a textured wall, boxes and markers, seen by a hand-held camera with its own faults.

Everything visible is made of flat patches with a texture. A patch is brought into the picture by the homography of its
plane, at twice the resolution and averaged, nearest last; the picture is then distorted as the true lens does.
Camera axes: x right, y down, z forward; pixel centres at integers. Nothing here is shared with the judged program.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.errors import ExtraMissing
from docking.types import Array, Pose

Picture = NDArray[np.uint8]
_OVERSAMPLING = 2
_NEAREST_MM = 50.0
_TILE_MM = 400.0
_PX_PER_MM = 2.0
_STUCK, _STANDING = 1, 2
_PLATE_MM = 0.1
"""How far the print of a marker stands out from what it is stuck on."""


def _cv2() -> Any:
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


@dataclass(frozen=True)
class MarkerShape:
    """The print of a marker: an ArUco square and four circles at (+-offset, +-offset)."""

    dictionary: str = "DICT_4X4_50"
    side_mm: float = 50.0
    radius_mm: float = 9.0
    offset_mm: float = 42.0
    plate_mm: float = 116.0


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker on the wall: `X_WP` of its plate (x right, y up, z towards the viewer), id and shape."""

    marker_id: int
    X_WP: Pose
    shape: MarkerShape = MarkerShape()

    @property
    def circles_mm(self) -> Array:
        """True centres (4, 3) in W: top-left, top-right, bottom-right, bottom-left."""
        o, z = self.shape.offset_mm, _PLATE_MM
        return self.X_WP.apply(np.array([[-o, o, z], [o, o, z], [o, -o, z], [-o, -o, z]]))


@dataclass(frozen=True, eq=False)
class Scenery:
    """What there is to see; `patches` in W, the markers among them."""

    patches: tuple[Patch, ...]
    markers: tuple[Marker, ...]


def speckle(rng: np.random.Generator, width_px: int, height_px: int) -> Picture:
    """A texture with corners at many scales: grey blocks and spots of random size on a ground of soft shades."""
    cv2 = _cv2()
    soft = rng.uniform(90.0, 170.0, (max(2, height_px // 60), max(2, width_px // 60))).astype(np.float32)
    picture = cv2.resize(soft, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    count = max(30, width_px * height_px // 1200)
    sizes = np.minimum(rng.pareto(1.6, count) * 4.0 + 3.0, 60.0)
    places = rng.uniform((0, 0), (width_px, height_px), (count, 2))
    for size, (x, y), shade, angle in zip(
        sizes, places, rng.uniform(10.0, 245.0, count), rng.uniform(0.0, 90.0, count), strict=True
    ):
        if angle < 30.0:
            cv2.circle(picture, (round(x), round(y)), round(size / 2), float(shade), -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints(((x, y), (size, size * (0.4 + angle / 90.0)), angle))
            cv2.fillConvexPoly(picture, np.round(box).astype(np.int32), float(shade), cv2.LINE_AA)
    softened: Picture = np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7), 0, 255).astype(np.uint8)
    return softened


def tiles(X_WP: Pose, width_mm: float, height_mm: float, rng: np.random.Generator, layer: int = 0) -> list[Patch]:
    """A textured rectangle, lower left corner at the origin of P, x right, y up, in tiles small enough to project."""
    texture = speckle(rng, round(width_mm * _PX_PER_MM), round(height_mm * _PX_PER_MM))
    across, down = int(np.ceil(width_mm / _TILE_MM)), int(np.ceil(height_mm / _TILE_MM))
    x, y = np.linspace(0.0, width_mm, across + 1), np.linspace(0.0, height_mm, down + 1)
    found = []
    for x0, x1 in pairwise(x):
        for y0, y1 in pairwise(y):
            columns = slice(round(x0 * _PX_PER_MM), round(x1 * _PX_PER_MM))
            rows = slice(round((height_mm - y1) * _PX_PER_MM), round((height_mm - y0) * _PX_PER_MM))
            corner = X_WP.apply(np.array([x0, y1, 0.0]))
            sides = X_WP.R @ np.array([[x1 - x0, 0.0, 0.0], [0.0, y0 - y1, 0.0]]).T
            found.append(Patch(corner, sides[:, 0], sides[:, 1], texture[rows, columns], layer))
    return found


def box(X_WB: Pose, size_mm: Array, rng: np.random.Generator) -> list[Patch]:
    """The six textured faces of a box, centred at the origin of B."""
    found: list[Patch] = []
    a, b, c = np.asarray(size_mm, dtype=np.float64) / 2.0
    turns = [[0, 0, 0], [0, 90, 0], [0, 180, 0], [0, -90, 0], [90, 0, 0], [-90, 0, 0]]
    halves = [(a, b, c), (c, b, a), (a, b, c), (c, b, a), (a, c, b), (a, c, b)]
    for turn, (w, h, d) in zip(turns, halves, strict=True):
        R = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        face = Pose(R, R @ np.array([-w, -h, d]))
        found += tiles(X_WB @ face, 2.0 * w, 2.0 * h, rng, _STANDING)
    return found


def marker_patch(marker: Marker) -> Patch:
    """The plate with the print of a marker, just above what it is stuck on."""
    cv2, shape = _cv2(), marker.shape
    scale = 10.0
    size = round(shape.plate_mm * scale)
    plate: Picture = np.full((size, size), 235, np.uint8)
    side = round(shape.side_mm * scale)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, shape.dictionary))
    first = (size - side) // 2
    plate[first : first + side, first : first + side] = cv2.aruco.generateImageMarker(
        dictionary, marker.marker_id, side
    )
    # Pixel centres are integers: the middle of the plate lies between two of them. Circles in sixteenths of a pixel.
    middle, shift = (size - 1) / 2.0, 4
    for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        at = [round((middle + s * shape.offset_mm * scale) * 2**shift) for s in (x, y)]
        cv2.circle(plate, at, round(shape.radius_mm * scale * 2**shift), 20, -1, cv2.LINE_AA, shift)
    half = shape.plate_mm / 2.0
    X = marker.X_WP
    u, v = X.R @ np.array([shape.plate_mm, 0.0, 0.0]), X.R @ np.array([0.0, -shape.plate_mm, 0.0])
    return Patch(X.apply(np.array([-half, half, _PLATE_MM])), u, v, plate, _STUCK)


class SimulatedCamera:
    """Takes pictures of a scenery through a lens; the noise comes from `seed`."""

    def __init__(self, scenery: Scenery, lens: Lens, seed: int = 1) -> None:
        self.scenery, self.lens = scenery, lens
        self._rng = np.random.default_rng(seed)
        self._maps = _distortion_maps(lens)

    def picture(self, X_WC: Pose, *, blur_px: float = 0.0) -> Picture:
        """The grey picture (h, w) from X_WC; `blur_px` is a horizontal shake during the exposure."""
        cv2, lens = _cv2(), self.lens
        sharp = np.full(
            (lens.height_px * _OVERSAMPLING + 2 * _MARGIN, lens.width_px * _OVERSAMPLING + 2 * _MARGIN), 60, np.uint8
        )
        X_CW = X_WC.inverse()
        seen = [p for p in self.scenery.patches if float(p.normal @ (X_WC.t_mm - p.origin_mm)) > 0.0]
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
    cv2 = _cv2()
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
    cv2 = _cv2()
    seen_px = f * np.linalg.norm(corners[1] - corners[0]) / corners[:, 2].min()
    factor = texture.shape[1] / max(seen_px, 1.0)
    if factor < 1.5:
        return texture
    size = [max(2, round(n / factor)) for n in texture.shape[::-1]]
    reduced: Picture = cv2.resize(texture, size, interpolation=cv2.INTER_AREA)
    return reduced


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


def looking(
    at_mm: Array, from_mm: Array, roll_deg: float = 0.0, up: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> Pose:
    """X_WC of a camera at `from_mm` that looks at `at_mm`, its picture upright along `up`, turned by a roll."""
    z = np.asarray(at_mm, dtype=np.float64) - from_mm
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return Pose(R, np.asarray(from_mm, dtype=np.float64))


@dataclass(frozen=True)
class WallSize:
    """The wall of `wall_scenery`: sizes mm, number of boxes before it, number of groups of three markers."""

    width_mm: float = 3000.0
    height_mm: float = 1200.0
    boxes: int = 15
    groups: int = 3


def wall_scenery(seed: int, size: WallSize | None = None, X_WP: Pose | None = None) -> Scenery:
    """A wall in the plane z = 0 of P, x right, y up, with boxes before it and groups of three markers on it."""
    size, X_WP = size or WallSize(), X_WP or Pose.identity()
    rng = np.random.default_rng(seed)
    patches = tiles(X_WP, size.width_mm, size.height_mm, rng)
    markers = _groups(rng, size, X_WP)
    for _ in range(size.boxes):
        patches += _free_box(rng, size, X_WP, markers)
    return Scenery((*patches, *(marker_patch(m) for m in markers)), tuple(markers))


def _groups(rng: np.random.Generator, size: WallSize, X_WP: Pose) -> list[Marker]:
    """Three markers a group, within what one picture shows from 0.43 m."""
    markers: list[Marker] = []
    for g in range(size.groups):
        middle = np.array([size.width_mm * (g + 0.5) / size.groups, size.height_mm * rng.uniform(0.45, 0.6), 0.0])
        for dx, dy in ((-125.0, -75.0), (125.0, -60.0), (-20.0, 85.0)):
            turn = Rotation.from_euler("z", rng.uniform(-6.0, 6.0), degrees=True).as_matrix()
            place = np.add(middle, (dx + rng.uniform(-10.0, 10.0), dy + rng.uniform(-10.0, 10.0), 0.0))
            markers.append(Marker(len(markers), X_WP @ Pose(turn, place)))
    return markers


def _free_box(rng: np.random.Generator, size: WallSize, X_WP: Pose, markers: list[Marker]) -> list[Patch]:
    """One box standing out from the wall where no marker is; none where no place is found."""
    X_PW = X_WP.inverse()
    taken = [X_PW.apply(m.X_WP.t_mm)[:2] for m in markers]
    for _ in range(50):
        sides = rng.uniform((60.0, 60.0, 40.0), (200.0, 200.0, 150.0))
        place = rng.uniform((100.0, 100.0), (size.width_mm - 100.0, size.height_mm - 100.0))
        reach = 100.0 + float(np.hypot(*sides[:2])) / 2.0
        if all(float(np.hypot(*(place - t))) > reach for t in taken):
            turn = Rotation.from_euler("z", rng.uniform(0.0, 90.0), degrees=True).as_matrix()
            return box(X_WP @ Pose(turn, np.array([*place, sides[2] / 2.0])), sides, rng)
    return []


def with_patches(scenery: Scenery, patches: list[Patch]) -> Scenery:
    """The scenery with more to see: a component, a fixture."""
    return replace(scenery, patches=(*scenery.patches, *patches))
