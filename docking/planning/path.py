"""The path of one move: a rigid motion of the commanded socket figure along a scalar s in 0..1.

docs/mechanics.md (30) to (32): `R(s) = exp(s w) R0`, the pivot c travels straight by `shift`. A socket at arm r from
the pivot goes `p(s) = p0 + s shift + (cos(theta s) - 1) r_perp + sin(theta s) (u x r)`, u = w / theta. So each axis is
a combination of three functions of s, and the whole table one product (n, 3) @ (3, m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.kinematics import Positioners, axis_displacements, socket_positions
from docking.types import Array, Correction

_BOUND_SAMPLES = 65


def _basis(s: Array, angle: float, order: int) -> Array:
    """The functions [s, cos(angle s) - 1, sin(angle s)] (n, 3) or their derivative of `order` 1..3 in s."""
    turn = angle * s
    rows = np.empty((len(s), 3))
    if order == 0:
        half = np.sin(0.5 * turn)
        rows[:, 0], rows[:, 1], rows[:, 2] = s, -2.0 * half * half, np.sin(turn)
        return rows
    rows[:, 0] = 1.0 if order == 1 else 0.0
    quarter = 0.5 * np.pi * order
    rows[:, 1] = angle**order * np.cos(turn + quarter)
    rows[:, 2] = angle**order * np.sin(turn + quarter)
    return rows


@dataclass(frozen=True, eq=False)
class RigidPath:
    """`start_mm` (m,) commanded axis positions at s = 0; `axis_rows` (3, m) and `point_rows` (3, 3 (k + 1)) weights of
    the three functions for the axes and for the sockets and the pivot in W; `angle_rad` the turn about `unit` (3,);
    `arms_mm` (k, 3) sockets from the pivot at s = 0."""

    start_mm: Array
    axis_rows: Array
    point_rows: Array
    angle_rad: float
    unit: Array
    arms_mm: Array

    def axes_mm(self, s: Array) -> Array:
        """Axis positions (n, m) at `s` (n,)."""
        result: Array = self.start_mm + _basis(s, self.angle_rad, 0) @ self.axis_rows
        return result

    def axis_derivative(self, s: Array, order: int) -> Array:
        """d^order q / ds^order (n, m): g, h, l of docs/mechanics.md (32)."""
        result: Array = _basis(s, self.angle_rad, order) @ self.axis_rows
        return result

    def point_speed_mm(self, s: Array) -> Array:
        """|dp/ds| (n, k + 1) of the sockets and, last, of the pivot."""
        rates = (_basis(s, self.angle_rad, 1) @ self.point_rows).reshape(len(s), -1, 3)
        result: Array = np.linalg.norm(rates, axis=2)
        return result

    def axis_bounds(self, order: int) -> Array:
        """Largest |d^order q / ds^order| (m,) over the path."""
        s = np.linspace(0.0, 1.0, _BOUND_SAMPLES)
        peak: Array = np.abs(self.axis_derivative(s, order)).max(axis=0)
        between = (self.angle_rad / (_BOUND_SAMPLES - 1)) ** 2 / 8.0
        result: Array = peak + between * np.linalg.norm(self.axis_rows[1:], axis=0) * self.angle_rad**order
        return result

    @property
    def travel_mm(self) -> float:
        """Upper bound of the way that the fastest socket or the pivot goes."""
        rows = self.point_rows.reshape(3, -1, 3)
        turning = self.angle_rad * np.linalg.norm(rows[2], axis=1)
        return float(np.max(np.linalg.norm(rows[0], axis=1) + turning))

    @property
    def spread_mm(self) -> float:
        """Largest distance between two sockets across the rotation axis: L of the chord error L theta^2 / 8."""
        if self.angle_rad == 0.0:
            return 0.0
        across = self.arms_mm - np.outer(self.arms_mm @ self.unit, self.unit)
        return float(np.max(np.linalg.norm(across[:, None, :] - across[None, :, :], axis=2)))


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Points of the component along the same motion: `start_mm` (..., 3) in W and their `rows` (3, ..., 3)."""

    start_mm: Array
    rows: Array
    angle_rad: float

    def at(self, s: Array) -> Array:
        """Places (n, ..., 3) at `s` (n,)."""
        result: Array = self.start_mm + np.tensordot(_basis(s, self.angle_rad, 0), self.rows, 1)
        return result

    def rate(self, s: Array) -> Array:
        """d place / ds (n, ..., 3)."""
        result: Array = np.tensordot(_basis(s, self.angle_rad, 1), self.rows, 1)
        return result


def carried_points(correction: Correction, points_W_mm: Array) -> CarriedPoints:
    """How `points_W_mm` (..., 3) of the component go through `correction`."""
    rows, angle, _ = _motion_rows(correction, points_W_mm - correction.pivot_W_mm)
    return CarriedPoints(points_W_mm, rows, angle)


def _motion_rows(correction: Correction, arms_mm: Array) -> tuple[Array, float, Array]:
    """Weights (3, ..., 3) of [s, cos - 1, sin] for points at `arms_mm` (..., 3) from the pivot; angle; unit axis."""
    angle = float(np.linalg.norm(correction.rotvec_rad))
    unit = correction.rotvec_rad / angle if angle > 0.0 else np.zeros(3)
    along = np.einsum("...i,i->...", arms_mm, unit)
    across = arms_mm - along[..., None] * unit if angle > 0.0 else np.zeros_like(arms_mm)
    shift = np.broadcast_to(correction.shift_mm, arms_mm.shape)
    return np.stack([shift, across, np.cross(unit, arms_mm)]), angle, unit


def rigid_path(positioners: Positioners, q_now_mm: Array, correction: Correction) -> RigidPath:
    """The path that carries the socket figure commanded at `q_now_mm` (m,) through `correction`, keeping it rigid."""
    arms = socket_positions(positioners, q_now_mm) - correction.pivot_W_mm
    moved, angle, unit = _motion_rows(correction, arms)
    pivot = np.stack([correction.shift_mm, np.zeros(3), np.zeros(3)])[:, None, :]
    points = np.concatenate([moved, pivot], axis=1).reshape(3, -1)
    return RigidPath(np.array(q_now_mm), axis_displacements(positioners, moved), points, angle, unit, arms)
