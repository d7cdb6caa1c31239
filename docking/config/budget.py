"""What the instrument can prove before anything is measured: sigma of every docking feature and its parts.

The component and the mate are fitted from the same station, so the station's own pose cancels in their difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.config.cell import CellFile
from docking.config.job import JobFile
from docking.config.nominal import feature_points, mate_feature_points, target_points
from docking.geometry import pose_from_vector
from docking.pose.layout import spread
from docking.pose.least_squares import design, weighted_centroid
from docking.pose.noise import NOISE_PRESETS, NoiseModel
from docking.pose.svd import fit_svd
from docking.types import Array, Points, Pose

REMEDIES = {
    "instrument noise on the component": "raise measuring.max_passes, add targets or bring the instrument nearer",
    "instrument noise on the mate": "raise measuring.max_passes, add mate targets or bring the instrument nearer",
    "as-built nominal of the component's targets": "add targets near the features, or survey the nests better",
    "as-built nominal of the mate's targets": "add mate targets near the features, or survey the nests better",
    "as-built nominal of the features": "survey the features to the targets better",
    "station drift": "lower limits.fit_age_s or use a stiffer stand",
    "thermal expansion": "know the temperatures better (temperature_sigma_k), or place targets nearer to the features",
}
"""The parts of the budget, and what makes each smaller."""


@dataclass(frozen=True)
class FeatureBudget:
    """One docking feature: sigma of its error (sqrt of the largest eigenvalue), and the sigma of each part alone."""

    name: str
    sigma_mm: float
    tolerance_mm: float
    parts_mm: tuple[tuple[str, float], ...]

    @property
    def provable(self) -> bool:
        """False when even an error of zero could not be accepted; NaN is not provable."""
        return 2.0 * self.sigma_mm <= self.tolerance_mm

    @property
    def largest(self) -> tuple[str, float]:
        """The part with the largest sigma."""
        return max(self.parts_mm, key=lambda part: part[1])


def noise_of(cell: CellFile) -> NoiseModel:
    """The instrument's noise: the cell's own numbers, else those of the device class."""
    own = cell.tracker.noise
    if own is None:
        return NOISE_PRESETS[cell.tracker.device_class]
    return NoiseModel.from_um(own.range_um, own.range_um_per_m, own.transverse_um, own.transverse_um_per_m)


def docked_pose(cell: CellFile, job: JobFile) -> Pose:
    """Nominal X_WC with the component's features on those of the mate."""
    component = feature_points(job.component, cell).xyz_mm
    mate = mate_feature_points(job.component, job.mate, cell).xyz_mm
    return pose_from_vector(job.mate.pose) @ fit_svd(component, mate)


def feature_budget(cell: CellFile, job: JobFile, passes: int) -> tuple[FeatureBudget, ...]:
    """The a-priori uncertainty of each feature at the docked pose, both parts measured in `passes` passes.

    Raises numpy.linalg.LinAlgError when a target set does not define a pose.
    """
    X_WC, X_WM = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    features = feature_points(job.component, cell)
    mates = mate_feature_points(job.component, job.mate, cell)
    at_W = X_WC.apply(features.xyz_mm)
    component = _part(cell, target_points(job.component.targets, job.component, cell), X_WC, passes, at_W)
    mate = _part(cell, target_points(job.mate.targets, job.mate, cell), X_WM, passes, at_W)
    drift_mm = cell.tracker.drift_um_per_h * 1e-3 * cell.limits.fit_age_s / 3600.0
    grown = [
        _thermal(part.arms_mm, side.expansion_per_k * side.temperature_sigma_k)
        for part, side in ((component, job.component), (mate, job.mate))
    ]
    covs = (
        component.noise,
        mate.noise,
        component.nominal,
        mate.nominal,
        features.cov_mm2 + mates.cov_mm2,
        np.broadcast_to(np.eye(3) * drift_mm**2, features.cov_mm2.shape),
        grown[0] + grown[1],
    )
    return _budgets(job, covs)


def _budgets(job: JobFile, covs: tuple[Array, ...]) -> tuple[FeatureBudget, ...]:
    total, each = _largest_sigma(np.sum(covs, axis=0)), [_largest_sigma(cov) for cov in covs]
    return tuple(
        FeatureBudget(
            feature.name,
            float(total[i]),
            feature.tolerance_mm,
            tuple((name, float(sigma[i])) for name, sigma in zip(REMEDIES, each, strict=True)),
        )
        for i, feature in enumerate(job.component.features)
    )


@dataclass(frozen=True, eq=False)
class _FittedPart:
    """Covariances (f, 3, 3) in W that one fitted part gives the features, and their arms (f, 3) from its targets."""

    noise: Array
    nominal: Array
    arms_mm: Array


def _part(cell: CellFile, targets: Points, X_WN: Pose, passes: int, features_W_mm: Array) -> _FittedPart:
    """The weighted fit's gain G = (A^T S^-1 A)^-1 A^T S^-1 applied to noise and to as-built errors apart."""
    at_W, X_TW = X_WN.apply(targets.xyz_mm), pose_from_vector(cell.tracker.station_pose).inverse()
    noise = X_TW.R.T @ noise_of(cell).covariance(X_TW.apply(at_W)) @ X_TW.R / passes
    nominal = X_WN.R @ targets.cov_mm2 @ X_WN.R.T
    centre = weighted_centroid(at_W, noise + nominal)
    scale = np.array([1.0 / spread(at_W).long_mm] * 3 + [1.0] * 3)
    jac = design(at_W, centre)[:, :, :6] * scale
    weighted = jac.transpose(0, 2, 1) @ np.linalg.inv(noise + nominal)
    gain = np.linalg.inv((weighted @ jac).sum(axis=0)) @ weighted
    reach = design(features_W_mm, centre)[:, :, :6] * scale
    noise_cov, nominal_cov = ((gain @ cov @ gain.transpose(0, 2, 1)).sum(axis=0) for cov in (noise, nominal))
    turned = reach.transpose(0, 2, 1)
    return _FittedPart(reach @ noise_cov @ turned, reach @ nominal_cov @ turned, features_W_mm - centre)


def _thermal(arms_mm: Array, sigma_expansion: float) -> Array:
    """Covariance (f, 3, 3) of an unknown uniform expansion about the targets' centre, where the fit holds the part."""
    grown = arms_mm * sigma_expansion
    result: Array = grown[:, :, None] * grown[:, None, :]
    return result


def _largest_sigma(cov_mm2: Array) -> Array:
    result: Array = np.sqrt(np.maximum(np.linalg.eigvalsh(cov_mm2)[:, -1], 0.0))
    return result
