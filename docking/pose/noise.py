"""Noise of point-by-point instruments: along the line of sight and across it.

A reading at distance d has the standard deviations
    range       sqrt( (range + range_per_mm d)^2 + offset^2 )
    transverse  transverse + transverse_per_mm d
and the covariance `u u^T s_r^2 + (I - u u^T) s_t^2`, u = unit line of sight, which is `diag(s_r^2, s_t^2, s_t^2)`
turned so that its first axis is u (docs/fit.md (9), (10)). A reflector never sits twice at the same place: its
repeatability in the nest adds `seating^2 I`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import BadArgument
from docking.types import Array


@dataclass(frozen=True)
class NoiseModel:
    """One standard deviation of an instrument; constants mm, slopes mm per mm of distance."""

    range_mm: float
    range_per_mm: float
    transverse_mm: float
    transverse_per_mm: float
    range_offset_mm: float = 0.0
    seating_mm: float = 0.0

    def __post_init__(self) -> None:
        if not (self.range_mm > 0.0 and self.transverse_mm > 0.0):
            raise BadArgument(
                "noise", "the constant parts must be positive", value=min(self.range_mm, self.transverse_mm)
            )
        others = (self.range_per_mm, self.transverse_per_mm, self.range_offset_mm, self.seating_mm)
        if not all(value >= 0.0 for value in others):
            raise BadArgument("noise", "slopes, offset and seating must not be negative")

    @classmethod
    def from_um(
        cls, range_um: float, range_um_per_m: float, transverse_um: float, transverse_um_per_m: float
    ) -> NoiseModel:
        """Model from the numbers of a cell file: micrometres, and micrometres per metre of distance."""
        return cls(range_um * 1e-3, range_um_per_m * 1e-6, transverse_um * 1e-3, transverse_um_per_m * 1e-6)

    def sigmas_mm(self, distance_mm: ArrayLike) -> tuple[Array, Array]:
        """(range, transverse) standard deviations (n,) at the distances (n,)."""
        d = np.asarray(distance_mm, dtype=np.float64)
        along: Array = np.hypot(self.range_mm + self.range_per_mm * d, self.range_offset_mm)
        across: Array = self.transverse_mm + self.transverse_per_mm * d
        return along, across

    def covariance(self, p_T_mm: ArrayLike) -> Array:
        """Covariance (n, 3, 3) in mm^2 of readings at `p_T_mm` (n, 3) in the station frame."""
        p = np.atleast_2d(np.asarray(p_T_mm, dtype=np.float64))
        d = np.linalg.norm(p, axis=1)
        if not bool(np.all(d > 0.0)):
            raise BadArgument(
                "noise", "a reading at the instrument's own origin has no line of sight", value=float(np.min(d))
            )
        along, across = self.sigmas_mm(d)
        u = p / d[:, None]
        sight = u[:, :, None] * u[:, None, :]
        isotropic = across**2 + self.seating_mm**2
        result: Array = isotropic[:, None, None] * np.eye(3) + (along**2 - across**2)[:, None, None] * sight
        return result


LASER_TRACKER = NoiseModel(0.005, 0.15e-6, 0.0075, 3.0e-6, 0.0025)
"""Leica AT500 class (user manual, p. 39), sigma = MPE / 2: ADM 10 um + 0.3 um/m, R0 5 um, transverse 15 um + 6 um/m."""

TOTAL_STATION = NoiseModel(0.6, 1.0e-6, 0.05, 4.85e-6)
"""Survey class: distance 0.6 mm + 1 ppm, directions 1 arcsec, 0.05 mm of centring; docs/fit.md."""

NOISE_PRESETS: dict[str, NoiseModel] = {"laser-tracker": LASER_TRACKER, "total-station": TOTAL_STATION}
