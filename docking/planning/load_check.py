"""Is the part on the balls the part of the job? Mass, centre of mass and warp from the load cells.

docs/mechanics.md (23). The sockets' forces F at the balls p hold the weight: `m g = sum F . up`, and with
`M = sum p x F` the centre of mass stands at `up x M / (m g)` across the vertical. Its height does not show while the
part stands still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import LoadCellSilent, LoadUnexpected
from docking.kinematics import Load, Positioners, ball_reactions_n, warp_rows
from docking.planning.relief import LoadCellErrors, Weighing
from docking.types import Array, Pose

_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class FoundLoad:
    """What load cells say of a standing part: mass and its sigma, `off_mm` how far the centre of mass stands from the
    job's across the vertical and its sigma, `off_limit_mm` what the job's tolerance allows there, `warp_n` the largest
    warp of the vertical forces and its sigma (0 on three balls)."""

    mass_kg: float
    mass_sigma_kg: float
    off_mm: float
    off_sigma_mm: float
    off_limit_mm: float
    warp_n: float
    warp_sigma_n: float


def find_load(weighing: Weighing, X_WC: Pose, positioners: Positioners, load: Load, cells: LoadCellErrors) -> FoundLoad:
    """Judge a weighing of the part at X_WC. Raises LoadCellSilent where a ball is not weighed."""
    if not np.all(np.isfinite(weighing.force_n)):
        axis = positioners.axes[int(np.argmax(~np.isfinite(weighing.force_n)))]
        raise LoadCellSilent(axis, "The part is weighed when it has been lifted.")
    balls, com = X_WC.apply(positioners.balls_C_mm), X_WC.apply(load.com_C_mm)
    up, gravity = load.up, float(np.linalg.norm(load.gravity_m_s2))
    sigma = cells.sigma_n(weighing)
    to_W = np.transpose(positioners.axes_inverse, (0, 2, 1))
    forces = np.einsum("kij,kj->ki", to_W, weighing.force_n.reshape(-1, 3))
    weight_n = float((forces @ up).sum())
    arms = balls - com
    off = np.cross(up, np.cross(arms, forces).sum(axis=0)) / weight_n
    modes = warp_rows(balls, up)
    expected = ball_reactions_n(positioners, balls, com, load.mass_kg * load.gravity_m_s2)[0]
    warp = np.abs(modes @ ((forces - expected) @ up))
    per_axis = np.einsum("i,kij->kj", up, to_W).reshape(-1)
    turning = np.einsum("ab,kbj->kja", _cross(up), np.einsum("kab,kbj->kaj", _cross(arms), to_W)).reshape(-1, 3)
    lifted = np.repeat(modes, 3, axis=1) * per_axis
    corners = X_WC.R @ (load.com_corners_C_mm() - load.com_C_mm).T
    across = corners - np.outer(up, up @ corners)
    return FoundLoad(
        mass_kg=weight_n / gravity,
        mass_sigma_kg=float(np.linalg.norm(per_axis * sigma)) / gravity,
        off_mm=float(np.linalg.norm(off)),
        off_sigma_mm=float(np.linalg.norm(turning * sigma[:, None])) / abs(weight_n),
        off_limit_mm=float(np.linalg.norm(across, axis=0).max()),
        warp_n=float(warp.max(initial=0.0)),
        warp_sigma_n=float(np.linalg.norm(lifted * sigma, axis=1).max(initial=0.0)),
    )


def check_load(found: FoundLoad, load: Load, warp_limit_n: float) -> None:
    """Raise LoadUnexpected for a part that is not as heavy, not as balanced or not as even as the job says, by more
    than its tolerances and three sigmas of the load cells explain; a warp counts with no such grace."""
    for what, value, limit in (
        ("mass in kg, off the job's", abs(found.mass_kg - load.mass_kg),
         load.mass_tolerance_kg + _SIGMAS * found.mass_sigma_kg),
        ("centre of mass in mm, off the job's", found.off_mm, found.off_limit_mm + _SIGMAS * found.off_sigma_mm),
        ("warp of the balls in N", found.warp_n, warp_limit_n),
    ):  # fmt: skip
        if not (value <= limit):
            cause = f"The load cells find {found.mass_kg:.1f} kg, the job says {load.mass_kg:g} kg."
            raise LoadUnexpected(what, cause, value=value, limit=limit)


def _cross(vectors: Array) -> Array:
    """[v]x (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = (np.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero]))
    return np.stack(list(rows), -2)
