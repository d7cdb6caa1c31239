"""Data snooping on the fit: every point, kept or not, is tested against the pose that the kept points define.

With known covariances the statistic is `T_i = r_i^T V_i^-1 r_i`, chi-square with 3 degrees of freedom, where V_i is the
covariance of the residual: S_i minus the pose's share for a kept point, plus it for another. Where the scale of the
noise was estimated from the same points, T_i / 3 is divided by the variance factor of the other points and follows F.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.pose.least_squares import Solution, design, fit_maximum_likelihood
from docking.pose.quantiles import chi2_upper, fisher_upper
from docking.pose.settings import FitSettings
from docking.pose.svd import fit_svd
from docking.pose.uncertainty import total_cov_mm2
from docking.types import Array

_ROUNDS = 40
_LEAST_SCALED = 4
SMALLEST_SIGMA_MM = 1e-4
"""An estimated sigma is not believed below this: files and arithmetic round."""
_POINTS_SHARE = 0.8
"""Share of the permitted false alarms that the test of single points may spend; the rest is for the choice among sets
and the global test, which see the same noise in other combinations."""


class Pairs(NamedTuple):
    """All matched points, row by row: coordinates (n, 3) and covariances (n, 3, 3), nominal in N, measured in M."""

    names: tuple[str, ...]
    nominal_mm: Array
    measured_mm: Array
    nominal_cov_mm2: Array
    measured_cov_mm2: Array

    def rows(self, index: Array | NDArray[np.intp] | list[int]) -> Pairs:
        """The pairs of some rows."""
        i = np.asarray(index, dtype=np.intp)
        return Pairs(
            tuple(self.names[k] for k in i),
            self.nominal_mm[i],
            self.measured_mm[i],
            self.nominal_cov_mm2[i],
            self.measured_cov_mm2[i],
        )


class Tested(NamedTuple):
    """Outcome of the snooping: rows kept, the pose they define, statistic over its threshold a point (n,), how many
    points the test put out, and chi-square of the kept ones."""

    kept: list[int]
    solution: Solution
    ratio: Array
    snooped: int
    chi2: float


def solve(pairs: Pairs, expansion_sigma: float) -> Solution:
    """Maximum-likelihood pose of the pairs, started from the closed form."""
    start = fit_svd(pairs.nominal_mm, pairs.measured_mm)
    covs = (pairs.nominal_cov_mm2, pairs.measured_cov_mm2)
    return fit_maximum_likelihood(pairs.nominal_mm, pairs.measured_mm, covs, start, expansion_sigma)


def residuals_mm(pairs: Pairs, solution: Solution) -> Array:
    """Measured minus fitted (n, 3), the fitted expansion included."""
    q = solution.X_MN.apply(pairs.nominal_mm)
    result: Array = pairs.measured_mm - q - solution.expansion * (q - solution.pivot_mm)
    return result


def _statistics(pairs: Pairs, solution: Solution, kept: list[int]) -> Array:
    """T_i (n,) of every point."""
    r = residuals_mm(pairs, solution)
    s = total_cov_mm2(pairs.nominal_cov_mm2, pairs.measured_cov_mm2, solution.X_MN.R)
    a = design(solution.X_MN.apply(pairs.nominal_mm), solution.pivot_mm)
    share = a @ solution.cov @ a.transpose(0, 2, 1)
    sign = np.ones(len(r))
    sign[kept] = -1.0
    v = s + sign[:, None, None] * share
    values, vectors = np.linalg.eigh(v)
    # A kept point of a small set has residual directions without redundancy; they carry no evidence either way.
    least = 1e-6 * np.trace(s, axis1=1, axis2=2)[:, None]
    component = np.einsum("nij,ni->nj", vectors, r)
    result: Array = np.sum(np.where(values > least, component**2 / np.maximum(values, least), 0.0), axis=1)
    return result


def _ratio(pairs: Pairs, kept: list[int], statistics: Array, alpha: float, scaled: bool) -> Array:
    """Statistic over threshold (n,); above 1 a point does not belong."""
    n = len(statistics)
    if not scaled:
        return statistics / chi2_upper(alpha / n, 3)
    inside = np.zeros(n, dtype=bool)
    inside[kept] = True
    total = float(np.sum(_weighted_squares(pairs, kept)))
    dof_all = 3 * len(kept) - 6
    dof = np.where(inside, max(dof_all - 3, 1), max(dof_all, 1)).astype(np.float64)
    # By the rank-one identity the other points' sum of squares is the total minus the statistic of the point tested.
    others = np.where(inside, np.maximum(total - statistics, 1e-9 * max(total, 1e-30)), total) / dof
    threshold = fisher_upper(alpha / n, 3, dof)
    variance = np.trace(pairs.nominal_cov_mm2 + pairs.measured_cov_mm2, axis1=1, axis2=2).mean() / 3.0
    result: Array = statistics / 3.0 / np.maximum(others, SMALLEST_SIGMA_MM**2 / variance) / threshold
    return result


def _weighted_squares(pairs: Pairs, kept: list[int]) -> Array:
    """r^T S^-1 r (k,) of the kept points in their own fit."""
    sub = pairs.rows(kept)
    solution = solve(sub, 0.0)
    r = residuals_mm(sub, solution)
    s = total_cov_mm2(sub.nominal_cov_mm2, sub.measured_cov_mm2, solution.X_MN.R)
    result: Array = np.einsum("ni,ni->n", r, np.linalg.solve(s, r[:, :, None])[:, :, 0])
    return result


def _level(settings: FitSettings) -> float:
    """Level of all tests of single points of one set together."""
    return _POINTS_SHARE * settings.false_alarm


def all_agree(pairs: Pairs, settings: FitSettings) -> Tested | None:
    """All pairs together, where the test of known covariances finds nothing wrong with any of them; else None."""
    everyone = list(range(len(pairs.names)))
    solution = solve(pairs, settings.expansion_sigma)
    ratio = _ratio(pairs, everyone, _statistics(pairs, solution, everyone), _level(settings), False)
    if not bool(np.all(ratio <= 1.0)):
        return None
    return Tested(everyone, solution, ratio, 0, _chi_square(pairs, solution))


def snoop(pairs: Pairs, kept: list[int], settings: FitSettings, scaled: bool) -> Tested:
    """Move points in or out of the kept set, the clearest case first, until all agree with the test.

    `scaled`: the covariances are known up to a factor only. A point once put out by the test stays out, and no point is
    put out when fewer than `settings.min_agreeing` would remain, or fewer than four where they also tell the factor.
    """
    kept, banned = sorted(kept), set[int]()
    least = max(settings.min_agreeing, _LEAST_SCALED) if scaled else settings.min_agreeing
    for _ in range(_ROUNDS):
        solution = solve(pairs.rows(kept), settings.expansion_sigma)
        ratio = _ratio(pairs, kept, _statistics(pairs, solution, kept), _level(settings), scaled)
        worst = max(kept, key=lambda i: ratio[i])
        outside = [i for i in range(len(ratio)) if i not in kept and i not in banned]
        nearest = min(outside, key=lambda i: ratio[i], default=None)
        if ratio[worst] > 1.0 and len(kept) > least:
            kept.remove(worst)
            banned.add(worst)
        elif nearest is not None and ratio[nearest] <= 1.0:
            kept = sorted([*kept, nearest])
        else:
            break
    return Tested(kept, solution, ratio, len(banned), _chi_square(pairs.rows(kept), solution))


def _chi_square(pairs: Pairs, solution: Solution) -> float:
    """Sum of r^T S^-1 r of all the pairs."""
    r = residuals_mm(pairs, solution)
    s = total_cov_mm2(pairs.nominal_cov_mm2, pairs.measured_cov_mm2, solution.X_MN.R)
    return float(np.vdot(r, np.linalg.solve(s, r[:, :, None])[:, :, 0]))
