"""Component and mate as they were really built: true nests, features, balls; expansion and sag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from docking.config import CellFile, JobFile
from docking.config.base import PoseVector
from docking.config.job import Target
from docking.types import Array, Pose
from sim.truth import Draws, TruthFile


def pose_of(vector: PoseVector) -> Pose:
    """Pose of [x, y, z mm, alpha, beta, gamma deg]; R = Rz(gamma) Ry(beta) Rx(alpha)."""
    turn = Rotation.from_euler("xyz", vector[3:], degrees=True)
    return Pose(turn.as_matrix(), np.array(vector[:3]))


def reflectors_mm(targets: Sequence[Target]) -> Array:
    """(n, 3) nominal reflector centres: nest plus offset along its normal."""
    nests = np.array([t.xyz_mm for t in targets]).reshape(-1, 3)
    normals = np.array([t.normal for t in targets]).reshape(-1, 3)
    offsets = np.array([t.reflector_offset_mm for t in targets])
    centres: Array = nests + offsets[:, None] * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return centres


def docked_pose(job: JobFile, mate: Pose) -> Pose:
    """X_WC that brings the nominal component features onto the nominal mate features (Kabsch, by SciPy)."""
    features = job.component.features
    component = np.array([f.xyz_mm for f in features])
    on_mate = mate.apply(np.array([f.mate_xyz_mm for f in features]))
    centre_c, centre_w = component.mean(axis=0), on_mate.mean(axis=0)
    turn, _ = Rotation.align_vectors(on_mate - centre_w, component - centre_c)
    matrix = turn.as_matrix()
    return Pose(matrix, centre_w - matrix @ centre_c)


class ComponentShape:
    """True points of the component in C: targets and check points, features, balls, centre of mass."""

    def __init__(self, cell: CellFile, job: JobFile, truth: TruthFile, draws: Draws) -> None:
        part = job.component
        nests = (*part.targets, *part.check_points)
        self.target_names = tuple(t.name for t in nests)
        self._expansion, self._stated_k = part.expansion_per_k, part.temperature_c - cell.temperature_c
        sigma = truth.nominal_nests.sigma_mm
        self._targets = reflectors_mm(nests) + sigma * draws.normal("nominal_nests", (len(nests), 3))
        features = np.array([f.xyz_mm for f in part.features])
        self._features = features + truth.feature_transfer.sigma_mm * draws.normal("feature_transfer", features.shape)
        ball_of = {b.positioner: b.xyz_mm for b in part.balls}
        balls = np.array([ball_of[p.name] for p in cell.positioners])
        self._balls: Array = balls + truth.calibration.ball_mm * draws.normal("calibration", balls.shape)
        off = draws.uniform("mass_properties", (4,))
        self.mass_kg = part.mass_kg + float(off[0]) * part.mass_tolerance_kg
        self.com_mm: Array = np.array(part.com_mm) + off[1:] * np.array(part.com_tolerance_mm)
        self._prepare_sag(truth, draws)

    def _prepare_sag(self, truth: TruthFile, draws: Draws) -> None:
        everything = np.vstack((self._targets, self._features, self._balls))
        self._middle = everything.mean(axis=0)
        spread = np.linalg.svd(everything - self._middle)
        self._long_axis: Array = spread.Vh[0]
        self._half_length = float(np.abs((everything - self._middle) @ self._long_axis).max())
        self._sag_mm = truth.sag.sigma_um * 1e-3 * float(draws.normal("sag", (1,))[0])
        self._sag_per_change_mm = truth.sag.um_per_support_change * 1e-3 * draws.scale("sag")
        self._fore: Array = ((self._balls - self._middle) @ self._long_axis > 0.0).astype(float)

    def growth(self, excess_k: float) -> float:
        """Scale of all lengths at the true temperature."""
        return 1.0 + self._expansion * (self._stated_k + excess_k)

    def fore_share(self, loads_n: Array) -> float:
        """Part of the weight that the balls on the positive half of the long axis carry; loads (k,) upwards."""
        return float(self._fore @ loads_n) / float(loads_n.sum())

    def balls_mm(self, excess_k: float) -> Array:
        balls: Array = self._balls * self.growth(excess_k)
        return balls

    def targets_mm(self, excess_k: float, down_C: Array, support_change: float) -> Array:
        return self._bent(self._targets, excess_k, down_C, support_change)

    def features_mm(self, excess_k: float, down_C: Array, support_change: float) -> Array:
        return self._bent(self._features, excess_k, down_C, support_change)

    def _bent(self, points: Array, excess_k: float, down_C: Array, support_change: float) -> Array:
        """Points at temperature, bent to a parabola along the long axis in the direction of gravity (in C)."""
        along = (points - self._middle) @ self._long_axis / self._half_length
        depth = (self._sag_mm + self._sag_per_change_mm * support_change) * (along**2 - 1.0 / 3.0)
        bent: Array = points * self.growth(excess_k) + depth[:, None] * down_C
        return bent


class MateShape:
    """True points of the mate in M."""

    def __init__(self, cell: CellFile, job: JobFile, truth: TruthFile, draws: Draws) -> None:
        mate = job.mate
        self.target_names = tuple(t.name for t in mate.targets)
        self._expansion, self._stated_k = mate.expansion_per_k, mate.temperature_c - cell.temperature_c
        nests = reflectors_mm(mate.targets)
        self._targets = nests + truth.nominal_nests.sigma_mm * draws.normal("nominal_nests", nests.shape)
        features = np.array([f.mate_xyz_mm for f in job.component.features])
        self._features = features + truth.feature_transfer.sigma_mm * draws.normal("feature_transfer", features.shape)

    def targets_mm(self, excess_k: float) -> Array:
        targets: Array = self._targets * (1.0 + self._expansion * (self._stated_k + excess_k))
        return targets

    def features_mm(self, excess_k: float) -> Array:
        features: Array = self._features * (1.0 + self._expansion * (self._stated_k + excess_k))
        return features
