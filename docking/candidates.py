"""Places where one more target could stand: on the sides of the part's bounding box that the instrument sees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.types import Array, Pose

EDGE_POINTS = 6
"""Places along each edge of a side."""
GRAZING = 0.17
"""Sine of the flattest angle between the line of sight and a side (10 deg): beyond it a reflector is not seen."""
_COVERED = 0.7
"""Cosine to the docking axis from which a side counts as the docking face, which the other part covers."""
_DEPTH_MM = 1.0


@dataclass(frozen=True, eq=False)
class Box:
    """A box with faces along the axes of its frame, which stands at `X_WB`: lower and upper corner (3,) in mm."""

    X_WB: Pose
    low_mm: Array
    high_mm: Array

    @classmethod
    def around(cls, X_WB: Pose, points_mm: Array) -> Box:
        """The bounding box of points (n, 3) of the frame B."""
        return cls(X_WB, points_mm.min(axis=0), points_mm.max(axis=0))


@dataclass(frozen=True, eq=False)
class Places:
    """Candidate points (k, 3) in the part's frame, and the outward normals (k, 3) of the sides they stand on."""

    xyz_mm: Array
    normal: Array


def places(box: Box, station_W_mm: Array, covered: Array, obstacles: Iterable[Box]) -> Places:
    """A grid on every side of `box` that faces the station and is not the docking face, without hidden places.

    `covered` (3,) outward normal of the docking face in the box's frame; `obstacles` hide what stands behind them.
    """
    eye = box.X_WB.inverse().apply(station_W_mm)
    found = [_side(box, axis, sign) for axis in range(3) for sign in (-1.0, 1.0)]
    sides = [(xyz, normal) for xyz, normal in found if not normal @ covered > _COVERED * np.linalg.norm(covered)]
    xyz = np.vstack([side for side, _ in sides])
    normal = np.vstack([np.tile(n, (len(side), 1)) for side, n in sides])
    sight = eye - xyz
    seen = np.sum(sight * normal, axis=1) > GRAZING * np.linalg.norm(sight, axis=1)
    for obstacle in obstacles:
        seen &= ~hidden(obstacle, station_W_mm, box.X_WB.apply(xyz))
    return Places(xyz[seen], normal[seen])


def _side(box: Box, axis: int, sign: float) -> tuple[Array, Array]:
    """Grid (m, 3) on one side, and its outward normal (3,)."""
    edges = [np.linspace(low, high, EDGE_POINTS) for low, high in zip(box.low_mm, box.high_mm, strict=True)]
    edges[axis] = np.array([box.high_mm[axis] if sign > 0.0 else box.low_mm[axis]])
    grid = np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid, sign * np.eye(3)[axis]


def hidden(obstacle: Box, station_W_mm: Array, points_W_mm: Array) -> NDArray[np.bool_]:
    """Truth (k,) of: the line from the station to the point (k, 3) goes through the obstacle."""
    inverse = obstacle.X_WB.inverse()
    begin, end = inverse.apply(station_W_mm), inverse.apply(points_W_mm)
    way = end - begin
    # A line that runs along a face neither enters nor leaves there: dividing by a tiny number keeps its sign.
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    ends = np.stack([(obstacle.low_mm + _DEPTH_MM - begin) / way, (obstacle.high_mm - _DEPTH_MM - begin) / way])
    enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    result: NDArray[np.bool_] = np.maximum(enter, 0.0) < np.minimum(leave, 1.0)
    return result
