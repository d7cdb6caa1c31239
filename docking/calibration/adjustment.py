"""Least-squares adjustment of several stations over the points that they share.

Unknown are the poses X_k of the stations in W and the points p_j; an observation z of point j from station k has the
covariance S_k in the station's frame. Minimised is `sum e^T (R_k S R_k^T)^-1 e`, e = X_k z - p_j (docs/fit.md (11) to
(13)). Given the poses each point is the weighted mean of what the stations say, so only the poses are solved for (Schur
complement); the points and their covariance follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.errors import DegenerateTargets, NotCongruent
from docking.geometry import exp_so3
from docking.pose.least_squares import design
from docking.types import Array, Pose

_MAX_ITERATIONS = 40
_SINGULAR = 1e-12
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Observations:
    """m observations: `station` (m,) and `point` (m,) as indices, `xyz_mm` (m, 3) and `cov_mm2` (m, 3, 3) in the
    station's own frame."""

    station: Index
    point: Index
    xyz_mm: Array
    cov_mm2: Array

    def rows(self, keep: NDArray[np.bool_]) -> Observations:
        """Some of them."""
        return Observations(self.station[keep], self.point[keep], self.xyz_mm[keep], self.cov_mm2[keep])


class Adjusted(NamedTuple):
    """The adjusted network. k stations, n points, m observations.

    `poses` X_WT; `cov` (6k, 6k) of all [rotation, translation] about `pivots_mm` (k, 3) in W together, zero for the
    station that is held; `points_mm` (n, 3) and `points_cov_mm2` (n, 3, 3) in W, NaN for a point that nothing observes;
    `residuals_mm` (m, 3) observed minus adjusted in W with their covariances `residual_cov_mm2` and those of the
    observations `observed_cov_mm2`, both (m, 3, 3) in W.
    """

    poses: tuple[Pose, ...]
    cov: Array
    pivots_mm: Array
    points_mm: Array
    points_cov_mm2: Array
    residuals_mm: Array
    residual_cov_mm2: Array
    observed_cov_mm2: Array
    iterations: int

    def chi2(self) -> float:
        """Sum of the weighted squares of the residuals."""
        r = self.residuals_mm
        return float(np.einsum("mi,mi->", r, np.linalg.solve(self.observed_cov_mm2, r[:, :, None])[:, :, 0]))


@dataclass
class _State:
    """One linearisation: everything in W."""

    seen_mm: Array
    weight: Array
    a: Array
    own: Array
    mean_cov: Array
    points_mm: Array
    shared: Array
    gradient: Array


def adjust(observations: Observations, start: tuple[Pose, ...], held: int) -> Adjusted:
    """Adjust from `start`, the poses of all stations, of which the one with index `held` stays where it is.

    Raises DegenerateTargets where a station is not tied to the others in all six degrees of freedom.
    """
    poses, count = list(start), len(start)
    spots = np.array([X.apply(z) for X, z in _with_poses(observations, poses)])
    pivots = np.array([_mean(spots[observations.station == k], poses[k]) for k in range(count)])
    length = max(float(np.sqrt(np.mean(np.sum((spots - spots.mean(axis=0)) ** 2, axis=1)))), 1e-9)
    free = np.repeat(np.arange(count) != held, 6)
    unit = np.tile([1.0 / length] * 3 + [1.0] * 3, count)
    limit_mm = 1e-11 + 8.0 * float(np.finfo(np.float64).eps) * float(np.max(np.abs(spots)))
    for iteration in range(1, _MAX_ITERATIONS + 1):
        state = _linearised(observations, poses, pivots)
        cov = _covariance(_reduced(state, observations.station, count), free, unit)
        step = cov @ state.gradient
        for k in range(count):
            w, d = step[6 * k : 6 * k + 3], step[6 * k + 3 : 6 * k + 6]
            turn = exp_so3(w)
            poses[k] = Pose(turn @ poses[k].R, turn @ (poses[k].t_mm - pivots[k]) + pivots[k] + d)
        if float(np.max(np.abs(step / unit))) < limit_mm:
            return _result(observations, poses, pivots, cov, iteration)
    raise NotCongruent("network", "the adjustment does not converge", value=count, limit=count)


