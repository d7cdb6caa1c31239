"""From followed points to bodies: pose, centre of mass, attitude with covariance; joints between two bodies.

[Zhao]: five or more followed points give the body's centre of mass and attitude. The pose is the batch fit of [Luo]
Eq. 9; its covariance follows from the covariances of the points, which differ between seen and occluded ones.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.geometry import log_so3, matrix_to_euler, skew
from docking.pose.batch import fit_poses
from docking.pose.uncertainty import unweighted_cov
from docking.tracking.types import BodyModel, TrackedState
from docking.types import Array, Pose


class BodyPose(NamedTuple):
    """Pose X_WB with `cov` (6, 6) of [rotation_rad, translation_mm] in W about `com_W_mm` (3,); attitude angles of
    [Luo] (3,) rad and their sd (3,)."""

    X_WB: Pose
    com_W_mm: Array
    cov: Array
    attitude_rad: Array
    attitude_sd_rad: Array


def body_pose(body: BodyModel, points_W_mm: Array, cov_mm2: Array, rows: NDArray[np.intp] | None = None) -> BodyPose:
    """The pose from followed points (n, 3) with covariances (n, 3, 3), or from the `rows` given.

    Points weigh by the inverse of their variance: one that has been occluded for long counts less. Raises
    TooFewPoints, DegenerateTargets.
    """
    keep = np.arange(len(points_W_mm)) if rows is None else rows
    nominal, seen, cov = body.points_B_mm[keep], points_W_mm[keep], cov_mm2[keep]
    weights = 3.0 / np.trace(cov, axis1=1, axis2=2)
    fitted = fit_poses(nominal, seen[None], weights)
    X = Pose(fitted.R[0], fitted.t_mm[0])
    com = X.apply(body.com_B_mm)
    cov6 = unweighted_cov(X.apply(nominal), cov, com, weights)
    return described(X, com, cov6)


def described(X_WB: Pose, com_W_mm: Array, cov: Array) -> BodyPose:
    """A pose with its covariance about the centre of mass, and what that means for the attitude angles."""
    euler = matrix_to_euler(X_WB.R)
    angles = np.array(euler[:3])
    if euler.gimbal_lock:
        return BodyPose(X_WB, com_W_mm, cov, angles, np.full(3, np.nan))
    jac = _angles_of_turn(angles)
    sd = np.sqrt(np.maximum(np.diag(jac @ cov[:3, :3] @ jac.T), 0.0))
    return BodyPose(X_WB, com_W_mm, cov, angles, sd)


def _angles_of_turn(angles_rad: Array) -> Array:
    """d(alpha, beta, gamma) / d(rotation vector in W), (3, 3): the inverse of the axes about which the angles turn."""
    _, b, g = angles_rad.tolist()
    cb, sb, cg, sg = cos(b), sin(b), cos(g), sin(g)
    return np.array([[cg / cb, sg / cb, 0.0], [-sg, cg, 0.0], [cg * sb / cb, sg * sb / cb, 1.0]])


def points_from_pose(body: BodyModel, pose: BodyPose) -> tuple[Array, Array]:
    """All points (n, 3) of the body in W and their covariances (n, 3, 3)."""
    points = pose.X_WB.apply(body.points_B_mm)
    jac = np.concatenate([-skew(points - pose.com_W_mm), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
    return points, jac @ pose.cov @ jac.transpose(0, 2, 1)


class Joint(NamedTuple):
    """A hinge between two bodies: `axis_B` unit vector (3,) in the first body's frame; the joint's angle is 0 where
    `X_zero` is the pose of the second body in the first."""

    axis_B: Array
    X_zero: Pose


class Joined(NamedTuple):
    """The second body in the frame of the first: `X_AB` with `cov` (6, 6) of [rotation_rad, translation_mm] in A about
    B's centre of mass; `angle_rad` about the hinge with `angle_sd_rad`, and `off_axis_rad`, the turn that the hinge
    does not permit, with its sd an axis."""

    X_AB: Pose
    cov: Array
    angle_rad: float
    angle_sd_rad: float
    off_axis_rad: float
    off_axis_sd_rad: float


def joined(first: TrackedState | BodyPose, second: TrackedState | BodyPose, joint: Joint) -> Joined:
    """Relative pose and joint angle of two bodies followed independently of each other."""
    A = first.X_WB
    X_AB = A.inverse() @ second.X_WB
    arm = second.com_W_mm - first.com_W_mm
    shift = np.eye(6)  # what a turn of the first body does at the second one's centre
    shift[3:, :3] = -skew(arm)
    total = second.cov + shift @ first.cov @ shift.T
    back = np.kron(np.eye(2), A.R.T)
    cov = back @ total @ back.T
    turned = log_so3(X_AB.R @ joint.X_zero.R.T)
    a = joint.axis_B / np.linalg.norm(joint.axis_B)
    angle = float(a @ turned)
    across = np.eye(3) - np.outer(a, a)
    sd_across = sqrt(float(np.trace(across @ cov[:3, :3] @ across)) / 2.0)
    return Joined(X_AB, cov, angle, sqrt(float(a @ cov[:3, :3] @ a)), float(np.linalg.norm(across @ turned)), sd_across)
