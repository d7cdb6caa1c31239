"""Whether a stated covariance is honest."""

import numpy as np

from docking.pose.uncertainty import pose_difference
from docking.types import Fit, Pose


def nees(fit: Fit, X_true: Pose) -> float:
    """Normalised squared error of a fit against the truth: mean 6 when its covariance is honest."""
    d = pose_difference(fit.X_MN, X_true, fit.pivot_mm)
    return float(d @ np.linalg.solve(fit.cov, d))
