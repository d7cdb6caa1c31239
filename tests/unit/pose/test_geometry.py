"""Rotations and poses against SciPy and against their own definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.geometry import (
    euler_to_matrix,
    exp_so3,
    log_so3,
    matrix_to_euler,
    pose_from_vector,
    pose_to_vector,
    rms,
    rotation_angle,
    skew,
)
from docking.types import Pose

angle = st.floats(-3.1, 3.1)
vector = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@given(angle, st.floats(-1.57, 1.57), angle)
def test_the_euler_order_is_scipys_lower_case_xyz(alpha: float, beta: float, gamma: float) -> None:
    R = euler_to_matrix(alpha, beta, gamma)
    assert np.allclose(R, Rotation.from_euler("xyz", [alpha, beta, gamma]).as_matrix(), atol=1e-14)
    back = matrix_to_euler(R)
    assert back[:3] == pytest.approx((alpha, beta, gamma), abs=1e-9)
    assert not back.gimbal_lock


def test_each_angle_turns_its_own_axis() -> None:
    assert np.allclose(euler_to_matrix(np.pi / 2, 0, 0) @ [0, 1, 0], [0, 0, 1])
    assert np.allclose(euler_to_matrix(0, np.pi / 2, 0) @ [0, 0, 1], [1, 0, 0])
    assert np.allclose(euler_to_matrix(0, 0, np.pi / 2) @ [1, 0, 0], [0, 1, 0])


@pytest.mark.parametrize("beta", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_is_said_and_the_matrix_comes_back(beta: float) -> None:
    R = euler_to_matrix(0.4, beta, -0.7)
    e = matrix_to_euler(R)
    assert e.gimbal_lock
    assert e.alpha_rad == 0.0
    assert np.allclose(euler_to_matrix(*e[:3]), R, atol=1e-12)


@given(vector, st.one_of(st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-4, np.pi - 1e-9])))
def test_exp_and_log_invert_each_other_near_zero_and_pi(direction: np.ndarray, size: float) -> None:
    norm = float(np.linalg.norm(direction))
    if norm < 1e-3:
        return
    w = direction / norm * size
    R = exp_so3(w)
    assert np.allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=4e-15)
    assert np.allclose(exp_so3(log_so3(R)), R, atol=4e-15)
    if size < 3.14:
        assert np.allclose(log_so3(R), w, rtol=1e-9, atol=1e-15)


def test_half_turns_about_every_axis() -> None:
    for axis in (np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.array([1.0, -2.0, 3.0]) / np.sqrt(14.0)):
        w = log_so3(2.0 * np.outer(axis, axis) - np.eye(3))
        assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-12)
        assert np.allclose(np.abs(w / np.pi), np.abs(axis), atol=1e-12)


@given(vector, vector)
def test_a_pose_and_its_inverse_cancel(w: np.ndarray, v: np.ndarray) -> None:
    X = Pose(exp_so3(3.0 * w / max(1.0, float(np.linalg.norm(w)))), 1000.0 * v)
    assert np.allclose((X @ X.inverse()).matrix(), np.eye(4), atol=1e-11)
    assert np.allclose(skew(w) @ v, np.cross(w, v))


@settings(max_examples=50)
@given(angle, st.floats(-1.5, 1.5), angle)
def test_border_vector_is_in_mm_and_degrees(alpha: float, beta: float, gamma: float) -> None:
    v = np.array([10.0, -20.0, 30.0, *np.degrees([alpha, beta, gamma])])
    X = pose_from_vector(v)
    assert np.allclose(X.t_mm, v[:3])
    assert np.allclose(X.R, euler_to_matrix(alpha, beta, gamma), atol=1e-13)
    assert np.allclose(pose_to_vector(X), v, atol=1e-7)


def test_the_angle_of_a_rotation_is_never_negative() -> None:
    assert rotation_angle(exp_so3([0.0, -0.3, 0.0])) == pytest.approx(0.3, abs=1e-15)


def test_rms_is_of_vectors_not_of_coordinates() -> None:
    assert rms([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]) == pytest.approx(np.sqrt(12.5))
