"""The coupling check of one control cycle, precomputed: one matrix product a tick."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from docking.kinematics.forces import axis_stiffness_n_per_mm, consistency_projector, internal_force_matrix, warp_rows
from docking.kinematics.positioners import Positioners, axis_jacobian
from docking.types import Array


class Coupling(NamedTuple):
    """What axis deviations mean for the part: the largest of each kind.

    `residual_mm` and `rms_mm` of the balls against a rigid figure, `force_n` at a ball, `warp_n` of the vertical axes,
    `pair_mm` change of the distance of two balls.
    """

    residual_mm: float
    force_n: float
    warp_n: float
    rms_mm: float
    pair_mm: float


class CouplingMonitor:
    """What axis deviations `dq = q_actual - q_planned` (m,) mean, to first order; docs/mechanics.md (13) to (15), (20).

    Residual `r = N A dq` over driven and passive axes; internal force `F = G dq` over the driven axes only; warp is
    `row F`. NaN in any axis makes all figures NaN, so a limit written `not value <= limit` trips.
    """

    __slots__ = ("_balls", "_matrix", "_ones", "_out", "_pairs", "_passive", "_squares", "_vectors", "_warp", "free")

    def __init__(self, vectors: tuple[Array, Array], rows: tuple[Array, Array, Array], free: NDArray[np.intp]) -> None:
        """`vectors`: residual and force (3k, m) each; `rows`: warp (w, m), pairs (p, m), passive (a, m); `free` (a,)
        the axes of the passive rows."""
        self._balls = len(vectors[0]) // 3
        self._matrix = np.ascontiguousarray(np.vstack([*vectors, *rows]))
        self._out = np.empty(len(self._matrix))
        ends = np.cumsum([6 * self._balls, *map(len, rows)])
        self._vectors = self._out[: ends[0]]
        self._warp, self._pairs, self._passive = (self._out[a:b] for a, b in itertools.pairwise(ends))
        self._squares = np.empty((2 * self._balls, 3))
        self._ones = np.ones(3)
        self.free = free

    def evaluate(self, dq_mm: Array) -> Coupling:
        """Judge deviations `dq_mm` (m,)."""
        np.dot(self._matrix, dq_mm, out=self._out)
        flat = self._squares.reshape(-1)
        np.multiply(self._vectors, self._vectors, out=flat)
        norms = np.dot(self._squares, self._ones).tolist()
        residuals = norms[: self._balls]
        return Coupling(
            math.sqrt(max(residuals)),
            math.sqrt(max(norms[self._balls :])),
            max(map(abs, self._warp.tolist()), default=0.0),
            math.sqrt(sum(residuals) / self._balls),
            max(map(abs, self._pairs.tolist())),
        )

    @property
    def beside_mm(self) -> Array:
        """How far each axis of `free` (a,) is from where the component takes it, of the last evaluation."""
        return self._passive


def coupling_monitor(
    positioners: Positioners, balls_W_mm: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> CouplingMonitor:
    """Monitor for balls near `balls_W_mm` (k, 3) with `up` (3,) against gravity.

    Good for the few degrees that the component turns in a docking.
    """
    balls = np.asarray(balls_W_mm, dtype=np.float64)
    m = len(positioners.axes)
    to_ball = np.zeros((m, m))
    for i, columns in enumerate(positioners.axes_W):
        to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = columns
    force = internal_force_matrix(positioners, balls)
    modes = warp_rows(balls, up)
    vertical = np.einsum("wk,c->wkc", modes, np.asarray(up, dtype=np.float64)).reshape(len(modes), m)
    free = np.flatnonzero(~positioners.driven)
    rows = (vertical @ force, _pair_rows(balls) @ to_ball, _passive_rows(positioners, balls)[free])
    return CouplingMonitor((consistency_projector(balls) @ to_ball, force), rows, free)


def _pair_rows(balls_W_mm: Array) -> Array:
    """(p, 3k): change of the distance of each pair of balls, from the displacements of the balls."""
    pairs = list(itertools.combinations(range(len(balls_W_mm)), 2))
    result = np.zeros((len(pairs), len(balls_W_mm), 3))
    for row, (i, j) in zip(result, pairs, strict=True):
        along = balls_W_mm[j] - balls_W_mm[i]
        along = along / np.linalg.norm(along)
        row[i], row[j] = -along, along
    return result.reshape(len(pairs), -1)


def pose_step_matrix(positioners: Positioners, balls_W_mm: Array) -> Array:
    """(6, m): twist [d (3), w (3)] of the component about the middle of the balls from axis deviations.

    The elastic fit over the driven axes, weighted with their stiffness: where the component really goes. Passive
    axes have no say.
    """
    centre = balls_W_mm.mean(axis=0)
    length = float(np.linalg.norm(balls_W_mm - centre, axis=1).max())
    scale = np.array([1.0, 1.0, 1.0, 1.0 / length, 1.0 / length, 1.0 / length])
    jac = axis_jacobian(positioners, balls_W_mm, centre) * scale
    spring = axis_stiffness_n_per_mm(positioners)[:, None] * jac
    result: Array = scale[:, None] * np.linalg.solve(jac.T @ spring, spring.T)
    return result


def _passive_rows(positioners: Positioners, balls_W_mm: Array) -> Array:
    """(m, m): each axis less where the driven axes' read-backs take the component; equation (15)."""
    jac = axis_jacobian(positioners, balls_W_mm, balls_W_mm.mean(axis=0))
    result: Array = np.eye(len(jac)) - jac @ pose_step_matrix(positioners, balls_W_mm)
    return result
