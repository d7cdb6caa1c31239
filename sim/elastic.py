"""Static equilibrium of the component on its ball joints.

Each axis k of a positioner is a spring between socket and ball: gap `e_k = u_k - a_k.(p - o)` in axis coordinates
(a_k row k of the inverse of the positioner's direction matrix), force on the component `f_k = k_k (e_k + s_k)` along
itself, so the ball force is `sum_k f_k a_k` and the spring energy is consistent. The slip s_k is Coulomb play: it
yields when |f_k - h_k| exceeds the friction of the axis, inside +-clearance (infinite for a passive axis that slides
freely). h_k is the force that a force-controlled axis holds, 0 for all others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

BoolArray = NDArray[np.bool_]

_EYE = np.eye(3)
_CONVERGED_MM = 1e-8
_SLIDING_TANGENT = 1e-3
_MAX_ITERATIONS = 100
_RENEW_EVERY = 4
_SEARCH_AFTER = 5
_SEARCH_STEPS = 20
_SEARCH_SLOPE = 0.1


@dataclass(frozen=True)
class Supports:
    """The springs under the component: k balls, m = 3 k axes.

    `rows` (m, 3) the a_k; `origin_mm` (k, 3) sockets in W at zero; `stiffness` (m,) N/mm; `friction_n` (m,) and
    `clearance_mm` (m,) half play of the slip (friction infinite = never slips); `driven` (m,) bool: holds a position;
    `held_n` (m,) set force of the axes that hold a force, 0 for all others.
    """

    rows: Array
    origin_mm: Array
    stiffness: Array
    friction_n: Array
    clearance_mm: Array
    driven: BoolArray
    held_n: Array


@dataclass(frozen=True)
class _Load:
    """One problem: socket positions (m,), balls (k, 3), balls and centre of mass (k+1, 3) in C, weight (3,) in W."""

    socket_axis_mm: Array
    balls_mm: Array
    points_mm: Array
    weight_n: Array


@dataclass
class Body:
    """The rigid frame of the component: rotation (3, 3) and origin (3,) in W."""

    rotation: Array
    origin_mm: Array

    def place(self, points_mm: Array) -> Array:
        """Points (n, 3) of C in W."""
        placed: Array = points_mm @ self.rotation.T + self.origin_mm
        return placed

    def shifted(self, step: Array) -> Body:
        """The frame after a displacement (6,) [shift_mm, rotvec_rad] about its own origin."""
        return Body(_turn(step[3:]) @ self.rotation, self.origin_mm + step[:3])


def _turn(rotvec: Array) -> Array:
    """Rotation matrix of a rotation vector, by Rodrigues' formula."""
    x, y, z = rotvec.tolist()
    squared = x * x + y * y + z * z
    cross = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    if squared < 1e-12:
        # The terms left out are below 1e-19.
        sine, versine = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        angle = math.sqrt(squared)
        sine, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    turn: Array = _EYE + sine * cross + versine * (cross @ cross)
    return turn


def _moments(arms: Array, forces: Array) -> Array:
    """Row-wise r x f of (n, 3) arrays (np.cross costs ten times as much on small arrays)."""
    result = np.empty_like(arms)
    result[:, 0] = arms[:, 1] * forces[:, 2] - arms[:, 2] * forces[:, 1]
    result[:, 1] = arms[:, 2] * forces[:, 0] - arms[:, 0] * forces[:, 2]
    result[:, 2] = arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]
    return result


