"""How well a set of targets is spread: fewer than three, on a point or on a line is refused."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.errors import DegenerateTargets, TooFewPoints
from docking.pose.settings import FitSettings
from docking.types import Array

MIN_POINTS = 3


class Spread(NamedTuple):
    """Root mean square extent of a point set along its principal directions, largest first, mm."""

    long_mm: float
    middle_mm: float
    short_mm: float


def spread(points_mm: Array) -> Spread:
    """Principal extents of the points (n, 3)."""
    centred = points_mm - points_mm.mean(axis=0)
    s = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points_mm))
    s = np.concatenate([s, np.zeros(3)])
    return Spread(float(s[0]), float(s[1]), float(s[2]))


def check_layout(points_mm: Array, settings: FitSettings) -> None:
    """Refuse points (n, 3) that do not define a rotation.

    Raises TooFewPoints (n < 3), DegenerateTargets (one point, or one line: the rotation about it is arbitrary).
    """
    if not (len(points_mm) >= MIN_POINTS):
        raise TooFewPoints(settings.where, value=len(points_mm), limit=MIN_POINTS)
    extent = spread(points_mm)
    least = max(settings.spread_ratio * extent.long_mm, 1e-9 * float(np.max(np.abs(points_mm))), 1e-9)
    if not (extent.middle_mm >= least):
        raise DegenerateTargets(
            settings.where, f"their longest extent is {extent.long_mm:.6g} mm", value=extent.middle_mm, limit=least
        )
