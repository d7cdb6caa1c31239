"""Nominal points of a job as nouns: reflector centres, scaled to the stated temperature, with their covariances."""

from __future__ import annotations

import numpy as np

from docking.config.cell import CellFile, ErsPoint
from docking.config.job import Component, JobFile, Mate, Target
from docking.geometry import pose_from_vector
from docking.pose.goal import GoalRule, best_fit
from docking.types import Array, Points, Pose


def _scale(expansion_per_k: float, temperature_c: float, reference_c: float) -> float:
    return 1.0 + expansion_per_k * (temperature_c - reference_c)


def _isotropic(sigmas_mm: list[float]) -> Array:
    return np.array([np.eye(3) * s * s for s in sigmas_mm]).reshape(-1, 3, 3)


def target_points(targets: tuple[Target, ...], part: Component | Mate, cell: CellFile) -> Points:
    """Reflector centres (n, 3) in the part's frame at the part's temperature."""
    scale = _scale(part.expansion_per_k, part.temperature_c, cell.temperature_c)
    nests = np.array([t.xyz_mm for t in targets]).reshape(-1, 3) * scale
    offsets = np.array([np.multiply(t.normal, t.reflector_offset_mm) for t in targets]).reshape(-1, 3)
    return Points(tuple(t.name for t in targets), nests + offsets, _isotropic([t.sigma_mm for t in targets]))


def feature_points(component: Component, cell: CellFile) -> Points:
    """Docking features of the component (n, 3) in C at its temperature, with the transfer covariance."""
    scale = _scale(component.expansion_per_k, component.temperature_c, cell.temperature_c)
    xyz = np.array([f.xyz_mm for f in component.features]) * scale
    return Points(tuple(f.name for f in component.features), xyz, _isotropic([f.sigma_mm for f in component.features]))


def mate_feature_points(component: Component, mate: Mate, cell: CellFile) -> Points:
    """The mate's side of the docking features (n, 3) in M at the mate's temperature."""
    scale = _scale(mate.expansion_per_k, mate.temperature_c, cell.temperature_c)
    xyz = np.array([f.mate_xyz_mm for f in component.features]) * scale
    names = tuple(f.name for f in component.features)
    return Points(names, xyz, _isotropic([f.mate_sigma_mm for f in component.features]))


def ers_points(ers: tuple[ErsPoint, ...]) -> Points:
    """Reference points (n, 3) in W."""
    return Points(tuple(p.name for p in ers), np.array([p.xyz_mm for p in ers]), _isotropic([p.sigma_mm for p in ers]))


def goal_rule(job: JobFile) -> GoalRule:
    """How the docked pose follows from the features."""
    docked = None if job.docked_pose is None else pose_from_vector(job.docked_pose)
    return GoalRule(job.goal, job.goal_locks, docked, job.component.docking_face_mm)


def docked_in_mate(job: JobFile, cell: CellFile) -> Pose:
    """X_MC of the docked component by the features' nominal coordinates and the job's rule. Raises NotCongruent."""
    component = feature_points(job.component, cell).xyz_mm
    mate = mate_feature_points(job.component, job.mate, cell).xyz_mm
    tolerance = np.array([feature.tolerance_mm for feature in job.component.features])
    return best_fit(component, mate, tolerance, goal_rule(job))


def measured_features(job: JobFile, cell: CellFile) -> tuple[Points, Points]:
    """The docking features that are measured at the first station: on the component (C) and on the mate (M).

    The tracker knows them as NAME.C and NAME.M.
    """
    rows = [i for i, f in enumerate(job.component.features) if f.measured]
    sides = (
        (feature_points(job.component, cell), ".C"),
        (mate_feature_points(job.component, job.mate, cell), ".M"),
    )
    part, mate = (Points(tuple(p.names[i] + side for i in rows), p.xyz_mm[rows], p.cov_mm2[rows]) for p, side in sides)
    return part, mate
