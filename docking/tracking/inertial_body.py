"""From the navigation of the inertial sensor to the body that carries it."""

from __future__ import annotations

import numpy as np

from docking.tracking.axis_filters import Mask
from docking.tracking.body import described, points_from_pose
from docking.tracking.inertial_core import PHI, Layout, Navigation, P
from docking.tracking.strapdown import turn
from docking.tracking.types import BodyModel, TrackedState
from docking.types import Array, Pose


def on_time(nav: Navigation, rate_rad_s: Array) -> Navigation:
    """The navigation where the body is at its time: what the sensor stamps so happened `late_s` before, so place and
    attitude go on for that long at the velocity and the sensor's rate (3,)."""
    if nav.late_s == 0.0:
        return nav
    x, y, z = (nav.late_s * (rate_rad_s - nav.rate_bias)).tolist()
    return nav._replace(p_mm=nav.p_mm + nav.late_s * nav.v_mm_s, C_WI=nav.C_WI @ turn(x, y, z))


def body_state(body: BodyModel, layout: Layout, nav: Navigation, cov: Array, seen: Mask, used_s: float) -> TrackedState:
    """The body's state from the navigation of its sensor and the covariance (n, n) of that."""
    R = nav.C_WI @ body.X_BI.R.T
    X = Pose(R, nav.p_mm - R @ (body.X_BI.t_mm - body.X_BI.R @ nav.lever_mm))
    com = X.apply(body.com_B_mm)
    jac = np.zeros((6, layout.size))
    jac[3:, P] = jac[:3, PHI] = np.eye(3)
    x, y, z = (com - nav.p_mm).tolist()
    jac[3:, PHI] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    if layout.lever is not None:
        jac[3:, layout.lever] = nav.C_WI
    pose = described(X, com, jac @ cov @ jac.T)
    points, point_cov = points_from_pose(body, pose)
    worst = float(np.sqrt(np.trace(point_cov, axis1=1, axis2=2).max()))
    source = "image" if seen.any() else "inertial"
    return TrackedState(
        nav.t_s, X, nav.v_mm_s, pose.cov, com, points, point_cov, seen, pose.attitude_rad, pose.attitude_sd_rad,
        nav.t_s - used_s, source, worst,
    )  # fmt: skip
