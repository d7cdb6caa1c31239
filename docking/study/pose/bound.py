"""How near the estimators come to the Cramer-Rao bound on a laser tracker's noise; is the stated covariance honest?

The bound of a point x is `A_x N^-1 A_x^T`, `N = sum A_i^T S_i^-1 A_i`: no unbiased estimator is better;
docs/fit.md (6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from docking.geometry import log_so3
from docking.pose import LASER_TRACKER, FitSettings, fit_pose
from docking.pose.batch import PoseBatch, fit_poses, three_point_poses
from docking.pose.least_squares import design
from docking.pose.three_point import best_triangle
from docking.pose.uncertainty import pose_difference
from docking.study.pose.layouts import BARREL, HALF_LENGTH_MM, RADIUS_MM, WING, Generator, random_barrel, random_pose
from docking.types import Array, Pose, Screened

Noise = Callable[[Array], Array]
"""Covariances (n, 3, 3) in mm^2 of readings at points (n, 3), both in the part's frame."""


def _seen_from(*station_mm: float) -> Noise:
    return lambda points: LASER_TRACKER.covariance(points - np.array(station_mm))


def _fused(points: Array) -> Array:
    """Two trackers measure every target; their readings are averaged by their covariances."""
    both = [_seen_from(0.0, y, 500.0)(points) for y in (-6000.0, 6000.0)]
    return np.linalg.inv(np.linalg.inv(both[0]) + np.linalg.inv(both[1]))


def _two_worse(points: Array) -> Array:
    cov = _seen_from(500.0, -9000.0, 800.0)(points)
    cov[:2] *= 25.0
    return cov


def _ring(points: Array) -> Array:
    """Docking features: the far end ring."""
    angle = np.arange(4) * np.pi / 2.0
    return np.column_stack([np.full(4, HALF_LENGTH_MM), RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)])


def _near_third(n: int) -> Array:
    """Ten targets in the third of the section that is far from the docking ring."""
    points = random_barrel(np.random.default_rng(4), n)
    points[:, 0] = -HALF_LENGTH_MM + (points[:, 0] + HALF_LENGTH_MM) / 3.0
    return points


@dataclass(frozen=True)
class Case:
    """Targets (n, 3), their noise, and the points (m, 3) at which the error counts, by default the targets."""

    name: str
    targets_mm: Array
    noise: Noise
    at: Callable[[Array], Array] = lambda points: points


def cases() -> tuple[Case, ...]:
    """Where the tracker stands is in the part's frame, mm."""
    rng = np.random.default_rng(1)
    beside = _seen_from(500.0, -9000.0, 800.0)
    barrel, long_wing = BARREL.targets(rng), WING.targets(rng)
    return (
        Case("same noise in all directions", barrel, lambda p: np.tile(0.05**2 * np.eye(3), (len(p), 1, 1))),
        Case("tracker 4.5 m to the side", barrel, _seen_from(500.0, -4500.0, 800.0)),
        Case("tracker 9 m to the side", barrel, beside),
        Case("tracker 15 m to the side", barrel, _seen_from(500.0, -15000.0, 800.0)),
        Case("tracker on the axis, 11-20 m", barrel, _seen_from(-15500.0, 300.0, 200.0)),
        Case("targets in the near third, error at the far ring", _near_third(10), beside, _ring),
        Case("wing, tracker at the root", long_wing, _seen_from(2000.0, -4000.0, 1500.0)),
        Case("two trackers, fused", barrel, _fused),
        Case("2 of 10 targets five times noisier, as stated", barrel, _two_worse),
    )  # fmt: skip


def bound_of(case: Case, draws: int, rng: Generator) -> dict[str, Any]:
    """Ratios of the methods' rms errors to the bound at the points and in rotation, and NEES of maximum likelihood."""
    X = random_pose(rng)
    j, places = case.targets_mm, X.apply(case.targets_mm)
    cov = X.R @ case.noise(j) @ X.R.T
    at = case.at(j)
    limit_mm, limit_rad = _limits(places, cov, X.apply(at))
    p = places + np.einsum("nij,bnj->bni", np.linalg.cholesky(cov), rng.normal(size=(draws, len(j), 3)))
    ml, nees = _maximum_likelihood(j, (p, cov), X)
    found = {
        "ml": ml,
        "svd": fit_poses(j, p),
        "three-point": three_point_poses(j, p, best_triangle(j)),
    }
    result: dict[str, Any] = {
        "case": case.name,
        "draws": draws,
        "bound_um": 1e3 * limit_mm,
        "bound_urad": 1e6 * limit_rad,
    }
    for method, poses in found.items():
        point, turn = _rms(poses, X, at)
        result[method] = {"point": point / limit_mm, "rotation": turn / limit_rad}
    return {**result, "nees": float(np.mean(nees)), "nees_sd": float(np.std(nees) / np.sqrt(draws))}


def _limits(places: Array, cov: Array, at: Array) -> tuple[float, float]:
    """Bound of the rms error at the points (mm) and of the rotation vector's length (rad)."""
    centre = places.mean(axis=0)
    a = design(places, centre)[:, :, :6]
    inverse = np.linalg.inv(np.einsum("nik,nij,njl->kl", a, np.linalg.inv(cov), a))
    b = design(at, centre)[:, :, :6]
    point = np.trace(b @ inverse @ b.transpose(0, 2, 1), axis1=1, axis2=2)
    return float(np.sqrt(np.mean(point))), float(np.sqrt(np.trace(inverse[:3, :3])))


def _maximum_likelihood(j: Array, measured: tuple[Array, Array], X: Pose) -> tuple[PoseBatch, Array]:
    """Poses of `fit_pose` for every draw of (b, n, 3), and their normalised squared errors (b,)."""
    p, cov = measured
    names, exact, settings = tuple(f"T{i}" for i in range(len(j))), np.zeros((len(j), 3, 3)), FitSettings()
    R, t, nees = np.empty((len(p), 3, 3)), np.empty((len(p), 3)), np.empty(len(p))
    for k, reading in enumerate(p):
        fit = fit_pose(Screened(names, j, exact, reading, cov), settings)
        d = pose_difference(fit.X_MN, X, fit.pivot_mm)
        R[k], t[k], nees[k] = fit.X_MN.R, fit.X_MN.t_mm, d @ np.linalg.solve(fit.cov, d)
    return PoseBatch(R, t), nees


def _rms(poses: PoseBatch, X: Pose, at: Array) -> tuple[float, float]:
    """rms error at points (m, 3) of the part, and of the rotation."""
    gap = at @ poses.R.transpose(0, 2, 1) + poses.t_mm[:, None] - X.apply(at)
    turn = np.array([log_so3(R) for R in poses.R @ X.R.T])
    point_mm, turn_rad = (float(np.sqrt(np.mean(np.sum(v * v, axis=-1)))) for v in (gap, turn))
    return point_mm, turn_rad
