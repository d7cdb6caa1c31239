"""Forces at the balls: reactions under gravity, internal force, warp. docs/mechanics.md (16) to (22).

A driven axis is a spring along itself; a passive axis carries nothing; a force-controlled follower exerts the force it
holds, wherever the component takes it. Forces are what the sockets exert on the component.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import BallReactionOut
from docking.kinematics.positioners import Positioners, axis_jacobian, ball_jacobian
from docking.types import Array, Pose

_CONDITION = 1e9
"""Condition of J^T K J above which the support is singular in double precision."""


@dataclass(frozen=True, eq=False)
class Load:
    """What the positioners carry: mass, centre of mass in C with its tolerance (3,), and gravity in W (3,), m/s^2."""

    mass_kg: float
    mass_tolerance_kg: float
    com_C_mm: Array
    com_tolerance_mm: Array
    gravity_m_s2: Array

    @property
    def heaviest_n(self) -> Array:
        """Weight vector in W (3,) with the mass at the upper end of its tolerance."""
        result: Array = (self.mass_kg + self.mass_tolerance_kg) * self.gravity_m_s2
        return result

    @property
    def lightest_n(self) -> Array:
        """Weight vector in W (3,) with the mass at the lower end of its tolerance."""
        result: Array = (self.mass_kg - self.mass_tolerance_kg) * self.gravity_m_s2
        return result

    @property
    def up(self) -> Array:
        """Unit vector against gravity in W (3,)."""
        result: Array = -self.gravity_m_s2 / np.linalg.norm(self.gravity_m_s2)
        return result

    def com_corners_C_mm(self) -> Array:
        """The centre of mass and the 2^3 corners of its tolerance box (9, 3)."""
        signs = np.array([(0, 0, 0), *itertools.product((-1, 1), repeat=3)], dtype=np.float64)
        result: Array = self.com_C_mm + signs * self.com_tolerance_mm
        return result


def axis_stiffness_n_per_mm(positioners: Positioners) -> Array:
    """Stiffness along each axis (m,): zero for a passive axis and for one that holds a force."""
    result: Array = np.where(positioners.driven, positioners.stiffness_n_per_mm.reshape(-1), 0.0)
    return result


def _axis_to_ball(positioners: Positioners) -> Array:
    """Map of axis forces to ball forces in W (3k, m): F_i = A_i^-T f_i, from the virtual work f^T A^-1 dp."""
    m = len(positioners.axes)
    result = np.zeros((m, m))
    for i, inverse in enumerate(positioners.axes_inverse):
        result[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = inverse.T
    return result


def ball_reactions_n(
    positioners: Positioners,
    balls_W_mm: ArrayLike,
    coms_W_mm: ArrayLike,
    weight_n: ArrayLike,
    held_n: Array | None = None,
) -> Array:
    """Reactions (c, k, 3) in W of the elastic support to `weight_n` (3,) acting at each of `coms_W_mm` (c, 3).

    Solves (J^T K J) x = w_g + J^T h for the small displacement x, then f = h - K J x, where h = `held_n` (m,) is what
    the force-controlled axes exert (their set force by default). Raises BallReactionOut when the driven axes do not
    hold the component.
    """
    balls, coms = np.asarray(balls_W_mm, dtype=np.float64), np.atleast_2d(np.asarray(coms_W_mm, dtype=np.float64))
    weight = np.asarray(weight_n, dtype=np.float64)
    centre = balls.mean(axis=0)
    length = float(np.sqrt(np.mean(np.sum((balls - centre) ** 2, axis=1))))
    scale = np.array([1.0, 1.0, 1.0, 1.0 / length, 1.0 / length, 1.0 / length])
    jac = axis_jacobian(positioners, balls, centre) * scale
    spring = axis_stiffness_n_per_mm(positioners)[:, None] * jac
    normal = jac.T @ spring
    condition = float(np.linalg.cond(normal))
    if not condition < _CONDITION:
        cause = "Condition of the support: the driven axes do not hold the component in six degrees of freedom."
        raise BallReactionOut("driven axes", cause, value=condition, limit=_CONDITION)
    held = (positioners.held_n if held_n is None else held_n)[:, None]
    wrench = np.hstack([np.broadcast_to(weight, coms.shape), np.cross(coms - centre, weight)]) * scale
    axis_forces = held - spring @ np.linalg.solve(normal, wrench.T + jac.T @ held)
    result: Array = (_axis_to_ball(positioners) @ axis_forces).T.reshape(len(coms), -1, 3)
    return result


def axis_forces_n(positioners: Positioners, forces_W_n: ArrayLike) -> Array:
    """Forces along the axes (..., m) of ball forces in W (..., k, 3): f_k = A_k^T F."""
    forces = np.asarray(forces_W_n, dtype=np.float64)
    result: Array = np.einsum("kji,...kj->...ki", positioners.axes_W, forces)
    return result.reshape(*forces.shape[:-2], -1)


def sink_mm(positioners: Positioners, reactions_n: ArrayLike) -> Array:
    """How far the balls are displaced in W (k, 3) by the compliance behind the motors under `reactions_n` (k, 3).

    A passive axis gives no force to sink under; one that holds a force sinks like a driven one.
    """
    stiffness = np.where(positioners.powered, positioners.stiffness_n_per_mm.reshape(-1), 0.0)
    compliance = np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0.0)
    give = -(axis_forces_n(positioners, reactions_n) * compliance).reshape(-1, 3)
    result: Array = np.einsum("kij,kj->ki", positioners.axes_W, give)
    return result


def consistency_projector(balls_W_mm: ArrayLike) -> Array:
    """N = I - J J^+ (3k, 3k): the part of ball displacements that no rigid motion explains; equation (12)."""
    balls = np.asarray(balls_W_mm, dtype=np.float64)
    centre = balls.mean(axis=0)
    jac = ball_jacobian(balls, centre).reshape(-1, 6)
    jac[:, 3:] /= np.linalg.norm(balls - centre, axis=1).max()
    basis = np.linalg.svd(jac, full_matrices=False)[0]
    result: Array = np.eye(len(jac)) - basis @ basis.T
    return result


def internal_force_matrix(positioners: Positioners, balls_W_mm: ArrayLike) -> Array:
    """G (3k, m): ball forces in W from axis position errors, K (I - J (J^T K J)^-1 J^T K) e on the driven axes."""
    balls = np.asarray(balls_W_mm, dtype=np.float64)
    centre = balls.mean(axis=0)
    jac = axis_jacobian(positioners, balls, centre)
    jac[:, 3:] /= np.linalg.norm(balls - centre, axis=1).max()
    stiffness = axis_stiffness_n_per_mm(positioners)
    spring = stiffness[:, None] * jac
    projected = np.diag(stiffness) - spring @ np.linalg.solve(jac.T @ spring, spring.T)
    result: Array = _axis_to_ball(positioners) @ projected
    return result


def internal_forces_n(forces_W_n: ArrayLike, reactions_n: ArrayLike) -> Array:
    """Internal force (k, 3): measured ball forces less the reactions that equilibrium needs; equation (21)."""
    result: Array = np.asarray(forces_W_n, dtype=np.float64) - np.asarray(reactions_n, dtype=np.float64)
    return result


def warp_rows(balls_W_mm: ArrayLike, up: ArrayLike) -> Array:
    """Warp modes (k - 3, k) of vertical ball forces: each row is in self-equilibrium, sum |row| = 1.

    Four balls on a rectangle give (+, -, +, -) / 4: the force that no rigid-body check sees. Three balls have none.
    """
    balls = np.asarray(balls_W_mm, dtype=np.float64)
    vertical = np.asarray(up, dtype=np.float64)
    level = balls - balls.mean(axis=0)
    level = level - np.outer(level @ vertical, vertical)
    along = np.linalg.svd(level)[2][:2]
    equilibrium = np.vstack([np.ones(len(balls)), (level @ along.T).T / np.abs(level).max()])
    modes = np.linalg.svd(equilibrium)[2][3:]
    signs = np.where(modes[:, :1] < 0.0, -1.0, 1.0)
    result: Array = signs * modes / np.sum(np.abs(modes), axis=1, keepdims=True)
    return result


@dataclass(frozen=True, eq=False)
class Reactions:
    """Extremes over the corners of the centre of mass and of the held forces: least upward force as a fraction of the
    equal share (k,), the least upward force in N (k,) and the largest |force| along each axis in N (m,)."""

    least_share: Array
    least_up_n: Array
    peak_axis_n: Array


def reaction_extremes(positioners: Positioners, X_WC: Pose, load: Load) -> Reactions:
    """Ball reactions with the component at X_WC, over the centre of mass and the corners of its tolerance.

    Where axes hold a force, also over the tolerances of these forces and with the least mass: what they do not take
    comes from the others.
    """
    balls, coms = X_WC.apply(positioners.balls_C_mm), X_WC.apply(load.com_corners_C_mm())
    followers = np.flatnonzero(positioners.followers)
    weights = [load.heaviest_n, load.lightest_n] if len(followers) else [load.heaviest_n]
    cases = []
    for weight, signs in itertools.product(weights, itertools.product((-1.0, 1.0), repeat=len(followers))):
        held = positioners.held_n.copy()
        held[followers] += np.array(signs) * positioners.held_tolerance_n[followers]
        cases.append(ball_reactions_n(positioners, balls, coms, weight, held))
    forces = np.concatenate(cases)
    upward = forces @ load.up
    share = np.linalg.norm(load.heaviest_n) / len(positioners.names)
    least = upward.min(axis=0)
    return Reactions(least / share, least, np.abs(axis_forces_n(positioners, forces)).max(axis=0))
