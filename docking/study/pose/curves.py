"""Fig. 2 and Fig. 3 of [Luo]: the fitting error against the number of points and against the size of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from docking.errors import NotCongruent
from docking.pose.batch import fit_poses
from docking.pose.least_squares import fit_gauss_newton
from docking.pose.svd import fit_svd
from docking.study.pose.layouts import BARREL, LAYOUTS, POINTS, Block, Generator, Layout, blocks, random_pose
from docking.study.pose.table import AMPLITUDE_MM, fitting_error_mm, spread_of
from docking.types import Array, Pose

COUNTS = range(3, POINTS + 1)
AMPLITUDES_MM = (0.1, 0.5, *(float(k) for k in range(1, 11)))
"""The paper's range."""
BEYOND_MM = (100.0, 1000.0, 2000.0, 4000.0)
"""Errors as large as the part itself."""
SHOWN = 8
"""Single draws that are shown: the paper's figures are one."""
REACHED_MM = 1e-6
"""Least squares has found the optimum when it is this near at every target."""
SMALL_MM = 20.0
"""A part so small that errors of 10 mm leave little of it."""


def number_of_points(layout: Layout, draws: int, rng: Generator) -> dict[str, Any]:
    """Error at all ten targets, and at the fitted ones, of fits to the first n targets; the same draws for all n."""
    every: dict[int, list[Array]] = {n: [] for n in COUNTS}
    fitted: dict[int, list[Array]] = {n: [] for n in COUNTS}
    for block in blocks(layout, draws, rng):
        p = block.measured_mm(AMPLITUDE_MM)
        for n in COUNTS:
            poses = fit_poses(block.nominal_mm[:n], p[:, :n])
            every[n].append(fitting_error_mm(block, poses))
            fitted[n].append(fitting_error_mm(block, poses, n))
    table = np.array([np.concatenate(every[n]) for n in COUNTS])
    return {
        "layout": layout.name,
        "counts": list(COUNTS),
        "all": [spread_of(row) for row in table],
        "fitted": [spread_of(np.concatenate(fitted[n])) for n in COUNTS],
        "single": table[:, :SHOWN].T.tolist(),
        "monotone": float(np.mean(np.all(np.diff(table, axis=0) <= 0.0, axis=0))),
        "many_better_than_few": float(np.mean(table[4:].mean(axis=0) < table[:4].mean(axis=0))),
    }


def size_of_errors(draws: int, fits: int, rng: Generator) -> dict[str, Any]:
    """Error of the fit for errors uniform in +-a: bands, one draw scaled, fresh draws, and least squares' convergence.

    `fits` draws of every amplitude are fitted by Gauss-Newton from three points.
    """
    (block,) = blocks(BARREL, SHOWN, rng)
    scaled = [_errors(block, a).tolist() for a in AMPLITUDES_MM]
    lines = np.array(scaled).T
    rows = []
    for a in (*AMPLITUDES_MM, *BEYOND_MM):
        errors = np.concatenate([_errors(b, a) for b in blocks(BARREL, draws, rng)])
        rows.append({"amplitude_mm": a, **spread_of(errors), **gauss_newton(BARREL, a, fits, rng)})
    fresh = [[float(_errors(next(blocks(BARREL, 1, rng)), a)[0]) for a in AMPLITUDES_MM] for _ in range(SHOWN)]
    return {
        "rows": rows,
        "scaled": lines.tolist(),
        "fresh": fresh,
        "straightness": float(np.max(np.abs(lines / np.array(AMPLITUDES_MM) / lines[:, :1] * AMPLITUDES_MM[0] - 1.0))),
        "layouts": {layout.name: gauss_newton(layout, 10.0, fits, rng) for layout in LAYOUTS},
        "small": {"size_mm": SMALL_MM, **_small(fits, rng)},
    }


def _errors(block: Block, amplitude_mm: float) -> Array:
    return fitting_error_mm(block, fit_poses(block.nominal_mm, block.measured_mm(amplitude_mm)))


def gauss_newton(layout: Layout, amplitude_mm: float, fits: int, rng: Generator) -> dict[str, Any]:
    """Share of fits by Gauss-Newton from three points that end at the optimum, and their iterations."""
    found = [_one(block.nominal_mm, p) for block in blocks(layout, fits, rng) for p in block.measured_mm(amplitude_mm)]
    reached = [k for k in found if k is not None]
    return {
        "converged": len(reached) / fits,
        "fits": fits,
        "iterations": float(np.median(reached)) if reached else None,
        "most_iterations": max(reached, default=None),
    }


def _one(nominal_mm: Array, measured_mm: Array) -> int | None:
    """Iterations to the optimum; None where it is not reached."""
    try:
        X, iterations = fit_gauss_newton(nominal_mm, measured_mm)
    except NotCongruent:
        return None
    return iterations if gap_mm(X, fit_svd(nominal_mm, measured_mm), nominal_mm) <= REACHED_MM else None


def gap_mm(X: Pose, Y: Pose, points_mm: Array) -> float:
    """Largest distance between two poses at the points (n, 3)."""
    return float(np.max(np.linalg.norm(X.apply(points_mm) - Y.apply(points_mm), axis=1)))


def _small(fits: int, rng: Generator) -> dict[str, Any]:
    """Errors of 10 mm on a part of 20 mm: the barrel shrunk."""
    j = BARREL.targets(rng)
    j = j * SMALL_MM / float(np.max(np.ptp(j, axis=0)))
    found = [_one(j, random_pose(rng).apply(j) + rng.uniform(-10.0, 10.0, j.shape)) for _ in range(fits)]
    return {"converged": sum(k is not None for k in found) / fits, "fits": fits}
