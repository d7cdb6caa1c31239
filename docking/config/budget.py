"""What the instrument can prove before anything is measured: sigma of every docking feature and its parts.

The component and the mate are fitted from the same station, so the station's own pose cancels in their difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from docking.config.cell import CellFile
from docking.config.job import Component, JobFile, Mate
from docking.config.nominal import docked_in_mate, feature_points, mate_feature_points, target_points
from docking.geometry import pose_from_vector
from docking.pose.expected import Layout
from docking.pose.features import specific_risk
from docking.pose.layout import spread
from docking.pose.least_squares import design, weighted_centroid
from docking.pose.noise import NOISE_PRESETS, NoiseModel
from docking.pose.uncertainty import largest_sigma_mm, own_cov_mm2
from docking.types import Array, Pose

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
        """False when 2 sigma alone fill the tolerance; NaN is not provable. All features together: `least_risk`."""
        return 2.0 * self.sigma_mm <= self.tolerance_mm

    @property
    def largest(self) -> tuple[str, float]:
        """The part with the largest sigma."""
        return max(self.parts_mm, key=lambda part: part[1])


def noise_of(cell: CellFile) -> NoiseModel:
    """The instrument's noise: the cell's own numbers, else those of the device class."""
    own = cell.tracker.noise
    model = NOISE_PRESETS[cell.tracker.device_class]
    if own is not None:
        model = NoiseModel.from_um(own.range_um, own.range_um_per_m, own.transverse_um, own.transverse_um_per_m)
    return replace(model, seating_mm=cell.tracker.seating_um * 1e-3)


def docked_pose(cell: CellFile, job: JobFile) -> Pose:
    """Nominal X_WC with the component's features on those of the mate."""
    return pose_from_vector(job.mate.pose) @ docked_in_mate(job, cell)


def feature_budget(cell: CellFile, job: JobFile, passes: int) -> tuple[FeatureBudget, ...]:
    """The a-priori uncertainty of each feature at the docked pose, both parts measured in `passes` passes.

    Raises numpy.linalg.LinAlgError when a target set does not define a pose.
    """
    joint = _joint_covs(cell, job, passes)
    total, each = (
        largest_sigma_mm(own_cov_mm2(np.sum(joint, axis=0))),
        [largest_sigma_mm(own_cov_mm2(cov)) for cov in joint],
    )
    return tuple(
        FeatureBudget(
            feature.name,
            float(total[i]),
            feature.tolerance_mm,
            tuple((name, float(sigma[i])) for name, sigma in zip(REMEDIES, each, strict=True)),
        )
        for i, feature in enumerate(job.component.features)
    )


def least_risk(cell: CellFile, job: JobFile, passes: int) -> float:
    """Probability that any feature is out of tolerance when every measured error is zero, the least there can be.

    The acceptance evaluates the same function on what was measured. Raises as `feature_budget`.
    """
    joint: Array = np.sum(_joint_covs(cell, job, passes), axis=0)
    tolerance = np.array([feature.tolerance_mm for feature in job.component.features])
    return specific_risk(np.zeros((len(tolerance), 3)), joint, tolerance)


def _joint_covs(cell: CellFile, job: JobFile, passes: int) -> tuple[Array, ...]:
    """Joint covariance (3f, 3f) of the errors of all features in W by each part, in the order of REMEDIES."""
    X_WC, X_WM = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    features = feature_points(job.component, cell)
    mates = mate_feature_points(job.component, job.mate, cell)
    at_W = X_WC.apply(features.xyz_mm)
    component = _part_covs(PartReadings.of(cell, job.component, X_WC, passes), at_W)
    mate = _part_covs(PartReadings.of(cell, job.mate, X_WM, passes), at_W)
    return (
        component[0],
        mate[0],
        component[1],
        mate[1],
        linalg.block_diag(*(features.cov_mm2 + mates.cov_mm2)),
        drift_cov_mm2(cell, len(at_W)),
        component[2] + mate[2],
    )


def drift_cov_mm2(cell: CellFile, count: int) -> Array:
    """Joint covariance (3f, 3f) of `count` features by the station's drift over the age that a fit may have."""
    drift_mm = cell.tracker.drift_um_per_h * 1e-3 * cell.limits.fit_age_s / 3600.0
    result: Array = drift_mm**2 * np.tile(np.eye(3), (count, count))
    return result


def reading_cov_mm2(cell: CellFile, at_W_mm: Array, passes: int) -> Array:
    """Covariance (n, 3, 3) in W of readings of points (n, 3) from the cell's station, `passes` of them averaged."""
    X_TW = pose_from_vector(cell.tracker.station_pose).inverse()
    result: Array = X_TW.R.T @ noise_of(cell).covariance(X_TW.apply(at_W_mm)) @ X_TW.R / passes
    return result


@dataclass(frozen=True, eq=False)
class PartReadings:
    """What a fit of one part rests on, in W: points (n, 3), covariances (n, 3, 3) of the averaged readings and of the
    nominal nests, and the sigma of the part's relative expansion."""

    names: tuple[str, ...]
    xyz_mm: Array
    noise_mm2: Array
    nominal_mm2: Array
    expansion: float

    @classmethod
    def of(cls, cell: CellFile, part: Component | Mate, X_WN: Pose, passes: int) -> PartReadings:
        targets = target_points(part.targets, part, cell)
        at_W = X_WN.apply(targets.xyz_mm)
        noise = reading_cov_mm2(cell, at_W, passes)
        nominal = X_WN.R @ targets.cov_mm2 @ X_WN.R.T
        return cls(targets.names, at_W, noise, nominal, part.expansion_per_k * part.temperature_sigma_k)

    def layout(self) -> Layout:
        """The same as a layout whose fit can be foreseen."""
        return Layout(self.names, self.xyz_mm, self.noise_mm2 + self.nominal_mm2, self.expansion)


def _part_covs(readings: PartReadings, features_W_mm: Array) -> tuple[Array, Array, Array]:
    """Joint covariances (3f, 3f) that the fit of one part gives the features: by noise, nominal nests, temperature.

    The weighted fit [rotation, translation, expansion] has the gain G = P A^T S^-1, P = (A^T S^-1 A + L)^-1, with the
    prior L of the expansion alone; S = noise + nominal. Then P = G noise G^T + G nominal G^T + P L P.
    """
    both = readings.noise_mm2 + readings.nominal_mm2
    centre = weighted_centroid(readings.xyz_mm, both)
    free = 7 if readings.expansion > 0.0 else 6
    scale = (1.0 / spread(readings.xyz_mm).long_mm) ** np.array([1, 1, 1, 0, 0, 0, 1])[:free]
    jac = design(readings.xyz_mm, centre)[:, :, :free] * scale
    weighted = jac.transpose(0, 2, 1) @ np.linalg.inv(both)
    prior = np.zeros((free, free))
    if free == 7:
        prior[6, 6] = (scale[6] / readings.expansion) ** 2
    inverse = np.linalg.inv((weighted @ jac).sum(axis=0) + prior)
    gain = inverse @ weighted
    back = gain.transpose(0, 2, 1)
    reach = (design(features_W_mm, centre)[:, :, :free] * scale).reshape(-1, free)
    parts = ((gain @ readings.noise_mm2 @ back).sum(axis=0), (gain @ readings.nominal_mm2 @ back).sum(axis=0))
    noise, nominal, thermal = (reach @ cov @ reach.T for cov in (*parts, inverse @ prior @ inverse))
    return noise, nominal, thermal