def _with_poses(observations: Observations, poses: list[Pose]) -> list[tuple[Pose, Array]]:
    return [(poses[k], z) for k, z in zip(observations.station, observations.xyz_mm, strict=True)]


def _mean(spots_mm: Array, X: Pose) -> Array:
    result: Array = spots_mm.mean(axis=0) if len(spots_mm) else np.array(X.t_mm)
    return result


def _linearised(observations: Observations, poses: list[Pose], pivots_mm: Array) -> _State:
    station, point = observations.station, observations.point
    R = np.array([X.R for X in poses])[station]
    t = np.array([X.t_mm for X in poses])[station]
    seen = np.einsum("mij,mj->mi", R, observations.xyz_mm) + t
    own = R @ observations.cov_mm2 @ np.swapaxes(R, 1, 2)
    weight = np.asarray(np.linalg.inv(own), dtype=np.float64)
    a = design(seen - pivots_mm[station], np.zeros(3))[:, :, :6]
    count = int(point.max()) + 1
    total, moment = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(total, point, weight)
    np.add.at(moment, point, np.einsum("mij,mj->mi", weight, seen))
    known = np.linalg.det(total) > 0.0
    mean_cov = np.full((count, 3, 3), np.nan)
    mean_cov[known] = np.linalg.inv(total[known])
    points = np.einsum("nij,nj->ni", mean_cov, moment)
    aw = np.swapaxes(a, 1, 2) @ weight
    shared, gradient = np.zeros((count, 6 * len(poses), 3)), np.zeros(6 * len(poses))
    off = np.einsum("mpi,mi->mp", aw, points[point] - seen)
    for k in range(len(poses)):
        rows = np.flatnonzero(station == k)
        np.add.at(shared[:, 6 * k : 6 * k + 6], point[rows], aw[rows])
        gradient[6 * k : 6 * k + 6] = off[rows].sum(axis=0)
    return _State(seen, weight, a, own, mean_cov, points, shared, gradient)


def _reduced(state: _State, station: Index, count: int) -> Array:
    """Normal matrix (6k, 6k) of the poses with the points eliminated."""
    normal = np.zeros((6 * count, 6 * count))
    each = np.swapaxes(state.a, 1, 2) @ state.weight @ state.a
    for k in range(count):
        normal[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = each[station == k].sum(axis=0)
    known = np.isfinite(state.mean_cov[:, 0, 0])
    shared = state.shared[known]
    taken: Array = normal - np.einsum("npi,nij,nqj->pq", shared, state.mean_cov[known], shared, optimize=True)
    return (taken + taken.T) / 2.0


def _covariance(normal: Array, free: NDArray[np.bool_], unit: Array) -> Array:
    """Inverse (6k, 6k) over the free parameters, zero elsewhere."""
    rows = np.flatnonzero(free)
    block = np.ix_(rows, rows)
    values, vectors = np.linalg.eigh((normal * np.outer(unit, unit))[block])
    if len(values) and not (values[0] > _SINGULAR * values[-1]):
        raise DegenerateTargets(
            "network",
            "a station is not tied to the others",
            value=float(values[0]),
            limit=_SINGULAR * float(values[-1]),
        )
    cov = np.zeros_like(normal)
    cov[block] = (vectors / values) @ vectors.T * np.outer(unit[rows], unit[rows])
    return cov


def _result(observations: Observations, poses: list[Pose], pivots_mm: Array, cov: Array, iterations: int) -> Adjusted:
    s = _linearised(observations, poses, pivots_mm)
    station, point = observations.station, observations.point
    to_points = cov @ s.shared @ s.mean_cov
    points_cov = s.mean_cov + np.swapaxes(s.shared @ s.mean_cov, 1, 2) @ to_points
    rows = 6 * station[:, None] + np.arange(6)
    own = cov[rows[:, :, None], rows[:, None, :]]
    cross = s.a @ to_points[point[:, None], rows]
    moved = s.a @ own @ np.swapaxes(s.a, 1, 2) - cross - np.swapaxes(cross, 1, 2) + points_cov[point]
    residual = s.seen_mm - s.points_mm[point]
    return Adjusted(tuple(poses), cov, pivots_mm, s.points_mm, points_cov, residual, s.own - moved, s.own, iterations)
