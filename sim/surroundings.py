"""What changes by itself during a run: temperatures, floor, mate, station, device clocks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from docking.types import Array, Pose
from sim.truth import Draws, DriftRate, PoseError, TruthFile

_HOUR_S = 3600.0
_ARM_M = 10.0
"""A drifting pose also turns: so much that a point this far away moves by the drift once more."""


class DriftingPose:
    """A pose that creeps: a steady shift and a steady turn about its own origin, directions random."""

    def __init__(self, start: Pose, draws: Draws, name: str, rate: DriftRate) -> None:
        self._start = start
        speeds = draws.span(name, rate.um_per_h, (2,)) * 1e-3 / _HOUR_S
        self._shift_mm_s: Array = speeds[0] * draws.direction(name)
        self._turn_rad_s: Array = speeds[1] / (_ARM_M * 1e3) * draws.direction(name)

    def at(self, elapsed_s: float) -> Pose:
        turn = Rotation.from_rotvec(self._turn_rad_s * elapsed_s).as_matrix()
        return Pose(turn @ self._start.R, self._start.t_mm + self._shift_mm_s * elapsed_s)


def offset_pose(nominal: Pose, draws: Draws, name: str, size: PoseError) -> Pose:
    """`nominal` with every coordinate off by up to `size.mm`, every angle by up to `size.mrad`, about its origin."""
    shift = draws.uniform(name, (3,)) * size.mm
    turn = Rotation.from_rotvec(draws.uniform(name, (3,)) * size.mrad * 1e-3).as_matrix()
    return Pose(turn @ nominal.R, nominal.t_mm + shift)


class Temperatures:
    """Component and mate: error of the temperature the job states, and its ramp (K)."""

    def __init__(self, truth: TruthFile, draws: Draws) -> None:
        self._offset_k = draws.uniform("temperature", (2,)) * truth.temperature.offset_k
        self._rate_k_s = draws.uniform("temperature", (2,)) * truth.temperature.rate_k_per_h / _HOUR_S

    def heat(self, component_k: float, mate_k: float) -> None:
        """Make them so much warmer at once."""
        self._offset_k = self._offset_k + np.array((component_k, mate_k))

    def excess_k(self, elapsed_s: float) -> tuple[float, float]:
        """True temperature minus the job's: (component, mate)."""
        component, mate = self._offset_k + self._rate_k_s * elapsed_s
        return float(component), float(mate)


class Floor:
    """Pads of the positioners sink after the load was transferred to them at the start of the run."""

    def __init__(self, truth: TruthFile, draws: Draws, load_share: Array) -> None:
        """load_share (k,): load of each ball over the equal share."""
        depth = draws.span("floor_settlement", truth.floor_settlement.um, (len(load_share),)) * 1e-3
        self._depth_mm: Array = depth * load_share
        self._time_s = truth.floor_settlement.time_constant_s

    def sunk_mm(self, elapsed_s: float) -> Array:
        """(k,) along gravity."""
        sunk: Array = self._depth_mm * -np.expm1(-elapsed_s / self._time_s)
        return sunk


class StationMotion:
    """True pose X_WT of the instrument: unknown offset from the cell file, drift, and perhaps one bump."""

    def __init__(self, nominal: Pose, truth: TruthFile, draws: Draws) -> None:
        start = offset_pose(nominal, draws, "station_pose", truth.station_pose)
        self._drifting = DriftingPose(start, draws, "station_drift", truth.station_drift)
        bump = truth.station_bump
        chance = draws.generator("station_bump").uniform()
        self.bump_s: float = float(draws.generator("station_bump").uniform(0.0, bump.window_s))
        size = bump.shift_mm * draws.scale("station_bump") if chance < bump.probability else 0.0
        self._bump_mm: Array = size * draws.direction("station_bump")

    def pose(self, elapsed_s: float) -> Pose:
        """X_WT at `elapsed_s` after the start of the run."""
        pose = self._drifting.at(elapsed_s)
        if elapsed_s < self.bump_s:
            return pose
        return Pose(pose.R, pose.t_mm + self._bump_mm)
