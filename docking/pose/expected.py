"""What a layout of points will give before any of them is measured: the covariance of the pose and of docking features,
the part that each point plays, and what one more point would bring.

All follows from the normal matrix of the weighted fit (docs/fit.md (4)): `N = sum A_i^T S_i^-1 A_i + L`, cov = N^-1,
with A_i the design of point i, S_i its covariance (reading and nominal together) and L the prior of the expansion.
Another point adds its own term, a point left out takes its term away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg, special

from docking.pose.layout import spread
from docking.pose.least_squares import design, weighted_centroid
from docking.pose.quantiles import chi2_upper
from docking.types import Array

POWER = 0.8
"""Probability with which an error of the minimal detectable size is found by the test of its point."""
_SINGULAR = 1e-10
"""Smallest over largest eigenvalue of the scaled normal matrix below which a layout leaves the pose open."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Points (n, 3) of one body where they will be measured, in one frame, with the covariances (n, 3, 3) of averaged
    reading and nominal together; 1 sigma of the body's unknown relative expansion (0: none is fitted)."""

    names: tuple[str, ...]
    xyz_mm: Array
    cov_mm2: Array
    expansion_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class Aims:
    """Docking features (f, 3) in the layout's frame, the covariance (f, 3, 3) that their errors have from all other
    causes, and their tolerances (f,)."""

    xyz_mm: Array
    rest_mm2: Array
    tolerance_mm: Array


class Normal(NamedTuple):
    """Scaled normal equations about a pivot: matrix (p, p), p = 6 or 7, the points' designs (n, 3, p) and weights
    (n, 3, 3), and the unit (p,) of each parameter."""

    matrix: Array
    design: Array
    weight: Array
    unit: Array
    pivot_mm: Array

    def cov(self, matrix: Array | None = None) -> Array:
        """Covariance (..., 7, 7) of [rotation, translation, expansion] about the pivot; inf where a pose stays open."""
        n = self.matrix if matrix is None else matrix
        p = n.shape[-1]
        values, vectors = np.linalg.eigh(n)
        open_ = ~(values[..., 0] > _SINGULAR * values[..., -1])
        safe = np.where(open_[..., None], 1.0, values)
        inverse = (vectors / safe[..., None, :]) @ np.swapaxes(vectors, -1, -2) * np.outer(self.unit, self.unit)
        full = np.zeros((*n.shape[:-2], 7, 7))
        full[..., :p, :p] = np.where(open_[..., None, None], np.inf, inverse)
        return full


def normal_of(layout: Layout) -> Normal:
    """The normal equations of a layout about the weighted centroid of its points."""
    pivot = weighted_centroid(layout.xyz_mm, layout.cov_mm2)
    free = 7 if layout.expansion_sigma > 0.0 else 6
    length = max(spread(layout.xyz_mm).long_mm, 1e-9)
    unit = np.array([1.0 / length] * 3 + [1.0] * 3 + [1.0 / length])[:free]
    a, weight = _terms(layout, pivot, unit)
    matrix = (np.swapaxes(a, 1, 2) @ weight @ a).sum(axis=0)
    if free == 7:
        matrix[6, 6] += (unit[6] / layout.expansion_sigma) ** 2
    return Normal(matrix, a, weight, unit, pivot)


def _terms(layout: Layout, pivot_mm: Array, unit: Array) -> tuple[Array, Array]:
    weight = np.asarray(np.linalg.inv(layout.cov_mm2), dtype=np.float64)
    return design(layout.xyz_mm, pivot_mm)[:, :, : len(unit)] * unit, weight


def _each(a: Array, weight: Array) -> Array:
    """The term (n, p, p) of every point in the normal matrix."""
    result: Array = np.swapaxes(a, 1, 2) @ weight @ a
    return result


def sigmas_mm(cov: Array, pivot_mm: Array, aims: Aims) -> Array:
    """sqrt of the largest eigenvalue (..., f) of each feature's covariance, its other causes included, for covariances
    (..., 7, 7) of the pose; inf where the pose is open."""
    a = design(aims.xyz_mm, pivot_mm)
    known = np.all(np.isfinite(cov), axis=(-2, -1))
    finite = np.where(known[..., None, None], cov, 0.0)[..., None, :, :]
    values = np.linalg.eigvalsh(a @ finite @ np.swapaxes(a, 1, 2) + aims.rest_mm2)[..., -1]
    result: Array = np.where(known[..., None], np.sqrt(values), np.inf)
    return result