class Equilibrium:
    """Solves for the pose of the component; keeps the slips between solutions."""

    def __init__(self, supports: Supports, body: Body) -> None:
        count = len(supports.stiffness)
        self.supports = supports
        self.body = body
        self.slip_mm: Array = np.zeros(count)
        self.force_n: Array = np.zeros(count)
        self._blocks = supports.rows.reshape(-1, 3, 3)
        self._locked = np.zeros(count, dtype=bool)
        self._friction_n: Array = supports.friction_n.copy()
        self._limit_mm: Array = supports.friction_n / supports.stiffness
        self._held_mm: Array = np.zeros(count)
        self._driven_stiffness = np.where(supports.driven, supports.stiffness, 0.0)
        self._pattern = b""
        self._sliding = np.zeros(count, dtype=bool)
        self._inverse: Array = np.zeros((6, 6))
        self._map: Array = np.zeros((6, count))
        self._slide_map: Array = np.zeros((count, count))

    def lock(self, index: int, locked: bool) -> None:
        """Seize (or free) the slip of one axis."""
        self._locked[index] = locked
        self._limit_mm = np.where(self._locked, np.inf, self._friction_n) / self.supports.stiffness
        self._pattern = b""

    def hold(self, held_n: Array) -> None:
        """Let the axes that slide exert these forces (m,), give or take their friction."""
        self._held_mm = held_n / self.supports.stiffness
        self._pattern = b""

    def part(self, index: int) -> None:
        """One axis touches its ball no more: it exerts nothing, whatever it does."""
        self._friction_n[index] = 0.0
        self.lock(index, False)

    def jacobian(self, body: Body, balls_mm: Array) -> Array:
        """(m, 6): change of each ball's axis coordinate with the body's [shift, rotation]. Balls (k, 3) in C."""
        rows = self.supports.rows
        result = np.empty((len(rows), 6))
        result[:, :3] = rows
        result[:, 3:] = _moments(np.repeat(balls_mm @ body.rotation.T, 3, axis=0), rows)
        return result

    def axis_coordinates(self, body: Body, balls_mm: Array) -> Array:
        """(m,) position of each ball along each axis."""
        offset = body.place(balls_mm) - self.supports.origin_mm
        coordinates: Array = (self._blocks @ offset[:, :, None]).ravel()
        return coordinates

    def ball_forces_n(self, axis_forces_n: Array) -> Array:
        """(k, 3) forces in W from axis forces (m,)."""
        forces: Array = (axis_forces_n.reshape(-1, 1, 3) @ self._blocks)[:, 0, :]
        return forces

    def stress_free_n(self, body: Body, balls_mm: Array, com_mm: Array, weight_n: Array) -> Array:
        """(m,) the axis forces that equilibrium needs and no more: the stiffness-weighted least-norm reactions, beside
        the set forces of the axes that hold one."""
        jac, held = self.jacobian(body, balls_mm), self.supports.held_n
        scaled = self._driven_stiffness[:, None] * jac
        wrench = self._wrench(body, com_mm[None, :], weight_n[None, :]) + jac.T @ held
        forces: Array = held - scaled @ np.linalg.solve(jac.T @ scaled, wrench)
        return forces

    def advance(self, socket_shift_mm: Array) -> None:
        """Carry the body along with the sockets (m,) to first order: a good start for the next `solve`."""
        if socket_shift_mm.any():
            self.body = self.body.shifted(self._map @ socket_shift_mm)

    def solve(self, socket_axis_mm: Array, balls_mm: Array, com_mm: Array, weight_n: Array) -> None:
        """Update `body`, `slip_mm` and `force_n`.

        socket_axis_mm (m,): where the socket of each axis stands; balls_mm (k, 3), com_mm (3,) in C; weight_n (3,)
        in W.
        Newton with the tangent kept as long as it serves. Raises RuntimeError when it does not converge.
        """
        body = self.body
        load = _Load(socket_axis_mm, balls_mm, np.vstack((balls_mm, com_mm)), weight_n)
        for iteration in range(_MAX_ITERATIONS):
            slip, force, sliding, wrench = self._unbalanced(body, load)
            pattern = sliding.tobytes()
            if pattern != self._pattern or iteration % _RENEW_EVERY == _RENEW_EVERY - 1:
                self._pattern = pattern
                self._linearise(self.jacobian(body, balls_mm), sliding)
            step = self._inverse @ wrench
            size = np.abs(step)
            if float(size[:3].max()) < _CONVERGED_MM and float(size[3:].max()) < 1e-3 * _CONVERGED_MM:
                self.body, self.slip_mm, self.force_n = body, slip, force
                return
            if iteration >= _SEARCH_AFTER:
                step = self._searched(body, load, step, float(wrench @ step))
            body = body.shifted(step)
        raise RuntimeError("the component finds no equilibrium on its balls")

    def _unbalanced(self, body: Body, load: _Load) -> tuple[Array, Array, BoolArray, Array]:
        """Slip, force, sliding (m,) each, and the wrench (6,) that is left over, with the body at `body`."""
        slip, force, sliding = self._yielded(load.socket_axis_mm - self.axis_coordinates(body, load.balls_mm))
        forces = np.vstack((self.ball_forces_n(force), load.weight_n))
        return slip, force, sliding, self._wrench(body, load.points_mm, forces)

    def _searched(self, body: Body, load: _Load, step: Array, slope: float) -> Array:
        """`step` shortened or stretched to where the potential is least along it.

        The potential of springs and Coulomb slips is convex, so its slope along the line has one zero; without the
        search Newton's method can hop between two patterns of sliding axes for ever.
        """
        low, high, factor = 0.0, math.inf, 1.0
        for _ in range(_SEARCH_STEPS):
            rest = float(self._unbalanced(body.shifted(factor * step), load)[3] @ step)
            if abs(rest) <= _SEARCH_SLOPE * abs(slope):
                break
            low, high = (factor, high) if rest > 0.0 else (low, factor)
            factor = 2.0 * factor if high == math.inf else 0.5 * (low + high)
        return factor * step

    def passive_shift_mm(self, socket_shift_mm: Array) -> Array:
        """(m,) first-order slide of the passive sockets for a small motion (m,) of the driven ones since `solve`."""
        shift: Array = self._slide_map @ socket_shift_mm
        return shift

    def _linearise(self, jac: Array, sliding: BoolArray) -> None:
        sup = self.supports
        scaled = np.where(sliding, _SLIDING_TANGENT * sup.stiffness, sup.stiffness)[:, None] * jac
        self._inverse = np.asarray(np.linalg.inv(jac.T @ scaled), dtype=np.float64)
        self._map = self._inverse @ scaled.T
        slides = ~sup.driven & ~self._locked
        if slides.any():
            # A passive axis counts as sliding even while friction holds it: any motion breaks it loose after 2 F / k.
            scaled[slides] = _SLIDING_TANGENT * sup.stiffness[slides, None] * jac[slides]
            self._slide_map = np.where(slides[:, None], jac, 0.0) @ np.linalg.solve(jac.T @ scaled, scaled.T)

    def _yielded(self, gap: Array) -> tuple[Array, Array, BoolArray]:
        """Slip (m,), force (m,) and whether each axis is sliding, for the gaps (m,)."""
        sup, limit = self.supports, self._limit_mm
        over = gap - self._held_mm
        slip = np.minimum(np.maximum(self.slip_mm, -limit - over), limit - over)
        slip = np.minimum(np.maximum(slip, -sup.clearance_mm), sup.clearance_mm)
        stretch = gap + slip
        sliding = (np.abs(over + slip) >= limit * (1.0 - 1e-12)) & (np.abs(slip) < sup.clearance_mm)
        return slip, sup.stiffness * stretch, sliding

    @staticmethod
    def _wrench(body: Body, points_mm: Array, forces_n: Array) -> Array:
        """(6,) sum of forces (n, 3) in W at points (n, 3) of C, with their moment about the body's origin."""
        wrench = np.empty(6)
        wrench[:3] = forces_n.sum(axis=0)
        wrench[3:] = _moments(points_mm @ body.rotation.T, forces_n).sum(axis=0)
        return wrench
