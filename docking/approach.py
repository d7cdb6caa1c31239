"""Where the component should be at each station, and how far its docking features are from there.

The features' goal is the mate's features; a station's goal stands its stand-off back along the docking axis. Errors are
always component minus goal in W, judged with the uncertainty of both sides (docs/decisions/0007: every e + 2 sigma
inside its tolerance, ISO 14253-1).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from docking.planning import Attempt, ConvergenceSettings, Scene, Verdict, attempt, correction_to, decide
from docking.pose import Budget, Features, feature_errors, goal_pose
from docking.pose.features import docked_goal
from docking.pose.goal import Goal, GoalRule
from docking.types import Array, Correction, FeatureErrors, Fit, Pose


@dataclass(frozen=True)
class Station:
    """One stage of the approach."""

    name: str
    standoff_mm: float
    speed_mm_s: float
    permissives: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Approach:
    """The geometry of one docking: feature pairs, docking axis in M (3,), docking face in C (3,), the stations.

    `component_expansion`, `mate_expansion`: 1 sigma of the expansion (1/K times K) that temperature leaves open;
    `goal`: how the docked pose follows from the features.
    """

    features: Features
    component_expansion: float
    mate_expansion: float
    axis_M: Array
    face_C_mm: Array
    stations: tuple[Station, ...]
    convergence: ConvergenceSettings
    goal: GoalRule = field(default_factory=GoalRule)

    def errors(self, X_WC: Fit, X_WM: Fit, station: Station, drift_sigma_mm: float) -> FeatureErrors:
        """Component features minus their places at `station` (f, 3) in W, with the whole uncertainty."""
        budget = Budget(drift_sigma_mm, self.component_expansion, self.mate_expansion)
        return feature_errors(X_WC, X_WM, self.features, budget, -station.standoff_mm * self._axis_W(X_WM))

    def correction(self, X_WC: Fit, X_WM: Fit, station: Station) -> Correction:
        """The move from the measured pose to the goal at `station`, about the docking face: the features on the mate's,
        then back along the docking axis by the stand-off."""
        goal = goal_pose(X_WC, X_WM, self.features, -station.standoff_mm * self._axis_W(X_WM), self.goal)
        return correction_to(X_WC.X_MN, goal, self.face_C_mm)

    def scene(self, X_WC: Fit, X_WM: Fit, station: Station) -> Scene:
        """Where the parts are as a move to `station` is planned, at the docking face as far as they have expanded."""
        i = self.stations.index(station)
        before = self.stations[i - 1].standoff_mm if i > 0 else float("inf")
        docked = goal_pose(X_WC, X_WM, self.features, rule=self.goal)
        face_M = X_WM.X_MN.inverse().apply(docked.apply(X_WC.grown(self.face_C_mm)))
        shift_C, shift_M = X_WC.grown(self.face_C_mm) - self.face_C_mm, X_WM.grown(face_M) - face_M
        here, mate = _shifted(X_WC.X_MN, shift_C), _shifted(X_WM.X_MN, shift_M)
        return Scene(here, mate, _shifted(docked, shift_C), station.standoff_mm, before)

    def docked_goal(self, X_WC: Fit, X_WM: Fit) -> Goal:
        """The docked goal and what it leaves at the features."""
        return docked_goal(X_WC, X_WM, self.features, self.goal)

    def look(self, errors: FeatureErrors, station: Station, corrections: int, passes: int) -> Attempt:
        """What the features say at `station`. In contact the acceptance rule judges; before, it is enough that the
        worst feature is near its place: within 2 % of the gap, 0.5 mm at most, never asking for less than the
        dead-band or than what the measurement can tell."""
        seen = attempt(errors, corrections, passes)
        if station is self.stations[-1]:
            return seen
        dead_band = min(self.convergence.dead_band_mm, self.convergence.dead_band_fraction * seen.tolerance_mm)
        near_mm = max(dead_band, seen.sigma_mm, min(0.5, 0.02 * station.standoff_mm))
        return replace(seen, tolerance_mm=near_mm, accepted=bool(seen.error_mm <= near_mm))

    def verdict(self, history: list[Attempt], station: Station) -> Verdict:
        """What to do after the last look: go on, move, measure more, or give up."""
        return decide(history, self.convergence, station.name)

    def _axis_W(self, X_WM: Fit) -> Array:
        axis: Array = X_WM.X_MN.R @ (self.axis_M / np.linalg.norm(self.axis_M))
        return axis


def _shifted(X: Pose, shift_mm: Array) -> Pose:
    """The pose of a body that stands `shift_mm` (3,), told in its own frame, farther."""
    return Pose(X.R, X.t_mm + X.R @ shift_mm)