def shares(cov: Array, pivot_mm: Array, aims: Aims) -> Array:
    """sigma over tolerance (...,) of the worst feature: what a better layout makes smaller."""
    result: Array = np.max(sigmas_mm(cov, pivot_mm, aims) / aims.tolerance_mm, axis=-1)
    return result


def shares_with(layout: Layout, candidates: Layout, aims: Aims) -> Array:
    """The worst feature's sigma over tolerance (k,) with each candidate point added alone."""
    normal = normal_of(layout)
    added = normal.matrix + _each(*_terms(candidates, normal.pivot_mm, normal.unit))
    return shares(normal.cov(added), normal.pivot_mm, aims)


def shares_without(layout: Layout, aims: Aims) -> Array:
    """The same (n,) with each point left out alone; inf where the others do not define the pose."""
    normal = normal_of(layout)
    return shares(normal.cov(normal.matrix - _each(normal.design, normal.weight)), normal.pivot_mm, aims)


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well a wrong point would be noticed, (n,) by point.

    `redundancy` 0..1: the part of an error that shows in the point's own residual. `detectable_mm`: size of an error,
    in its least visible direction, that the test of the point finds with probability POWER. `harm_mm`: most that an
    error which is found no more often moves a docking feature (external reliability). inf: nothing would be noticed.
    """

    redundancy: Array
    detectable_mm: Array
    harm_mm: Array


def reliability(layout: Layout, aims: Aims, false_alarm: float) -> Reliability:
    """Redundancy and minimal detectable errors under the test of data snooping, `T = r^T V^-1 r` at false_alarm / n.

    An error e of point i leaves r_i = V_i S_i^-1 e, so T is noncentral with `e^T M e`, M = S_i^-1 V_i S_i^-1.
    """
    normal = normal_of(layout)
    p = len(normal.unit)
    cov = np.linalg.pinv(normal.matrix, hermitian=True)
    a, w, n = normal.design, normal.weight, len(layout.names)
    v = layout.cov_mm2 - a @ cov @ np.swapaxes(a, 1, 2)
    redundancy = np.trace(v @ w, axis1=1, axis2=2) / 3.0
    noncentrality = float(special.chndtrinc(chi2_upper(false_alarm / n, 3), 3.0, 1.0 - POWER))
    reach = (design(aims.xyz_mm, normal.pivot_mm)[:, :, :p] * normal.unit).reshape(-1, p)
    found = [_unnoticed(w[i] @ v[i] @ w[i], reach @ cov @ a[i].T @ w[i], float(np.trace(w[i]))) for i in range(n)]
    detectable, harm = np.sqrt(noncentrality * np.array(found)).T
    return Reliability(redundancy, detectable, harm)


def _unnoticed(shown: Array, moved: Array, size: float) -> tuple[float, float]:
    """Largest |e|^2 and largest squared shift of a feature over errors with e^T M e = 1; inf where M is singular.

    `shown` M (3, 3); `moved` (3f, 3) how an error moves the features.
    """
    values, vectors = np.linalg.eigh(shown)
    if not (values[0] > _SINGULAR * size):
        return np.inf, np.inf
    root = vectors / np.sqrt(values)
    features = (moved @ root).reshape(-1, 3, 3)
    return float(1.0 / values[0]), float(np.max(np.linalg.eigvalsh(features @ np.swapaxes(features, 1, 2))))


def feature_cov_mm2(layout: Layout, points_mm: Array) -> Array:
    """Joint covariance (3f, 3f) that the fit of the layout gives points of its body (f, 3)."""
    normal = normal_of(layout)
    a = design(points_mm, normal.pivot_mm).reshape(-1, 7)
    result: Array = a @ normal.cov() @ a.T
    return result


class Direction(NamedTuple):
    """One principal direction of the pose's covariance: rotation (3,) rad and translation (3,) mm, 1 sigma each, and
    what it moves at the lever, mm."""

    rotation_rad: Array
    translation_mm: Array
    moves_mm: float


def directions(cov: Array, lever_mm: float, R: Array) -> tuple[Direction, ...]:
    """Principal directions, the weakest first, of the covariance (7, 7) of a pose about its pivot.

    Rotations count with `lever_mm`, so that mm compare with mm; vectors are told in the frame whose axes are the
    columns of `R` (3, 3).
    """
    turn = linalg.block_diag(R.T, R.T)
    unit = np.array([lever_mm] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(turn @ cov[:6, :6] @ turn.T * np.outer(unit, unit))
    sigma = np.sqrt(np.maximum(values, 0.0))
    parts = (vectors * sigma / unit[:, None]).T
    return tuple(Direction(parts[k, :3], parts[k, 3:], float(sigma[k])) for k in reversed(range(6)))
