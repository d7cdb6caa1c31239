"""Is the part bent? Many small residuals that follow one smooth shape are no outliers: the part is deformed.

Along the longest principal axis x of the targets (lengths in units of half their extent) the shapes are bending in two
planes, quadratic and cubic, as a slender beam takes it (a cross-section stays plane and turns with the axis), torsion,
and growth. The points are explained twice, by a rigid part with some points moved, and by a part of these shapes; the
explanations compete by the Bayesian information criterion: chi-square plus ln(3 n) for each free number.
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import numpy as np

from docking.pose.least_squares import design
from docking.pose.quantiles import chi2_tail
from docking.pose.snooping import Pairs, Tested, solve
from docking.pose.uncertainty import total_cov_mm2
from docking.types import Array

SHAPES = ("bending", "bending", "bending", "bending", "torsion", "growth")
_EVIDENCE = 12.0
"""By how much the criterion must prefer the deformed part; 10 is called very strong evidence."""
_CHANCE = 1e-5
"""Without any rejected point the rigid fit must be as improbable as this before shapes are asked at all."""


class Deformation(NamedTuple):
    """What the part does: the strongest shape, how far it carries a point of the part at most, mm, and what noise
    would pass for it, mm."""

    shape: str
    largest_mm: float
    noise_mm: float


class _Shaped(NamedTuple):
    """A fit of pose and shapes: chi-square, shapes that the layout shows, displacement of each (n, 3, 6), T_i (n,)."""

    chi2: float
    shown: int
    moves_mm: Array
    statistic: Array
    noise_mm: float


def shape_fields(nominal_mm: Array) -> Array:
    """Displacements (n, 3, 6) in N of unit shapes, in the order of SHAPES; 1 mm where x is at its end."""
    centred = nominal_mm - nominal_mm.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=True)[2]
    local = centred @ axes.T
    x, y, z = local.T / max(float(np.max(np.abs(local[:, 0]))), 1e-9)
    o = np.zeros_like(x)
    fields = np.array(
        [
            [-2.0 * x * y, x * x, o], [-2.0 * x * z, o, x * x],
            [-3.0 * x * x * y, x**3, o], [-3.0 * x * x * z, o, x**3],
            [o, -x * z, x * y], [x, y, z],
        ]
    )  # fmt: skip
    result: Array = np.einsum("ab,kan->nbk", axes, fields)
    return result


def _shaped(pairs: Pairs, rows: list[int], expansion_sigma: float) -> _Shaped:
    """Pose and shapes fitted to some rows, linear about their rigid fit."""
    sub = pairs.rows(rows)
    rigid = solve(sub, expansion_sigma)
    r = sub.measured_mm - rigid.X_MN.apply(sub.nominal_mm)
    cov = total_cov_mm2(sub.nominal_cov_mm2, sub.measured_cov_mm2, rigid.X_MN.R)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    motion = design(rigid.X_MN.apply(sub.nominal_mm), rigid.pivot_mm)[:, :, :6]
    shapes = rigid.X_MN.R @ shape_fields(sub.nominal_mm)
    size = np.array([1e3] * 3 + [1.0] * 9)
    both = np.concatenate([motion, shapes], axis=2) / size
    a = (whiten @ both).reshape(3 * len(rows), 12)
    b = (whiten @ r[:, :, None]).reshape(-1)
    u, s, vt = np.linalg.svd(a, full_matrices=False)
    held = s > 1e-6 * s[0]
    x = vt.T @ np.where(held, (u.T @ b) / np.where(held, s, 1.0), 0.0)
    left = (b - a @ x).reshape(-1, 3)
    # What a rigid motion could do as well is no deformation: each shape counts by what the motions leave of it.
    white_motion, white_shapes = (whiten @ v for v in (motion, shapes))
    gain = np.linalg.lstsq(white_motion.reshape(-1, 6), white_shapes.reshape(-1, 6), rcond=None)[0]
    moves = (shapes - motion @ gain) * x[6:]
    noise = float(np.sqrt(np.mean(np.trace(cov, axis1=1, axis2=2))))
    return _Shaped(float(np.vdot(left, left)), int(np.sum(held)) - 6, moves, np.sum(left * left, axis=1), noise)


def _named(found: _Shaped) -> Deformation:
    """The shape that carries the points farthest."""
    kinds = dict.fromkeys(SHAPES)
    sums = {kind: np.sum(found.moves_mm[:, :, [s == kind for s in SHAPES]], axis=2) for kind in kinds}
    shape = max(sums, key=lambda kind: float(np.sum(sums[kind] ** 2)))
    largest = float(np.max(np.linalg.norm(np.sum(found.moves_mm, axis=2), axis=1)))
    return Deformation(shape, largest, found.noise_mm)


def deformation(
    pairs: Pairs, tested: Tested, moved: tuple[int, ...], events: int, expansion_sigma: float
) -> Deformation | None:
    """How the part is deformed, or None where a rigid part explains the points better.

    `tested` is the rigid fit, `moved` the rows rejected without an explanation, by `events` separate events.
    A row that no shape explains either is left out of both explanations, the worst first.
    """
    kept = tested.kept
    rows, limit = sorted([*kept, *moved]), 3.0 * log(3.0 * (len(kept) + len(moved)))
    rigid_chi2 = tested.chi2
    if not moved and chi2_tail(rigid_chi2, 3 * len(kept) - 6) >= _CHANCE:
        return None
    while True:
        found = _shaped(pairs, rows, expansion_sigma)
        rigid = rigid_chi2 + events * limit
        if rigid - (found.chi2 + found.shown * limit / 3.0) > _EVIDENCE:
            return _named(found)
        worst = max((i for i in rows if i in moved), key=lambda i: found.statistic[rows.index(i)], default=None)
        if worst is None or events < 2 or found.statistic[rows.index(worst)] < limit:
            return None
        rows.remove(worst)
        events -= 1
