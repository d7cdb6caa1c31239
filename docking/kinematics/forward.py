"""From axis positions to the pose of the component, and what fits no rigid body. docs/mechanics.md (10), (11)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from docking.errors import FrameImplausible
from docking.geometry import exp_so3
from docking.kinematics.positioners import Positioners, axis_displacements, axis_jacobian, socket_positions
from docking.types import Array, Pose

_STEP_MM = 1e-9
_ITERATIONS = 30


def pose_from_axes(positioners: Positioners, q_mm: ArrayLike, rows: NDArray[np.bool_] | None = None) -> Pose:
    """X_WC from axis positions `q_mm` (m,): least squares over the axes in the mask `rows` (m,), all by default.

    With six independent rows it is the exact Newton solution; with more it is the rigid fit of the balls to the
    sockets, weighted along the axes. Raises FrameImplausible when the iteration does not settle or the rows do not
    fix a pose.
    """
    used = np.ones(len(positioners.axes), dtype=np.bool_) if rows is None else rows
    sockets = socket_positions(positioners, q_mm)
    if not np.all(np.isfinite(sockets)):
        raise FrameImplausible("axis positions", "They are not all numbers.", value=float("nan"), limit=_STEP_MM)
    R = positioners.neutral_R_WC
    t = sockets.mean(axis=0) - R @ positioners.balls_C_mm.mean(axis=0)
    length = float(np.sqrt(np.mean(np.sum(positioners.balls_C_mm**2, axis=1)))) or 1.0
    step = np.full(6, np.inf)
    for _ in range(_ITERATIONS):
        balls = positioners.balls_C_mm @ R.T + t
        jac = axis_jacobian(positioners, balls, t)[used]
        jac[:, 3:] /= length
        gap = axis_displacements(positioners, sockets - balls)[used]
        step, _, rank, _ = np.linalg.lstsq(jac, gap, rcond=1e-9)
        if rank < 6:
            break
        t = t + step[:3]
        R = exp_so3(step[3:] / length) @ R
        if np.max(np.abs(step)) <= _STEP_MM:
            return Pose(R, t)
    worst = float(np.max(np.abs(step)))
    raise FrameImplausible("axis positions", "They fit no pose of the component.", value=worst, limit=_STEP_MM)


def figure_residual_mm(positioners: Positioners, q_mm: ArrayLike, X_WC: Pose) -> Array:
    """Socket less ball, e_i = o_i + A_i q_i - X_WC b_i (k, 3); equation (11)."""
    result: Array = socket_positions(positioners, q_mm) - X_WC.apply(positioners.balls_C_mm)
    return result
