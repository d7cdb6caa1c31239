"""What the devices add to a rigid plan by themselves: straight interpolation between rows, different starts and clocks.

docs/mechanics.md (40). Between two rows the axes go straight while the rigid figure bends: the part is squeezed by what
no rigid motion explains of the difference. Positioner i that starts dt_i late is v_i dt_i behind; with all starts
within the skew, the worst that the positioners can do together is half the sum of what each does alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import StrainForeseen
from docking.kinematics import Positioners, internal_force_matrix, socket_positions
from docking.planning.jam import residual_matrix, warp_matrix
from docking.planning.path import RigidPath
from docking.planning.settings import PlanSettings
from docking.types import Array

_MOST_ROWS = 600
"""Rows that are looked at; the differences change slowly along a plan."""


@dataclass(frozen=True)
class Strain:
    """Largest ball residual in mm, ball force in N and warp force in N at any instant of a plan."""

    residual_mm: float
    force_n: float
    warp_n: float


def foreseen_strain(path: RigidPath, s: Array, positioners: Positioners, settings: PlanSettings, T_s: float) -> Strain:
    """The strain of a table with rows at `s` (n,) over `T_s`. Raises StrainForeseen over a limit of the monitors."""
    rows = np.unique(np.linspace(0, len(s) - 2, min(len(s) - 1, _MOST_ROWS)).round().astype(int))
    first, last = path.axes_mm(s[rows]), path.axes_mm(s[rows + 1])
    bend = 0.5 * (first + last) - path.axes_mm(0.5 * (s[rows] + s[rows + 1]))
    period_s = T_s / (len(s) - 1)
    half_skew_s = 0.5 * (settings.start_skew_s + 2e-6 * settings.clock_ppm * T_s)
    late = (last - first) * (half_skew_s / period_s)
    residual, force, warp = _matrices(positioners, path.start_mm, settings)
    found = Strain(*(
        float(np.max(_size(bend @ m.T, width) + _by_positioner(late, m, width), initial=0.0))
        for m, width in ((residual, 3), (force, 3), (warp, 1))
    ))  # fmt: skip
    for value, limit, what in (
        (found.residual_mm, settings.jam.residual_mm, "ball residual in mm"),
        (found.force_n, settings.jam.force_n, "internal force in N"),
        (found.warp_n, settings.jam.warp_n, "warp in N"),
    ):
        if not value <= limit:
            cause = f"From the devices' interpolation and start; {100.0 * limit / value:.0f} % of the speed would fit."
            raise StrainForeseen(what, cause, value=value, limit=limit)
    return found


def _matrices(positioners: Positioners, q_mm: Array, settings: PlanSettings) -> tuple[Array, Array, Array]:
    """Ball residual (3k, m), ball force (3k, m) and warp (w, m) of axis errors."""
    balls = socket_positions(positioners, q_mm)
    warp = warp_matrix(positioners, balls, settings.load.up)
    return residual_matrix(positioners, balls), internal_force_matrix(positioners, balls), warp


def _size(flat: Array, width: int) -> Array:
    """Length of the vectors of `width` in each row (n, w): (n, w / width)."""
    result: Array = np.linalg.norm(flat.reshape(len(flat), -1, width), axis=2)
    return result


def _by_positioner(late_mm: Array, matrix: Array, width: int) -> Array:
    """Sum over the positioners of what each alone does when it is late: all axes of one start together."""
    total = np.zeros((len(late_mm), len(matrix) // width))
    for i in range(0, late_mm.shape[1], 3):
        total += _size(late_mm[:, i : i + 3] @ matrix[:, i : i + 3].T, width)
    return total
