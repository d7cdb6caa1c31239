"""The parts that the study fits: ten targets each, coordinates in mm in the part's own frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from docking.geometry import exp_so3
from docking.types import Array, Pose

Generator = np.random.Generator

POINTS = 10
RADIUS_MM, HALF_LENGTH_MM = 1975.0, 4500.0
_TOGETHER, _FRESH = 4096, 100
"""Draws of one pose, and of one layout where the layouts are drawn too."""
_LEAST_HEIGHT = 0.05
"""Height of the largest triangle over its longest side below which drawn points count as a line and are drawn anew."""


def barrel_frames(rng: Generator, n: int = POINTS) -> Array:
    """Targets on the two end frames of a fuselage section, by turns, evenly but not symmetrically around."""
    k = np.arange(n)
    x = np.where(k % 2 == 0, -HALF_LENGTH_MM, HALF_LENGTH_MM)
    angle = (k // 2) * 1.19 + np.where(k % 2 == 0, 0.1, 0.5)
    return np.column_stack([x, RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)])


def random_barrel(rng: Generator, n: int = POINTS) -> Array:
    """Targets anywhere on the skin of the same section."""
    x, angle = rng.uniform(-HALF_LENGTH_MM, HALF_LENGTH_MM, n), rng.uniform(0.0, 2.0 * np.pi, n)
    return np.column_stack([x, RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)])


def wing(rng: Generator, n: int = POINTS) -> Array:
    """Targets along the front and the rear spar of a swept wing, from the root to the tip, with 5 degrees dihedral."""
    span = 15000.0 * (np.arange(n) // 2) / max((n - 1) // 2, 1)
    share = span / 15000.0
    chord = 4000.0 - 2500.0 * share
    x = 5000.0 * share + np.where(np.arange(n) % 2 == 0, 0.15, 0.65) * chord
    z = span * np.tan(np.radians(5.0)) + np.where(np.arange(n) % 4 < 2, 0.05, -0.05) * chord
    return np.column_stack([x, span, z])


def box(rng: Generator, n: int = POINTS) -> Array:
    """Targets anywhere in a box of 8 x 4 x 4 m."""
    return rng.uniform(-0.5, 0.5, (n, 3)) * (8000.0, 4000.0, 4000.0)


@dataclass(frozen=True)
class Layout:
    """A way to place targets; `fresh`: drawn anew for every hundred draws of the errors."""

    name: str
    words: str
    place: Callable[[Generator, int], Array]
    fresh: bool = False

    def targets(self, rng: Generator, n: int = POINTS) -> Array:
        """Targets (n, 3) that are no line."""
        while True:
            points = self.place(rng, n)
            first, second = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2]
            if second > _LEAST_HEIGHT * first:
                return points


BARREL = Layout("barrel, two frames", "radius 1.975 m, 9 m between the frames, five targets on each", barrel_frames)
RANDOM_BARREL = Layout("random barrel", "the same section, targets anywhere on its skin", random_barrel, fresh=True)
WING = Layout("wing", "15 m span, five targets along the front and five along the rear spar", wing)
BOX = Layout("box", "targets anywhere in 8 x 4 x 4 m", box, fresh=True)
LAYOUTS = (BARREL, RANDOM_BARREL, WING, BOX)


@dataclass(frozen=True)
class Block:
    """Targets (n, 3) in the part's frame, a pose X, and errors (b, n, 3) of the measured coordinates, 1 mm large."""

    nominal_mm: Array
    X: Pose
    unit: Array

    def measured_mm(self, amplitude_mm: float) -> Array:
        """Measured coordinates (b, n, 3) with errors uniform in +- amplitude."""
        measured: Array = self.X.apply(self.nominal_mm) + amplitude_mm * self.unit
        return measured


def random_pose(rng: Generator) -> Pose:
    """A pose of any attitude, up to ten metres away."""
    turn = rng.normal(size=3)
    return Pose(exp_so3(turn / np.linalg.norm(turn) * rng.uniform(0.0, np.pi)), rng.uniform(-10000.0, 10000.0, 3))


def blocks(layout: Layout, draws: int, rng: Generator, n: int = POINTS) -> Iterator[Block]:
    """`draws` sets of errors uniform in +-1 at random poses of the layout."""
    left, size = draws, _FRESH if layout.fresh else _TOGETHER
    while left > 0:
        b = min(size, left)
        yield Block(layout.targets(rng, n), random_pose(rng), rng.uniform(-1.0, 1.0, (b, n, 3)))
        left -= b
