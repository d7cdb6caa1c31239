"""[Luo]: from named points in two frames to a pose with its covariance.

`screen(nominal, measured, settings)` decides which points are what they claim to be, `fit_pose(screened, settings)`
fits; the default is maximum-likelihood least squares with the points' covariances, justified in `docking.pose.fit`.
"""

from docking.pose.features import Budget, Features, check_points_agree, feature_errors, goal_pose
from docking.pose.fit import fit_pose
from docking.pose.layout import Spread, check_layout, spread
from docking.pose.noise import LASER_TRACKER, NOISE_PRESETS, TOTAL_STATION, NoiseModel
from docking.pose.passes import Averaged, average_passes
from docking.pose.screening import screen
from docking.pose.settings import METHODS, FitSettings, Method

__all__ = [
    "LASER_TRACKER",
    "METHODS",
    "NOISE_PRESETS",
    "TOTAL_STATION",
    "Averaged",
    "Budget",
    "Features",
    "FitSettings",
    "Method",
    "NoiseModel",
    "Spread",
    "average_passes",
    "check_layout",
    "check_points_agree",
    "feature_errors",
    "fit_pose",
    "goal_pose",
    "screen",
    "spread",
]
