"""[Luo]'s first conclusion: how much does least squares depend on where it starts?

Two solvers: the one of `docking fit`, and Eq. 12 as it is printed, with the inverse of the normal equations in mm and
rad about a far origin and without a change of the base rotation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import radians
from typing import Any

import numpy as np

from docking.errors import NotCongruent
from docking.geometry import euler_to_matrix, exp_so3, matrix_to_euler
from docking.pose.least_squares import MAX_ITERATIONS, euler_jacobian, fit_gauss_newton
from docking.pose.svd import fit_svd
from docking.pose.three_point import fit_three_point
from docking.study.pose.curves import REACHED_MM, gap_mm
from docking.study.pose.layouts import BARREL, Generator, random_pose
from docking.study.pose.table import AMPLITUDE_MM
from docking.types import Array, Pose

OFFS_DEG = (10.0, 45.0, 90.0, 135.0, 175.0)
Solver = Callable[[Array, Array, Pose], tuple[Pose, int]]
_STILL_MM = 1e-7
"""Eq. 12 as printed is stopped when the step moves no target by more: below is its rounding."""


def printed_gauss_newton(nominal_mm: Array, measured_mm: Array, start: Pose) -> tuple[Pose, int]:
    """[Luo] Eq. 12 to the letter, signs of Eq. 10 put right: pose and iterations. Raises NotCongruent."""
    e = matrix_to_euler(start.R)
    x = np.array([e.alpha_rad, e.beta_rad, e.gamma_rad, *start.t_mm])
    for iteration in range(1, MAX_ITERATIONS + 1):
        f = (nominal_mm @ euler_to_matrix(*x[:3]).T + x[3:] - measured_mm).reshape(-1)
        a = euler_jacobian(x[0], x[1], x[2], nominal_mm).reshape(-1, 6)
        try:
            step = np.linalg.inv(a.T @ a) @ (a.T @ f)
        except np.linalg.LinAlgError:
            break
        x = x - step
        moved = float(np.max(np.abs(a @ step)))
        if moved <= _STILL_MM:
            return Pose(euler_to_matrix(*x[:3]), x[3:]), iteration
    raise NotCongruent("fit", "Eq. 12 does not converge", value=len(nominal_mm), limit=len(nominal_mm))


def product_gauss_newton(nominal_mm: Array, measured_mm: Array, start: Pose) -> tuple[Pose, int]:
    """`docking fit --method least-squares` from a start of our choice."""
    return fit_gauss_newton(nominal_mm, measured_mm, start)


SOLVERS: dict[str, Solver] = {"docking": product_gauss_newton, "as printed": printed_gauss_newton}


def _far(best: Pose, off_deg: float, centre_mm: Array, rng: Generator) -> Pose:
    """The best pose turned by so much about any axis through the part's middle, and a metre beside it."""
    axis = rng.normal(size=3)
    turn = exp_so3(axis / np.linalg.norm(axis) * radians(off_deg))
    c = best.apply(centre_mm)
    return Pose(turn @ best.R, turn @ (best.t_mm - c) + c + rng.uniform(-1000.0, 1000.0, 3))


def _starts(j: Array, p: Array, rng: Generator) -> dict[str, tuple[Pose, float]]:
    """Every start by name and the seconds that it takes to find it."""
    began = time.perf_counter()
    three = fit_three_point(j, p)
    middle = time.perf_counter()
    svd = fit_svd(j, p)
    end = time.perf_counter()
    far = {f"{off:.0f} deg off": (_far(svd, off, j.mean(axis=0), rng), 0.0) for off in OFFS_DEG}
    return {
        "three-point": (three, middle - began),
        "SVD": (svd, end - middle),
        "all zero": (Pose(np.eye(3), np.zeros(3)), 0.0),
        **far,
    }


def starts(fits: int, rng: Generator) -> list[dict[str, Any]]:
    """A row for each solver, start, and attitude of the part (any, or beta = 90 deg): convergence, iterations, time."""
    found: dict[tuple[str, str, str], list[tuple[bool, int, float]]] = {}
    for attitude in ("any attitude", "beta = 90 deg"):
        for _ in range(fits):
            j, X = BARREL.targets(rng), random_pose(rng)
            if attitude != "any attitude":
                angles = rng.uniform(-np.pi, np.pi, 2)
                X = Pose(euler_to_matrix(angles[0], np.pi / 2, angles[1]), X.t_mm)
            p = X.apply(j) + rng.uniform(-AMPLITUDE_MM, AMPLITUDE_MM, j.shape)
            for name, (start, seconds) in _starts(j, p, rng).items():
                for solver in SOLVERS:
                    row = _tried(SOLVERS[solver], (j, p), start)
                    found.setdefault((solver, attitude, name), []).append((row[0], row[1], seconds + row[2]))
    return [_summed(key, rows) for key, rows in found.items()]


def _tried(solver: Solver, points: tuple[Array, Array], start: Pose) -> tuple[bool, int, float]:
    """Whether the optimum was found, the iterations, the seconds."""
    j, p = points
    began = time.perf_counter()
    try:
        X, iterations = solver(j, p, start)
    except NotCongruent:
        return False, MAX_ITERATIONS, time.perf_counter() - began
    seconds = time.perf_counter() - began
    return gap_mm(X, fit_svd(j, p), j) <= REACHED_MM, iterations, seconds


def _summed(key: tuple[str, str, str], rows: list[tuple[bool, int, float]]) -> dict[str, Any]:
    good = [row for row in rows if row[0]]
    return {
        "solver": key[0],
        "attitude": key[1],
        "start": key[2],
        "fits": len(rows),
        "converged": len(good) / len(rows),
        "iterations": float(np.median([row[1] for row in good])) if good else None,
        "most_iterations": max((row[1] for row in good), default=None),
        "time_us": 1e6 * float(np.median([row[2] for row in good])) if good else None,
    }
