"""Points to bodies: pose, centre of mass, angles and joints with their covariances, against many draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import TooFewPoints
from docking.geometry import matrix_to_euler
from docking.tracking.body import BodyPose, Joint, body_pose, joined
from docking.types import Array, Pose
from tests.unit.tracking.moving_body import section

BODY = section()
DRAWS = 300


def _draw(rng: np.random.Generator, X: Pose, cov: Array) -> BodyPose:
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=(8, 3)))
    return body_pose(BODY, X.apply(BODY.points_B_mm) + noise, cov)


def _pose(angles: list[float], t: list[float]) -> Pose:
    return Pose(Rotation.from_euler("xyz", angles).as_matrix(), np.array(t))


def test_pose_and_angles_scatter_as_their_covariance_says() -> None:
    """Two of eight points have been hidden for long: forty times the variance."""
    rng = np.random.default_rng(2)
    X = _pose([0.3, -0.4, 1.9], [1000.0, -500.0, 300.0])
    cov = np.tile(np.diag([1.0, 1.0, 2.0]), (8, 1, 1))
    cov[[1, 6]] *= 40.0
    com, angles, size = X.apply(BODY.com_B_mm), np.array(matrix_to_euler(X.R)[:3]), []
    for _ in range(DRAWS):
        got = _draw(rng, X, cov)
        turn = Rotation.from_matrix(got.X_WB.R @ X.R.T).as_rotvec()
        error = np.concatenate([turn, got.com_W_mm - com])
        size.append(
            [error @ np.linalg.solve(got.cov, error), *((got.attitude_rad - angles) / got.attitude_sd_rad) ** 2]
        )
    means = np.mean(size, axis=0)
    assert means[0] == pytest.approx(6.0, abs=0.8)
    assert means[1:] == pytest.approx(np.ones(3), abs=0.33)


def test_two_points_give_no_pose() -> None:
    with pytest.raises(TooFewPoints):
        body_pose(BODY, BODY.points_B_mm, np.tile(np.eye(3), (8, 1, 1)), rows=np.array([0, 1]))


def test_joint_angle_and_its_sd() -> None:
    rng = np.random.default_rng(6)
    axis, at = np.array([0.0, 1.0, 0.0]), Pose(np.eye(3), np.array([1500.0, 0.0, 100.0]))
    joint = Joint(2.0 * axis, at)
    A = _pose([0.2, 0.1, -1.0], [0.0, 3000.0, 0.0])
    turn = Pose(Rotation.from_rotvec(0.35 * axis).as_matrix(), np.zeros(3))
    X_AB = Pose(turn.R @ at.R, at.t_mm)
    B = A @ X_AB
    cov = np.tile(np.eye(3), (8, 1, 1))
    seen = [joined(_draw(rng, A, cov), _draw(rng, B, cov), joint) for _ in range(DRAWS)]
    off = np.array([(j.angle_rad - 0.35) / j.angle_sd_rad for j in seen])
    assert np.mean(off**2) == pytest.approx(1.0, abs=0.33)
    assert abs(np.mean(off)) < 0.25
    across = np.array([j.off_axis_rad / j.off_axis_sd_rad for j in seen])
    assert np.mean(across**2) == pytest.approx(2.0, abs=0.6)
    true_t = X_AB.apply(BODY.com_B_mm)
    places = np.array([j.X_AB.apply(BODY.com_B_mm) - true_t for j in seen])
    ratio = np.mean([p @ np.linalg.solve(j.cov[3:, 3:], p) for p, j in zip(places, seen, strict=True)])
    assert ratio == pytest.approx(3.0, abs=0.7)
