"""What there is to see in a simulated cell: textured walls and boxes, markers, the component at its place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from docking.types import Array, Pose
from sim.camera import Patch, Picture, opencv

_TILE_MM = 400.0
_PX_PER_MM = 2.0
_STUCK, _STANDING = 1, 2
_PLATE_MM = 0.1
"""How far the print of a marker stands out from what it is stuck on."""


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
    cv2 = opencv()
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
    cv2, shape = opencv(), marker.shape
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
        for dx, dy in ((-145.0, -95.0), (145.0, -80.0), (-20.0, 105.0)):
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


def on_wall(x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """X_WP of an upright wall that faces -y of W (z up), its lower left corner at (x, y, z)."""
    return Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([x_mm, y_mm, z_mm]))
