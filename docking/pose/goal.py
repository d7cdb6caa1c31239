"""Where the component must go: the best fit of its docking features to the mate's, by least squares or minimax.

Least squares weights every feature with 1 / tolerance^2. Minimax makes the largest error / tolerance as small as it can
be: what counts at the acceptance is the worst feature. Linearised about a pose it is a convex problem,
`min s, |e_i + A_i x| <= s tol_i`, solved by Newton's method along the central path of its barrier (Boyd and
Vandenberghe 2004, ch. 11), whose duality gap bounds what is left; the pose is moved and linearised again until it
rests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from docking.errors import NotCongruent
from docking.geometry import exp_so3, skew
from docking.pose.svd import fit_svd
from docking.types import Array, Fit, Pose

GoalKind = Literal["least-squares", "minimax"]
Lock = Literal["x", "y", "z", "alpha", "beta", "gamma"]
LOCKS: tuple[Lock, ...] = get_args(Lock)
_PARAMETERS: tuple[str, ...] = ("alpha", "beta", "gamma", "x", "y", "z")
_ROUNDS = 30
_REST_MM = 1e-8
_GAP = 1e-9
"""Duality gap, relative to the largest error over tolerance, at which a minimax counts as reached."""
_STEEPER = 12.0
_NEWTON = 50


@dataclass(frozen=True, eq=False)
class GoalRule:
    """How the goal is found.

    kind     least-squares or minimax, both against the tolerances
    locks    degrees of freedom that the features do not decide: shift along, rotation about the axes of M through the
             docking face; they stay as in `docked`
    docked   X_MC as designed; None: the least-squares fit of the features
    pivot_C_mm  (3,) centre of the docking face in C
    """

    kind: GoalKind = "least-squares"
    locks: tuple[Lock, ...] = ()
    docked: Pose | None = None
    pivot_C_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def free(self) -> NDArray[np.intp]:
        """Indices of the parameters [alpha, beta, gamma, x, y, z] that the features decide."""
        return np.array([i for i, name in enumerate(_PARAMETERS) if name not in self.locks], dtype=np.intp)


def best_fit(body_mm: Array, target_mm: Array, tolerance_mm: Array, rule: GoalRule) -> Pose:
    """Pose X_MC that brings features of the body (f, 3) in C onto their targets (f, 3) in M under `rule`.

    `tolerance_mm` (f,). Raises NotCongruent when the iteration does not come to rest.
    """
    closed = fit_svd(body_mm, target_mm, tolerance_mm**-2.0)
    if rule.kind == "least-squares" and not rule.locks:
        return closed
    base = closed if rule.docked is None or not rule.locks else rule.docked
    free = rule.free()
    if not len(free):
        return base
    pivot = base.apply(np.array(rule.pivot_C_mm))
    arm = base.apply(body_mm) - pivot
    reach = max(float(np.sqrt(np.mean(np.sum(arm**2, axis=1)))), 1.0)
    unit = np.array([1.0 / reach] * 3 + [1.0] * 3)
    solve = _minimax_step if rule.kind == "minimax" else _squares_step
    x = np.zeros(6)
    for _ in range(_ROUNDS):
        turned = arm @ exp_so3(x[:3]).T
        error = turned + pivot + x[3:] - target_mm
        jac = np.concatenate([-skew(turned) @ _left_jacobian(x[:3]), np.tile(np.eye(3), (len(arm), 1, 1))], axis=2)
        scaled = (jac * unit)[:, :, free] / tolerance_mm[:, None, None]
        step = np.asarray(solve(scaled, error / tolerance_mm[:, None]), dtype=np.float64)
        x[free] += unit[free] * step
        if float(np.max(np.abs(step))) < _REST_MM:
            break
    else:
        raise NotCongruent("goal", "the best fit of the features does not come to rest", value=0, limit=len(arm))
    R = exp_so3(x[:3])
    return Pose(R @ base.R, R @ (base.t_mm - pivot) + pivot + x[3:])


def _left_jacobian(w: Array) -> Array:
    """d exp(w) = exp(J dw) exp(w), to third order: goals lie within degrees of where they are looked for."""
    k = skew(w)
    result: Array = np.eye(3) + k / 2.0 + k @ k / 6.0 + k @ k @ k / 24.0
    return result


def _squares_step(a: Array, u: Array) -> Array:
    """Least squares over `u + A x`, A (f, 3, p), u (f, 3)."""
    return np.asarray(np.linalg.lstsq(a.reshape(-1, a.shape[2]), -u.reshape(-1), rcond=None)[0], dtype=np.float64)


def _minimax_step(a: Array, u: Array) -> Array:
    """x (p,) that makes max |u_i + A_i x| least, to `_GAP` of it."""
    size = float(np.max(np.linalg.norm(u, axis=1)))
    x = np.zeros(a.shape[2])
    if not (size > 1e-15):
        return x
    u = u / size
    y, s, sharp = x, 1.5, 1.0
    while True:
        y, s = _centred(a, u, (y, s), sharp)
        if 2.0 * len(u) / sharp <= _GAP * s:
            break
        sharp *= _STEEPER
    return y * size


def _centred(a: Array, u: Array, start: tuple[Array, float], sharp: float) -> tuple[Array, float]:
    """The point of the central path at `sharp`: minimum of `sharp s - sum log(s^2 - |u_i + A_i y|^2)`."""
    y, s = start

    def value(y: Array, s: float) -> float:
        room = s * s - np.sum((u + a @ y) ** 2, axis=1)
        return float(sharp * s - np.sum(np.log(room))) if s > 0.0 and bool(np.all(room > 0.0)) else np.inf

    for _ in range(_NEWTON):
        gradient, hessian = _derivatives(a, u + a @ y, s, sharp)
        # Near the end of the path rounding can make the matrix singular; the shortest step is then as good as any.
        step: Array = -np.asarray(np.linalg.lstsq(hessian, gradient, rcond=None)[0], dtype=np.float64)
        decrement = float(-gradient @ step)
        if not (decrement > 1e-5):
            break
        length = _accepted(value, (y, s), step, decrement)
        if length == 0.0:
            break
        y, s = y + length * step[:-1], s + length * float(step[-1])
    return y, s


def _derivatives(a: Array, r: Array, s: float, sharp: float) -> tuple[Array, Array]:
    """Gradient (p + 1,) and Hessian of the barrier by [y, s]."""
    room = s * s - np.sum(r * r, axis=1)
    pull = np.einsum("fip,fi->fp", a, r)
    p = a.shape[2]
    gradient, hessian = np.zeros(p + 1), np.zeros((p + 1, p + 1))
    gradient[:p] = 2.0 * (pull / room[:, None]).sum(axis=0)
    gradient[p] = sharp - 2.0 * s * float(np.sum(1.0 / room))
    rows = (a / np.sqrt(room)[:, None, None]).reshape(-1, p)
    hessian[:p, :p] = 2.0 * rows.T @ rows + 4.0 * (pull / room[:, None]).T @ (pull / room[:, None])
    hessian[:p, p] = hessian[p, :p] = -4.0 * s * (pull / room[:, None] ** 2).sum(axis=0)
    hessian[p, p] = float(np.sum(4.0 * s * s / room**2 - 2.0 / room))
    return gradient, hessian


def _accepted(value: Callable[[Array, float], float], at: tuple[Array, float], step: Array, decrement: float) -> float:
    """Largest of 1, 1/2, 1/4 ... of the step that lowers the barrier enough; 0 where rounding is all that is left."""
    y, s = at
    now, length = value(y, s), 1.0
    while length > 1e-12:
        if value(y + length * step[:-1], s + length * float(step[-1])) <= now - 0.25 * length * decrement:
            return length
        length *= 0.5
    return 0.0


@dataclass(frozen=True, eq=False)
class Goal:
    """A goal with what it leaves at the features: pose X_WC, `misfit_mm` (f,) and the same over the tolerances."""

    X_WC: Pose
    misfit_mm: Array
    share: Array


def goal_of(component: Fit, mate: Fit, features: tuple[Array, Array, Array], rule: GoalRule) -> Goal:
    """The docked goal from both fits; `features` = component (f, 3) in C, mate (f, 3) in M, tolerances (f,).

    Component and mate keep the expansions that their fits found: their features stand where `Fit.predict` puts them.
    """
    component_mm, mate_mm, tolerance_mm = features
    body = component.grown(component_mm)
    target = mate.grown(mate_mm)
    X_MC = best_fit(body, target, tolerance_mm, rule)
    misfit = np.linalg.norm(X_MC.apply(body) - target, axis=1)
    return Goal(mate.X_MN @ X_MC, misfit, misfit / tolerance_mm)
