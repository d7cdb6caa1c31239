"""What one axis that jams, or stops by itself, does to the part before the others have stopped: a bound on the speed.

docs/mechanics.md (42) to (44). Axis k jams at its speed v. It is seen when it hangs back by `stuck`, the others go on
for the reaction time r and then ramp down together in t: `d = stuck + v r + v t / 2`, t = max_i v_i / a_quick,i, so
that `v t / 2 = v^2 / (2 a_quick)` for the fastest axis. Each mm of it costs `c` mm at the worst ball (column of N A),
`G` newton there (column of the internal-force matrix) and `W` newton of warp. An axis that ramps down as fast as the
others parts by v r only.

An axis that holds a force has no set-point to hang back from. Jammed, it holds a position: its force leaves its
tolerance after `tolerance / G` mm, which two readings of its load cell in a row must show; where the plan takes it
by `seen_mm` in the window of the encoders or faster, they show it first. The slower of the two has the longer way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from docking.errors import StrainForeseen
from docking.kinematics import (
    Positioners,
    axis_jacobian,
    consistency_projector,
    internal_force_matrix,
    socket_positions,
    warp_rows,
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


def warp_matrix(positioners: Positioners, balls_W_mm: Array, up: Array) -> Array:
    """Warp (w, m) in N per mm of error of each axis that holds a position; no row for three balls."""
    modes = warp_rows(balls_W_mm, up)
    vertical = np.einsum("wk,c->wkc", modes, up).reshape(len(modes), balls_W_mm.size)
    result: Array = vertical @ internal_force_matrix(positioners, balls_W_mm)
    return result


@dataclass(frozen=True, eq=False)
class JamBound:
    """Cost of each axis's error (m,): `residual_per_mm`, `force_per_mm`, `warp_per_mm`; zero for axes without power.

    `tolerance_mm` (m,): how far an axis that holds a force is out before its load cell shows it, NaN for the others.
    """

    axes: tuple[str, ...]
    residual_per_mm: Array
    force_per_mm: Array
    warp_per_mm: Array
    tolerance_mm: Array
    a_quick_mm_s2: Array
    settings: JamSettings

    def quick_stop_s(self, speed_mm_s: Array) -> float:
        """Time in which all axes ramp down together from `speed_mm_s` (m,)."""
        return max(self.settings.quick_floor_s, float(np.max(speed_mm_s / self.a_quick_mm_s2)))

    def reach_mm(self, speed_mm_s: Array) -> Array:
        """How far (m,) the others carry on past each axis that jams at `speed_mm_s` (m,) or slower."""
        jam = self.settings
        after_s = jam.reaction_s + 0.5 * self.quick_stop_s(speed_mm_s)
        reach: Array = jam.stuck_mm + speed_mm_s * after_s
        if not self._followers.any():
            return reach
        held = np.maximum(self._by_load_cell_mm(speed_mm_s, after_s), speed_mm_s * (jam.window_s + after_s))
        result: Array = np.where(self._followers, held, reach)
        return result

    def ramp_mm(self, speed_mm_s: Array) -> Array:
        """Residual (m,) when one axis begins to ramp down by itself at `speed_mm_s` (m,)."""
        return self.residual_per_mm * speed_mm_s * self.settings.reaction_s

    def jam_mm(self, speed_mm_s: Array) -> Array:
        """Residual (m,) of each axis jammed at `speed_mm_s` (m,)."""
        return self.residual_per_mm * self.reach_mm(speed_mm_s)

    def jam_n(self, speed_mm_s: Array) -> Array:
        """Internal force (m,) of each axis jammed at `speed_mm_s` (m,)."""
        return self.force_per_mm * self.reach_mm(speed_mm_s)

    def jam_warp_n(self, speed_mm_s: Array) -> Array:
        """Warp (m,) of each axis jammed at `speed_mm_s` (m,)."""
        return self.warp_per_mm * self.reach_mm(speed_mm_s)

    def stretches(self, speed_mm_s: Array) -> list[tuple[float, str]]:
        """(factor, limit) by which a law with peak speeds (m,) must be stretched: for residual, force and warp.

        Stretching by x divides every speed and the ramp by x, the ramp down to its floor:
        stuck + v r / x + v t / (2 x^2) <= D and stuck + v (r + floor / 2) / x <= D.
        """
        found = []
        for cost, limit, what in self._limits():
            room = np.divide(limit, cost, out=np.full_like(cost, _FREE_MM), where=cost > 1e-9)
            factor = self._factor(speed_mm_s, room, cost, (limit, what))
            k = int(np.argmax(factor))
            found.append((float(factor[k]), f"{self.axes[k]} jammed: {what}"))
        return found

    @property
    def _followers(self) -> NDArray[np.bool_]:
        result: NDArray[np.bool_] = ~np.isnan(self.tolerance_mm)
        return result

    def _limits(self) -> Iterator[tuple[Array, float, str]]:
        """The tolerance of a held force is most of what a part may warp: no speed keeps a jammed follower inside it."""
        jam = self.settings
        yield self.residual_per_mm, jam.residual_mm, "ball residual"
        yield self.force_per_mm, jam.force_n, "internal force"
        yield np.where(self._followers, 0.0, self.warp_per_mm), jam.warp_n, "warp"

    def _by_load_cell_mm(self, v: Array, after_s: Array | float) -> Array:
        """Reach (m,) of a jam that the encoders do not show: no faster than they need."""
        jam = self.settings
        slow = np.minimum(v, jam.seen_mm / jam.window_s)
        result: Array = self.tolerance_mm + slow * (jam.readings_s + after_s)
        return result

    def _factor(self, v: Array, room: Array, cost: Array, limit: tuple[float, str]) -> Array:
        jam = self.settings
        least = np.where(self._followers, np.nan_to_num(self.tolerance_mm), jam.stuck_mm)
        self._check_room(room, least, cost, limit)
        factor = self._shrunk(v, room - jam.stuck_mm, jam.reaction_s)
        if not self._followers.any():
            return factor
        held = np.maximum(self._shrunk(v, room, jam.window_s + jam.reaction_s), 1e-9)
        # At the speed that the encoder's window allows, what jams more slowly must be inside as well.
        ramp_s = np.maximum(jam.quick_floor_s, float(np.max(v / self.a_quick_mm_s2)) / held)
        over = ~(self._by_load_cell_mm(v / held, jam.reaction_s + 0.5 * ramp_s) <= room)
        slow = self._shrunk(v, room - np.nan_to_num(self.tolerance_mm), jam.readings_s + jam.reaction_s)
        result: Array = np.where(self._followers, np.where(over, np.maximum(held, slow), held), factor)
        return result

    def _shrunk(self, v: Array, room: Array, reaction_s: float) -> Array:
        ramp_s = float(np.max(v / self.a_quick_mm_s2))
        run = v * reaction_s
        shrinking = (run + np.sqrt(run * run + 2.0 * room * v * ramp_s)) / (2.0 * room)
        at_floor = v * (reaction_s + 0.5 * self.settings.quick_floor_s) / room
        result: Array = np.maximum(shrinking, at_floor)
        return result

    def _check_room(self, room: Array, least_mm: Array, cost: Array, limit: tuple[float, str]) -> None:
        """What is reached before anybody can see it must leave room. Raises StrainForeseen."""
        k = int(np.argmin(room - least_mm))
        if not room[k] > least_mm[k]:
            where = f"{self.axes[k]} jammed: {limit[1]}"
            name = "limits.stuck_mm" if np.isnan(self.tolerance_mm[k]) else "out of tolerance in mm"
            cause = f"At any speed: {name} = {least_mm[k]:g}; less than {room[k]:.4g} mm would fit."
            raise StrainForeseen(where, cause, value=float(cost[k] * least_mm[k]), limit=limit[0])


def jam_bound(positioners: Positioners, q_mm: Array, settings: JamSettings, up: Array) -> JamBound:
    """The bound over places of the axes `q_mm` (m,) or (n, m), `up` (3,) against gravity: of each axis the worst of
    them. The start, the middle and the end of a path are enough for the few degrees of a docking."""
    places = [_costs(positioners, socket_positions(positioners, row), up) for row in np.atleast_2d(q_mm)]
    residual, force, warp = np.max(places, axis=0)
    followers = positioners.followers
    tolerance = np.divide(
        positioners.held_tolerance_n, force, out=np.full_like(force, np.nan), where=followers & (force > 0.0)
    )
    return JamBound(positioners.axes, residual, force, warp, tolerance, positioners.a_quick_mm_s2, settings)


def _costs(positioners: Positioners, balls_W_mm: Array, up: Array) -> Array:
    """Residual, force and warp (3, m) per mm of each axis; one that holds a force holds a position once it jams."""
    costs = _held_costs(positioners, balls_W_mm, up)
    for k in np.flatnonzero(positioners.followers):
        others = np.arange(len(positioners.axes)) != k
        jammed = replace(
            positioners,
            driven=positioners.driven | ~others,
            held_n=positioners.held_n * others,
            held_tolerance_n=positioners.held_tolerance_n * others,
        )
        costs[:, k] = _held_costs(jammed, balls_W_mm, up)[:, k]
    return costs


def _held_costs(positioners: Positioners, balls_W_mm: Array, up: Array) -> Array:
    warp = np.abs(warp_matrix(positioners, balls_W_mm, up))
    return np.array([
        _largest_norms(residual_matrix(positioners, balls_W_mm)),
        _largest_norms(internal_force_matrix(positioners, balls_W_mm)),
        warp.max(axis=0, initial=0.0),
    ])  # fmt: skip
