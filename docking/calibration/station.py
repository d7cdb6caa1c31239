"""The tracker's place in the assembly frame, and whether it still stands there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import SigmaMissing, TooFewPoints
from docking.pose import FitSettings, fit_pose, screen
from docking.pose.passes import mean_reading
from docking.pose.quantiles import chi2_upper, normal_tail
from docking.pose.uncertainty import largest_sigma_mm
from docking.types import Array, Fit, Points, Pose, Screened

MIN_REFERENCES = 3


def locate_station(ers: Points, readings: Points, settings: FitSettings | None = None) -> Fit:
    """Station pose X_WT: fit of the ERS readings (frame T, any number of passes) onto the ERS points (frame W).

    In the result N is T and M is W: `fit.X_MN` is X_WT, its covariance, pivot and residuals are in W.
    Raises as `docking.pose.screen` does.
    """
    settings = FitSettings(where="station") if settings is None else settings
    s = screen(ers, readings, settings)
    turned = Screened(
        s.names, s.measured_mm, s.measured_cov_mm2, s.nominal_mm, s.nominal_cov_mm2, s.rejected, s.dropped
    )  # fmt: skip
    return fit_pose(turned, settings)


def to_world(X_WT: Pose, readings: Points) -> Points:
    """Readings of frame T in W, covariances turned with them; the station's own uncertainty is not added."""
    return Points(readings.names, X_WT.apply(readings.xyz_mm), X_WT.R @ readings.cov_mm2 @ X_WT.R.T, readings.passes)


@dataclass(frozen=True, eq=False)
class ReferenceShift:
    """Re-measured reference points against where they were: `shift_mm` (n, 3) in W, `sigma_mm` (n,) its uncertainty.

    `common_mm` (3,) is their weighted mean shift, known to `common_sigma_mm`. `moved` is the verdict, `worst_mm` and
    `limit_mm` its numbers:
    the common shift when that decides, else the point nearest to or farthest beyond its limit.
    """

    names: tuple[str, ...]
    shift_mm: Array
    sigma_mm: Array
    common_mm: Array
    moved: bool
    worst_mm: float
    limit_mm: float
    common_sigma_mm: float


def reference_shift(X_WT: Pose, reference: Points, readings: Points, sigmas: float = 3.0) -> ReferenceShift:
    """Test whether reference points (ERS or mate targets) still read as they did when the station was located.

    `reference` (W): their places then, best `to_world(X_WT, first readings)`, so that errors of nominal values cancel;
    `readings` (T): now, in one or more passes, of which ALL count: one that disagrees is a sign, not noise.
    Two tests, each at the two-sided probability of `sigmas` (3: 0.27 %): the common shift (all points together) and
    each single point. Not measurable counts as moved: a NaN fails both.
    Raises TooFewPoints under three common points, SigmaMissing where a covariance is not known.
    """
    rows = {name: i for i, name in enumerate(reference.names)}
    common = [(rows[name], i) for i, name in enumerate(dict.fromkeys(readings.names)) if name in rows]
    if not (len(common) >= MIN_REFERENCES):
        raise TooFewPoints("reference points", value=len(common), limit=MIN_REFERENCES)
    before, now = [r for r, _ in common], [i for _, i in common]
    world = to_world(X_WT, _averaged(readings))
    shift = world.xyz_mm[now] - reference.xyz_mm[before]
    cov = world.cov_mm2[now] + reference.cov_mm2[before]
    if not bool(np.all(np.isfinite(cov))):
        raise SigmaMissing("reference points", value="a reading")
    return _verdict(tuple(world.names[i] for i in now), shift, cov, 2.0 * normal_tail(sigmas))


def _averaged(readings: Points) -> Points:
    """One row a name, in the order of first appearance."""
    names = np.array(readings.names)
    order = tuple(dict.fromkeys(readings.names))
    means = [mean_reading(readings.xyz_mm[names == n], readings.cov_mm2[names == n]) for n in order]
    xyz, cov = (np.array([m[k] for m in means]) for k in (0, 1))
    return Points(order, xyz.reshape(-1, 3), cov.reshape(-1, 3, 3))


def _verdict(names: tuple[str, ...], shift: Array, cov: Array, probability: float) -> ReferenceShift:
    weight = np.linalg.inv(cov)
    mean_cov = np.linalg.inv(weight.sum(axis=0))
    mean = mean_cov @ np.einsum("nij,nj->i", weight, shift)
    together = float(mean @ np.linalg.solve(mean_cov, mean)) / chi2_upper(probability, 3)
    single = np.einsum("ni,nij,nj->n", shift, weight, shift) / chi2_upper(probability / len(names), 3)
    worst = int(np.argmax(single))
    ratio, size = (together, mean) if together >= single[worst] else (float(single[worst]), shift[worst])
    value = float(np.linalg.norm(size))
    moved = not (ratio <= 1.0)
    limit = value / float(np.sqrt(ratio)) if ratio > 0.0 else float("inf")
    common_sigma = float(largest_sigma_mm(mean_cov[None])[0])
    return ReferenceShift(names, shift, largest_sigma_mm(cov), mean, moved, value, limit, common_sigma)
