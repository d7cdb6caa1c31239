"""What a difference between the two faces of an instrument says about the instrument.

A polar instrument turned over and aimed anew reads the same point. What differs is its own: a line of sight not square
to the tilting axis (collimation) shifts the reading level across the line of sight, a wrong zero of the vertical circle
(index) shifts it upright, each with opposite signs in the two faces; distances do not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.types import Array

_NEAR_PLUMB = 1e-6


@dataclass(frozen=True)
class FaceErrors:
    """Instrument errors by one point in both faces: half the differences of the directions, all of the distance's.

    `collimation_rad` is positive when face 1 reads to the left seen from the instrument (counter-clockwise about its
    vertical axis), `index_rad` when face 1 reads high. `sigma_rad` of both, `range_sigma_mm` of `range_mm`.
    """

    collimation_rad: float
    index_rad: float
    range_mm: float
    sigma_rad: float
    range_sigma_mm: float

    def words(self, sigmas: float = 3.0) -> str:
        """The parts in words, and which of them stands out of the noise."""
        parts = (
            ("collimation", self.collimation_rad, self.sigma_rad, "urad", 1e6),
            ("height index", self.index_rad, self.sigma_rad, "urad", 1e6),
            ("distance", self.range_mm, self.range_sigma_mm, "mm", 1.0),
        )
        told = ", ".join(f"{name} {scale * value:+.3g} {unit}" for name, value, _, unit, scale in parts)
        out = [name for name, value, sigma, _, _ in parts if not (abs(value) <= sigmas * sigma)]
        if not out:
            return f"{told}: within the noise"
        return f"{told}: {' and '.join(out)} beyond {sigmas:g} sigma"


def face_errors(one_T_mm: Array, two_T_mm: Array, cov_mm2: Array) -> FaceErrors:
    """Errors from one point's readings (3,) in face 1 and 2, Z of T upright; `cov_mm2` (3, 3) of their difference."""
    middle, gap = (one_T_mm + two_T_mm) / 2.0, one_T_mm - two_T_mm
    distance = float(np.linalg.norm(middle))
    line = middle / distance
    level = np.cross([0.0, 0.0, 1.0], line)
    # Straight above the instrument left and right mean nothing: any level direction serves to tell the size.
    plumb = not (np.linalg.norm(level) > _NEAR_PLUMB)
    level = np.array([0.0, 1.0, 0.0]) if plumb else level / np.linalg.norm(level)
    up = np.cross(line, level)
    across = float(np.sqrt(max(level @ cov_mm2 @ level, up @ cov_mm2 @ up)))
    return FaceErrors(
        collimation_rad=float(level @ gap) / (2.0 * distance),
        index_rad=float(up @ gap) / (2.0 * distance),
        range_mm=float(line @ gap),
        sigma_rad=across / (2.0 * distance),
        range_sigma_mm=float(np.sqrt(line @ cov_mm2 @ line)),
    )
