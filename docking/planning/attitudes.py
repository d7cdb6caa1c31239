"""Ball swivel and ball reactions along a path, all samples at once: the attitude of the component decides both.

docs/mechanics.md (18), (19).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from math import ceil, degrees

import numpy as np

from docking.errors import BallReactionOut, BallSwivelExceeded
from docking.kinematics import Load, Positioners
from docking.kinematics.forces import axis_stiffness_n_per_mm
from docking.planning.path import carried_points
from docking.planning.settings import PlanSettings
from docking.types import Array, Correction, Pose

_LEAST_SAMPLES = 9
_TURN_RAD = 1e-3
"""Largest turn between two samples: reactions move by less than a part in a thousand."""
_MOST_SAMPLES = 200


def check_attitudes(X_WC: Pose, correction: Correction, positioners: Positioners, settings: PlanSettings) -> None:
    """Ball swivel and ball reactions along the path from X_WC; centre of mass +- its tolerance.

    Raises BallSwivelExceeded, or BallReactionOut under the least share of the weight or over an axis's rating.
    """
    angle = float(np.linalg.norm(correction.rotvec_rad))
    s = np.linspace(0.0, 1.0, min(max(_LEAST_SAMPLES, ceil(angle / _TURN_RAD)), _MOST_SAMPLES) + 1)
    frame = carried_points(correction, X_WC.apply(np.vstack([np.zeros(3), np.eye(3)]))).at(s)
    R = np.swapaxes(frame[:, 1:] - frame[:, :1], 1, 2)
    _check_swivel(R, s, positioners)
    _check_reactions(R, frame[:, 0], s, positioners, settings)


def _check_swivel(R_WC: Array, s: Array, positioners: Positioners) -> None:
    relative = positioners.neutral_R_WC.T @ R_WC
    # 2 asin(|R - 1| / sqrt 8) is exact for a rotation and keeps its digits near zero.
    apart = np.linalg.norm(relative - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    angle = 2.0 * np.arcsin(np.clip(apart, 0.0, 1.0))
    tightest = int(np.argmin(positioners.swivel_rad))
    limit = float(positioners.swivel_rad[tightest])
    if np.all(angle <= limit):
        return
    worst, first = int(np.argmax(angle)), int(np.argmax(~(angle <= limit)))
    fits = f"up to s = {s[first - 1]:.3f} it fits" if first > 0 else "already at the start"
    cause = f"At s = {s[worst]:.3f}; {fits}."
    raise BallSwivelExceeded(
        positioners.names[tightest], cause, value=degrees(float(angle[worst])), limit=degrees(limit)
    )


def _check_reactions(R_WC: Array, t_mm: Array, s: Array, positioners: Positioners, settings: PlanSettings) -> None:
    load = settings.load
    upward, along = reactions_along(R_WC, t_mm, positioners, load)
    share = float(np.linalg.norm(load.heaviest_n)) / len(positioners.names)
    limit = settings.reaction_min_fraction * share
    least, i = upward.min(axis=1), upward.argmin(axis=1)
    at = int(np.argmin(least))
    if not least[at] >= limit:
        cause = f"Least upward force over the tolerance of the centre of mass, at s = {s[at]:.3f}."
        raise BallReactionOut(positioners.names[i[at]], cause, value=float(least[at]), limit=limit)
    rated = positioners.rated_n.reshape(-1)
    use = along / rated
    at, k = (int(i) for i in np.unravel_index(int(np.argmax(use)), use.shape))
    if not use[at, k] <= 1.0:
        cause = f"Over the rating at s = {s[at]:.3f}."
        raise BallReactionOut(positioners.axes[k], cause, value=float(along[at, k]), limit=float(rated[k]))


def reactions_along(R_WC: Array, t_mm: Array, positioners: Positioners, load: Load) -> tuple[Array, Array]:
    """Least upward force of each ball (p, k) and largest |force| along each axis (p, m) at poses R (p, 3, 3), t (p, 3).

    Over the corners of the centre of mass, and of the held forces where axes hold one: `reaction_extremes` at p poses.
    Raises BallReactionOut when the driven axes do not hold the component.
    """
    balls = positioners.balls_C_mm @ np.swapaxes(R_WC, 1, 2) + t_mm[:, None, :]
    coms = load.com_corners_C_mm() @ np.swapaxes(R_WC, 1, 2) + t_mm[:, None, :]
    centre = balls.mean(axis=1, keepdims=True)
    scale = np.r_[np.ones(3), np.full(3, 1.0 / float(np.abs(balls - centre).max()))]
    jac = _axis_jacobians(positioners, balls - centre) * scale
    spring = axis_stiffness_n_per_mm(positioners)[:, None] * jac
    normal = np.swapaxes(jac, 1, 2) @ spring
    if not np.all(np.linalg.cond(normal) < 1e9):
        raise BallReactionOut("driven axes", "They do not hold the component in six degrees of freedom.")
    upward, along = np.inf, np.zeros(1)
    to_up = np.einsum("kji,j->ki", np.swapaxes(positioners.axes_inverse, 1, 2), load.up)
    for weight, held in _cases(positioners, load):
        torque = np.cross(coms - centre, weight)
        wrench = np.concatenate([np.broadcast_to(weight, torque.shape), torque], axis=2) * scale
        pushed = np.swapaxes(wrench, 1, 2) + (np.swapaxes(jac, 1, 2) @ held)[:, :, None]
        forces = held[:, None] - spring @ np.linalg.solve(normal, pushed)
        by_ball = forces.reshape(len(balls), -1, 3, forces.shape[2])
        upward = np.minimum(upward, np.einsum("pkjc,kj->pkc", by_ball, to_up).min(axis=2))
        along = np.maximum(along, np.abs(forces).max(axis=2))
    return np.asarray(upward), along


def _axis_jacobians(positioners: Positioners, arms_mm: Array) -> Array:
    """Axis displacements per twist (p, m, 6) for balls at `arms_mm` (p, k, 3) from the twist's point."""
    rows = np.zeros((*arms_mm.shape, 6))
    x, y, z = np.moveaxis(arms_mm, 2, 0)
    rows[..., :3] = np.eye(3)
    rows[..., 0, 4], rows[..., 0, 5] = z, -y
    rows[..., 1, 3], rows[..., 1, 5] = -z, x
    rows[..., 2, 3], rows[..., 2, 4] = y, -x
    result: Array = (positioners.axes_inverse @ rows).reshape(len(arms_mm), -1, 6)
    return result


def _cases(positioners: Positioners, load: Load) -> Iterator[tuple[Array, Array]]:
    """Weight (3,) and held forces (m,): one case, or all corners of the forces that followers hold."""
    followers = np.flatnonzero(positioners.followers)
    weights = [load.heaviest_n, load.lightest_n] if len(followers) else [load.heaviest_n]
    for weight, signs in itertools.product(weights, itertools.product((-1.0, 1.0), repeat=len(followers))):
        held = positioners.held_n.copy()
        held[followers] += np.array(signs) * positioners.held_tolerance_n[followers]
        yield weight, held
