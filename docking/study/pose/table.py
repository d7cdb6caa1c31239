"""Table 1 of [Luo] with many draws: the fitting error of the three methods for ten points known to +-0.5 mm."""

from __future__ import annotations

from typing import Any

import numpy as np

from docking.pose import METHODS, FitSettings, fit_pose
from docking.pose.batch import PoseBatch, fit_poses, three_point_poses
from docking.pose.least_squares import fit_gauss_newton
from docking.pose.three_point import best_triangle
from docking.study.pose.layouts import LAYOUTS, Block, Generator, Layout, blocks
from docking.types import Array, Pose, Screened

AMPLITUDE_MM = 0.5
PAPER_MM = {"svd": 0.400, "three-point": 0.529, "least-squares": 0.401}
"""The one draw of [Luo] Table 1; its points are not given."""
_FIRST = (0, 2, 4)
"""An arbitrary triangle: the first three targets of one side (of the front spar, of one frame)."""


def fitting_error_mm(block: Block, poses: PoseBatch, rows: int | None = None) -> Array:
    """[Luo] Eq. 15, 16: largest `|R' J_i + T' - P_i|` (b,) over the first `rows` points against the TRUE points."""
    off = point_errors_mm(block, poses)[:, :rows]
    largest: Array = off.max(axis=1)
    return largest


def point_errors_mm(block: Block, poses: PoseBatch) -> Array:
    """`|R' J_i + T' - P_i|` (b, n) at every target."""
    gap = block.nominal_mm @ poses.R.transpose(0, 2, 1) + poses.t_mm[:, None] - block.X.apply(block.nominal_mm)
    lengths: Array = np.linalg.norm(gap, axis=2)
    return lengths


def spread_of(values: Array) -> dict[str, float]:
    """Mean, median and the 5 and 95 % points."""
    p5, p50, p95 = (float(v) for v in np.percentile(values, (5.0, 50.0, 95.0)))
    return {"mean": float(np.mean(values)), "p5": p5, "p50": p50, "p95": p95}


def table_of(layout: Layout, draws: int, checked: int, rng: Generator) -> dict[str, Any]:
    """Distributions over `draws` for one layout; `checked` of them are fitted by iterated least squares as well."""
    svd: list[Array] = []
    best: list[Array] = []
    first: list[Array] = []
    gap, left = 0.0, checked
    for block in blocks(layout, draws, rng):
        p = block.measured_mm(AMPLITUDE_MM)
        poses = fit_poses(block.nominal_mm, p)
        svd.append(fitting_error_mm(block, poses))
        for found, triangle in ((best, best_triangle(block.nominal_mm)), (first, _FIRST)):
            found.append(fitting_error_mm(block, three_point_poses(block.nominal_mm, p, triangle)))
        share = min(max(1, checked * len(p) // draws), left, len(p))
        gap, left = max(gap, _least_squares_gap_mm(block, p[:share], poses)), left - share
    return {
        "layout": layout.name,
        "words": layout.words,
        "draws": draws,
        "checked": checked - left,
        "least_squares_gap_mm": gap,
        **_compared(*(np.concatenate(v) for v in (svd, best, first))),
    }


def _compared(svd: Array, best: Array, first: Array) -> dict[str, Any]:
    ratio = best / svd
    return {
        "svd": spread_of(svd),
        "three-point": spread_of(best),
        "three-point, first": spread_of(first),
        "ratio_of_means": float(best.mean() / svd.mean()),
        "ratio_of_means_first": float(first.mean() / svd.mean()),
        "three_point_worse": float(np.mean(best > svd)),
        "paper_svd_at": float(np.mean(svd < PAPER_MM["svd"])),
        "paper_three_point_at": float(np.mean(best < PAPER_MM["three-point"])),
        "paper_three_point_first_at": float(np.mean(first < PAPER_MM["three-point"])),
        "paper_ratio_at": float(np.mean(ratio < PAPER_MM["three-point"] / PAPER_MM["svd"])),
    }


def _least_squares_gap_mm(block: Block, p_mm: Array, poses: PoseBatch) -> float:
    """Largest distance at any target between iterated least squares from three points and the closed form."""
    worst = 0.0
    for k, measured in enumerate(p_mm):
        X = fit_gauss_newton(block.nominal_mm, measured)[0]
        off = X.apply(block.nominal_mm) - Pose(poses.R[k], poses.t_mm[k]).apply(block.nominal_mm)
        worst = max(worst, float(np.max(np.linalg.norm(off, axis=1))))
    return worst


def noiseless_mm(draws: int, rng: Generator) -> dict[str, float]:
    """Largest fitting error of every method over exact points, `draws` of each layout."""
    worst = dict.fromkeys(METHODS, 0.0)
    for layout in LAYOUTS:
        for _ in range(draws):
            block = next(blocks(layout, 1, rng))
            n, places = len(block.nominal_mm), block.X.apply(block.nominal_mm)
            names, none = tuple(f"T{i}" for i in range(n)), np.zeros((n, 3, 3))
            exact = Screened(names, block.nominal_mm, none, places, none + 1e-4 * np.eye(3))
            for method in worst:
                off = fit_pose(exact, FitSettings(method=method)).X_MN.apply(block.nominal_mm) - places  # type: ignore[arg-type]
                worst[method] = max(worst[method], float(np.max(np.linalg.norm(off, axis=1))))
    return worst


def rms_ratios(points: range, draws: int, rng: Generator, layout: Layout) -> dict[int, float]:
    """rms error at the fitted points over `sigma sqrt(6 / n)`, sigma of a coordinate, for every number of points."""
    ratios = {}
    for n in points:
        squares = [
            float(np.sum(point_errors_mm(block, fit_poses(block.nominal_mm, block.measured_mm(AMPLITUDE_MM))) ** 2))
            for block in blocks(layout, draws, rng, n)
        ]
        rms = np.sqrt(sum(squares) / (draws * n))
        ratios[n] = float(rms / (AMPLITUDE_MM / np.sqrt(3.0) * np.sqrt(6.0 / n)))
    return ratios
