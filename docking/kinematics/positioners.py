"""Geometry of a set of three-axis positioners that carry one component on ball joints.

docs/mechanics.md (2) to (5), (8) and (9). k positioners with three axes each: m = 3 k, axis index 3 i + j. The socket
of positioner i stands at `p_i = o_i + A_i q_i`; the columns of A_i are the real axis directions times their scale.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from docking.types import Array, readonly

_LENGTHS = {
    "stroke_mm": "m2", "v_mm_s": "m", "a_mm_s2": "m", "j_mm_s3": "m", "a_quick_mm_s2": "m", "origins_W_mm": "k3",
    "axes_W": "k33", "stiffness_n_per_mm": "k3", "rated_n": "k3", "swivel_rad": "k", "balls_C_mm": "k3",
    "neutral_R_WC": "33", "held_n": "m", "held_tolerance_n": "m",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Positioners:
    """k positioners, m = 3 k axes, in the order of the cell file.

    `origins_W_mm` (k, 3) socket centres with all axes at zero, unloaded; `axes_W` (k, 3, 3) columns = axis directions
    times scale; `driven` (m,) axes that hold a position; `stroke_mm` (m, 2); `stiffness_n_per_mm`, `rated_n` (k, 3)
    along the axes; `swivel_rad` (k,) most a ball may turn in its socket away from `neutral_R_WC`, the orientation of
    the component in which the brackets are built to sit; `balls_C_mm` (k, 3) ball centres in the component frame;
    `held_n` (m,) force on the component along itself that a force-controlled axis holds, with `held_tolerance_n` (m,),
    both 0 for all others.
    """

    names: tuple[str, ...]
    axes: tuple[str, ...]
    origins_W_mm: Array
    axes_W: Array
    driven: NDArray[np.bool_]
    stroke_mm: Array
    v_mm_s: Array
    a_mm_s2: Array
    j_mm_s3: Array
    a_quick_mm_s2: Array
    stiffness_n_per_mm: Array
    rated_n: Array
    swivel_rad: Array
    balls_C_mm: Array
    neutral_R_WC: Array
    held_n: Array = field(default_factory=lambda: np.zeros(0))
    held_tolerance_n: Array = field(default_factory=lambda: np.zeros(0))
    axes_inverse: Array = field(init=False)

    def __post_init__(self) -> None:
        sizes = {"k": len(self.names), "m": 3 * len(self.names), "2": 2, "3": 3}
        for name in ("held_n", "held_tolerance_n"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.zeros(sizes["m"]))
        for name, letters in _LENGTHS.items():
            value = readonly(getattr(self, name))
            if value.shape != tuple(sizes[letter] for letter in letters):
                raise ValueError(f"{name} has shape {value.shape}, needs {letters} for {len(self.names)} positioners")
            object.__setattr__(self, name, value)
        driven = np.array(self.driven, dtype=np.bool_)
        if driven.shape != (sizes["m"],) or len(self.axes) != sizes["m"]:
            raise ValueError(f"driven and axes need {sizes['m']} entries")
        if np.any(driven & (self.held_n != 0.0)):
            raise ValueError("an axis holds a position or a force, not both")
        driven.setflags(write=False)
        object.__setattr__(self, "driven", driven)
        object.__setattr__(self, "axes_inverse", readonly(np.linalg.inv(self.axes_W)))

    @property
    def followers(self) -> NDArray[np.bool_]:
        """Axes (m,) that hold a force."""
        result: NDArray[np.bool_] = self.held_n != 0.0
        return result

    @property
    def powered(self) -> NDArray[np.bool_]:
        """Axes (m,) under power: those that hold a position and those that hold a force."""
        return self.driven | self.followers


def socket_positions(positioners: Positioners, q_mm: ArrayLike) -> Array:
    """Socket centres in W (..., k, 3) of the unloaded positioners at axis positions `q_mm` (..., m); equation (3)."""
    q = np.asarray(q_mm, dtype=np.float64)
    by_positioner = q.reshape(*q.shape[:-1], -1, 3)
    result: Array = positioners.origins_W_mm + np.einsum("kij,...kj->...ki", positioners.axes_W, by_positioner)
    return result


def axis_positions(positioners: Positioners, sockets_W_mm: ArrayLike) -> Array:
    """Axis positions (..., m) that bring the unloaded sockets to `sockets_W_mm` (..., k, 3); equation (4), absolute."""
    return axis_displacements(positioners, np.asarray(sockets_W_mm, dtype=np.float64) - positioners.origins_W_mm)


def axis_displacements(positioners: Positioners, shifts_W_mm: ArrayLike) -> Array:
    """Axis displacements (..., m) that move the sockets by `shifts_W_mm` (..., k, 3); equation (5), relative."""
    shifts = np.asarray(shifts_W_mm, dtype=np.float64)
    result: Array = np.einsum("kij,...kj->...ki", positioners.axes_inverse, shifts)
    return result.reshape(*shifts.shape[:-2], -1)


def ball_jacobian(balls_W_mm: ArrayLike, centre_W_mm: ArrayLike) -> Array:
    """Rows [I, -[p_i - c]x] (k, 3, 6): a twist [d (3), w (3)] about `centre_W_mm` moves ball i by d + w x (p_i - c)."""
    x, y, z = (np.asarray(balls_W_mm, dtype=np.float64) - np.asarray(centre_W_mm, dtype=np.float64)).T
    rows = np.zeros((len(x), 3, 6))
    rows[:, :, :3] = np.eye(3)
    rows[:, 0, 4], rows[:, 0, 5] = z, -y
    rows[:, 1, 3], rows[:, 1, 5] = -z, x
    rows[:, 2, 3], rows[:, 2, 4] = y, -x
    return rows


def axis_jacobian(positioners: Positioners, balls_W_mm: ArrayLike, centre_W_mm: ArrayLike) -> Array:
    """Axis displacements per twist about `centre_W_mm` (m, 6): row k is a_k^T [I, -[p_i - c]x]; equation (8)."""
    result: Array = (positioners.axes_inverse @ ball_jacobian(balls_W_mm, centre_W_mm)).reshape(-1, 6)
    return result


@dataclass(frozen=True)
class RankSettings:
    """When a set of driven axes counts as holding the component in all six degrees of freedom."""

    rotation_length_mm: float = 3000.0
    condition_max: float = 50.0
    sigma_min: float = 0.1


@dataclass(frozen=True)
class Conditioning:
    """How well the driven axes hold the component; `redundancy` = driven axes less six."""

    sigma_min: float
    condition: float
    redundancy: int
    full_rank: bool


def conditioning(positioners: Positioners, settings: RankSettings) -> Conditioning:
    """Singular values of the driven rows of the Jacobian about C's origin, rotations scaled by the settings' length."""
    balls = positioners.balls_C_mm @ positioners.neutral_R_WC.T
    rows = axis_jacobian(positioners, balls, np.zeros(3))[positioners.driven]
    rows[:, 3:] /= settings.rotation_length_mm
    if len(rows) < 6:
        return Conditioning(0.0, float("inf"), len(rows) - 6, full_rank=False)
    sigma = np.linalg.svd(rows, compute_uv=False)
    smallest = float(sigma[-1])
    condition = float(sigma[0] / smallest) if smallest > 1e-12 * sigma[0] else float("inf")
    good = smallest > settings.sigma_min and condition < settings.condition_max
    return Conditioning(smallest, condition, len(rows) - 6, good)
