"""What one axis that jams, or stops by itself, does to the part before the others have stopped: a bound on the speed.

docs/mechanics.md (42) to (44). Axis k jams at its speed v. It is seen when it hangs back by `stuck`, the others go on
for the reaction time r and then ramp down together in t: `d = stuck + v r + v t / 2`, t = max_i v_i / a_quick,i, so
that `v t / 2 = v^2 / (2 a_quick)` for the fastest axis. Each mm of it costs `c` mm at the worst ball (column of N A),
`G` newton there (column of the internal-force matrix) and `W` newton of warp. An axis that ramps down as fast as the
others parts by v r only.

An axis that follows the part has no set-point to hang back from. Jammed, it holds a position: it is seen where it
stands `passive_mm` behind the place to which the others take it. One that holds a force is seen by its load cell, too:
after `tolerance / G` mm its force leaves its tolerance, which two readings in a row must show; what comes first
counts.
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
    """Cost of each axis's error (m,): `residual_per_mm`, `force_per_mm`, `warp_per_mm`; of an axis that follows,
    once it jams.

    `seen_mm` (m,): how far an axis is out before its encoder shows that it jams; `tolerance_mm` (m,) before the load
    cell of one that holds a force does, NaN for the others. `driven` (m,): those that have a set-point.
    """

    axes: tuple[str, ...]
    residual_per_mm: Array
    force_per_mm: Array
    warp_per_mm: Array
    seen_mm: Array
    tolerance_mm: Array
    driven: NDArray[np.bool_]
    a_quick_mm_s2: Array
    settings: JamSettings

    def quick_stop_s(self, speed_mm_s: Array) -> float:
        """Time in which all axes ramp down together from `speed_mm_s` (m,)."""
        return max(self.settings.quick_floor_s, float(np.max(speed_mm_s / self.a_quick_mm_s2)))

    def reach_mm(self, speed_mm_s: Array) -> Array:
        """How far (m,) the others carry on past each axis that jams at `speed_mm_s` (m,) or slower."""
        after_s = self.settings.reaction_s + 0.5 * self.quick_stop_s(speed_mm_s)
        by_encoder = self.seen_mm + speed_mm_s * (self._sampled_s + after_s)
        by_load_cell = self.tolerance_mm + speed_mm_s * (self.settings.readings_s + after_s)
        result: Array = np.fmin(by_encoder, by_load_cell)
        return result

    def ramp_mm(self, speed_mm_s: Array) -> Array:
        """Residual (m,) when one axis begins to ramp down by itself at `speed_mm_s` (m,); one without power cannot."""
        powered = self.driven | ~np.isnan(self.tolerance_mm)
        return self.residual_per_mm * powered * speed_mm_s * self.settings.reaction_s

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
            self._check_room(room, cost, limit, what)
            factor = self._factor(speed_mm_s, room)
            k = int(np.argmax(factor))
            found.append((float(factor[k]), f"{self.axes[k]} jammed: {what}"))
        return found

    @property
    def _sampled_s(self) -> Array:
        """How late (m,) the read-back may come that shows it: the reaction to an axis with a set-point counts it."""
        result: Array = np.where(self.driven, 0.0, self.settings.sampled_s)
        return result

    def _limits(self) -> Iterator[tuple[Array, Array, str]]:
        """The tolerance of a held force is most of what a part may warp: load cells' limit bounds what its jam does."""
        jam, every = self.settings, np.ones(len(self.axes))
        yield self.residual_per_mm, jam.residual_mm * every, "ball residual"
        yield self.force_per_mm, jam.force_n * every, "internal force"
        yield self.warp_per_mm, np.where(np.isnan(self.tolerance_mm), jam.warp_n, jam.held_warp_n), "warp"

    def _factor(self, v: Array, room: Array) -> Array:
        jam = self.settings
        by_encoder = self._shrunk(v, room - self.seen_mm, self._sampled_s + jam.reaction_s)
        by_load_cell = self._shrunk(v, room - self.tolerance_mm, jam.readings_s + jam.reaction_s)
        result: Array = np.fmin(by_encoder, by_load_cell)
        return result

    def _shrunk(self, v: Array, room: Array, reaction_s: Array | float) -> Array:
        """Stretch (m,) with which an axis stays inside `room` (m,) mm; next to endless where there is none."""
        room = np.maximum(room, 1.0 / _FREE_MM)
        ramp_s = float(np.max(v / self.a_quick_mm_s2))
        run = v * reaction_s
        shrinking = (run + np.sqrt(run * run + 2.0 * room * v * ramp_s)) / (2.0 * room)
        at_floor = v * (reaction_s + 0.5 * self.settings.quick_floor_s) / room
        result: Array = np.maximum(shrinking, at_floor)
        return result

    def _check_room(self, room: Array, cost: Array, limit: Array, what: str) -> None:
        """What is reached before anybody can see it must leave room. Raises StrainForeseen."""
        least_mm = np.fmin(self.seen_mm, self.tolerance_mm)
        k = int(np.argmin(room - least_mm))
        if not room[k] > least_mm[k]:
            key = "limits.stuck_mm" if self.driven[k] else "limits.passive_mm"
            key = key if least_mm[k] == self.seen_mm[k] else "force_tolerance in mm"
            cause = f"At any speed: {key} = {least_mm[k]:.4g}; less than {room[k]:.4g} mm would fit."
            value = float(cost[k] * least_mm[k])
            raise StrainForeseen(f"{self.axes[k]} jammed: {what}", cause, value=value, limit=float(limit[k]))


def jam_bound(positioners: Positioners, q_mm: Array, settings: JamSettings, up: Array) -> JamBound:
    """The bound over places of the axes `q_mm` (m,) or (n, m), `up` (3,) against gravity: of each axis the worst of
    them. The start, the middle and the end of a path are enough for the few degrees of a docking."""
    places = [_costs(positioners, socket_positions(positioners, row), up) for row in np.atleast_2d(q_mm)]
    residual, force, warp = np.max(places, axis=0)
    tolerance = np.divide(
        positioners.held_tolerance_n,
        force,
        out=np.full_like(force, np.nan),
        where=positioners.followers & (force > 0.0),
    )
    # One that holds a force goes where its force is: only the force tells its jam.
    beside = np.where(np.isnan(tolerance), settings.passive_mm, np.nan)
    seen = np.where(positioners.driven, settings.stuck_mm, beside)
    costs = residual, force, warp, seen, tolerance
    return JamBound(positioners.axes, *costs, positioners.driven, positioners.a_quick_mm_s2, settings)


def _costs(positioners: Positioners, balls_W_mm: Array, up: Array) -> Array:
    """Residual, force and warp (3, m) per mm of each axis; one that follows holds a position once it jams."""
    costs = _held_costs(positioners, balls_W_mm, up)
    for k in np.flatnonzero(~positioners.driven):
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
