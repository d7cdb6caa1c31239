"""What one axis that jams, or stops by itself, does to the part before the others have stopped: a bound on the speed.

Axis k jams at its speed v. It is seen when it hangs back by `stuck`, the others go on for the reaction time r and then
ramp down together in t: `d = stuck + v r + v t / 2`, t = max_i v_i / a_quick,i, so that `v t / 2 = v^2 / (2 a_quick)`
for the fastest axis. Each mm of it costs `c` mm at the worst ball (column of N A) and `G` newton (column of the
internal-force matrix). An axis that ramps down as fast as the others parts from them by v r only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import StrainForeseen
from docking.kinematics import (
    Positioners,
    axis_jacobian,
    consistency_projector,
    internal_force_matrix,
    socket_positions,
)
from docking.kinematics.forces import axis_stiffness_n_per_mm
from docking.planning.settings import JamSettings
from docking.types import Array

_FREE_MM = 1e12
"""Room of an axis whose error costs nothing."""


def _largest_norms(columns: Array) -> Array:
    """Largest ball vector of each column (3k, m) -> (m,)."""
    vectors = columns.reshape(-1, 3, columns.shape[1])
    result: Array = np.linalg.norm(vectors, axis=1).max(axis=0)
    return result


def residual_matrix(positioners: Positioners, balls_W_mm: Array) -> Array:
    """Ball residuals (3k, m) of the read-backs per mm of error of each axis that holds a position; 0 for the others.

    Axes that hold none follow the component, which takes the place of least strain: they share the error's rigid part.
    """
    m = len(positioners.axes)
    to_ball = np.zeros((m, m))
    for i, columns in enumerate(positioners.axes_W):
        to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = columns
    centre = balls_W_mm.mean(axis=0)
    jac = axis_jacobian(positioners, balls_W_mm, centre)
    jac[:, 3:] /= np.linalg.norm(balls_W_mm - centre, axis=1).max()
    spring = axis_stiffness_n_per_mm(positioners)[:, None] * jac
    followed = jac @ np.linalg.solve(jac.T @ spring, spring.T)
    driven = positioners.driven
    read_back = np.where(driven[:, None], np.diag(driven.astype(np.float64)), followed)
    result: Array = consistency_projector(balls_W_mm) @ to_ball @ read_back
    return result


@dataclass(frozen=True, eq=False)
class JamBound:
    """Cost of each axis's error: `residual_per_mm` (m,), `force_per_mm` (m,); zero for axes that hold no position."""

    axes: tuple[str, ...]
    residual_per_mm: Array
    force_per_mm: Array
    a_quick_mm_s2: Array
    settings: JamSettings

    def quick_stop_s(self, speed_mm_s: Array) -> float:
        """Time in which all axes ramp down together from `speed_mm_s` (m,)."""
        return max(self.settings.quick_floor_s, float(np.max(speed_mm_s / self.a_quick_mm_s2)))

    def reach_mm(self, speed_mm_s: Array) -> Array:
        """How far (m,) the others carry on past each axis that jams at `speed_mm_s` (m,)."""
        jam = self.settings
        return jam.stuck_mm + speed_mm_s * (jam.reaction_s + 0.5 * self.quick_stop_s(speed_mm_s))

    def ramp_mm(self, speed_mm_s: Array) -> Array:
        """Residual (m,) when one axis begins to ramp down by itself at `speed_mm_s` (m,)."""
        return self.residual_per_mm * speed_mm_s * self.settings.reaction_s

    def jam_mm(self, speed_mm_s: Array) -> Array:
        """Residual (m,) of each axis jammed at `speed_mm_s` (m,)."""
        return self.residual_per_mm * self.reach_mm(speed_mm_s)

    def jam_n(self, speed_mm_s: Array) -> Array:
        """Internal force (m,) of each axis jammed at `speed_mm_s` (m,)."""
        return self.force_per_mm * self.reach_mm(speed_mm_s)

    def stretches(self, speed_mm_s: Array) -> list[tuple[float, str]]:
        """(factor, limit) by which a law with peak speeds (m,) must be stretched: for residual and for force.

        Stretching by x divides every speed and the ramp by x, the ramp down to its floor:
        stuck + v r / x + v t / (2 x^2) <= D and stuck + v (r + floor / 2) / x <= D.
        """
        found = []
        for cost, limit, what in (
            (self.residual_per_mm, self.settings.residual_mm, "ball residual"),
            (self.force_per_mm, self.settings.force_n, "internal force"),
        ):
            room = np.divide(limit, cost, out=np.full_like(cost, _FREE_MM), where=cost > 1e-9) - self.settings.stuck_mm
            self._check_room(room, cost, limit, what)
            factor = self._factor(speed_mm_s, room)
            k = int(np.argmax(factor))
            found.append((float(factor[k]), f"{self.axes[k]} jammed: {what}"))
        return found

    def _factor(self, v: Array, room: Array) -> Array:
        ramp_s = float(np.max(v / self.a_quick_mm_s2))
        run = v * self.settings.reaction_s
        shrinking = (run + np.sqrt(run * run + 2.0 * room * v * ramp_s)) / (2.0 * room)
        at_floor = v * (self.settings.reaction_s + 0.5 * self.settings.quick_floor_s) / room
        result: Array = np.maximum(shrinking, at_floor)
        return result

    def _check_room(self, room: Array, cost: Array, limit: float, what: str) -> None:
        k = int(np.argmin(room))
        if not room[k] > 0.0:
            where = f"{self.axes[k]} jammed: {what}"
            fits = limit / float(cost[k])
            cause = f"At any speed: limits.stuck_mm = {self.settings.stuck_mm:g}; less than {fits:.4g} mm would fit."
            raise StrainForeseen(where, cause, value=float(cost[k]) * self.settings.stuck_mm, limit=limit)


def jam_bound(positioners: Positioners, q_mm: Array, settings: JamSettings) -> JamBound:
    """The bound over places of the axes `q_mm` (m,) or (n, m): of each axis the worst of them. The start, the middle
    and the end of a path are enough for the few degrees of a docking."""
    places = [socket_positions(positioners, row) for row in np.atleast_2d(q_mm)]
    residual = [_largest_norms(residual_matrix(positioners, balls)) for balls in places]
    force = [_largest_norms(internal_force_matrix(positioners, balls)) for balls in places]
    worst = np.max(residual, axis=0), np.max(force, axis=0)
    return JamBound(positioners.axes, *worst, positioners.a_quick_mm_s2, settings)
