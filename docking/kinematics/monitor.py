"""The coupling check of one control cycle, precomputed: one matrix product a tick."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from docking.kinematics.forces import consistency_projector, internal_force_matrix, warp_rows
from docking.kinematics.positioners import Positioners
from docking.types import Array


class CouplingMonitor:
    """Largest ball residual, ball internal force and warp force that axis deviations `dq = q_actual - q_planned` mean.

    Residual `r = N A dq` over driven and passive axes; internal force `F = G dq` over the driven axes only; warp is
    `row F`. NaN in any axis makes all three NaN, so a limit written `not value <= limit` trips.
    """

    __slots__ = ("_balls", "_matrix", "_ones", "_out", "_squares", "_vectors", "_warp")

    def __init__(self, residual: Array, force: Array, warp: Array) -> None:
        """`residual` (3k, m), `force` (3k, m), `warp` (w, m): rows of the stacked product."""
        self._balls = len(residual) // 3
        self._matrix = np.ascontiguousarray(np.vstack([residual, force, warp]))
        self._out = np.empty(len(self._matrix))
        self._vectors = self._out[: 6 * self._balls]
        self._squares = np.empty((2 * self._balls, 3))
        self._ones = np.ones(3)
        self._warp = self._out[6 * self._balls :]

    def evaluate(self, dq_mm: Array) -> tuple[float, float, float]:
        """`dq_mm` (m,) -> (largest ball residual mm, largest ball force N, largest |warp| N)."""
        np.dot(self._matrix, dq_mm, out=self._out)
        flat = self._squares.reshape(-1)
        np.multiply(self._vectors, self._vectors, out=flat)
        norms = np.dot(self._squares, self._ones).tolist()
        warp = max(map(abs, self._warp.tolist()), default=0.0)
        return math.sqrt(max(norms[: self._balls])), math.sqrt(max(norms[self._balls :])), warp


def coupling_monitor(
    positioners: Positioners, balls_W_mm: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> CouplingMonitor:
    """Monitor for balls near `balls_W_mm` (k, 3) with `up` (3,) against gravity.

    Good for the few degrees that the component turns in a docking.
    """
    m = len(positioners.axes)
    to_ball = np.zeros((m, m))
    for i, columns in enumerate(positioners.axes_W):
        to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = columns
    force = internal_force_matrix(positioners, balls_W_mm)
    modes = warp_rows(balls_W_mm, up)
    vertical = np.einsum("wk,c->wkc", modes, np.asarray(up, dtype=np.float64)).reshape(len(modes), m)
    return CouplingMonitor(consistency_projector(balls_W_mm) @ to_ball, force, vertical @ force)
