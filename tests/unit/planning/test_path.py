"""The SE(3) path: docs/mechanics.md (30) to (32), (38), (39)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.kinematics import Positioners, axis_positions, socket_positions
from docking.planning.path import RigidPath, rigid_path
from docking.planning.preflight import chord_error_mm, segments_needed
from docking.types import Correction
from tests.reference_geometry import BALLS, FACE, crooked_axes, rc1


def random_correction(seed: int, degrees: float = 2.0, shift_mm: float = 40.0) -> Correction:
    rng = np.random.default_rng(seed)
    return Correction(FACE, np.radians(rng.uniform(-degrees, degrees, 3)), rng.uniform(-shift_mm, shift_mm, 3))


def random_path(seed: int) -> tuple[Positioners, RigidPath, Correction]:
    positioners, correction = rc1(crooked_axes(seed)), random_correction(seed)
    q = np.random.default_rng(seed + 1).uniform(-20, 20, 12)
    return positioners, rigid_path(positioners, q, correction), correction


@settings(deadline=None)
@given(seed=st.integers(0, 1000), s=st.floats(0, 1))
def test_sockets_follow_the_rigid_motion(seed: int, s: float) -> None:
    positioners, path, c = random_path(seed)
    start = socket_positions(positioners, path.start_mm)
    turned = Rotation.from_rotvec(s * c.rotvec_rad).apply(start - c.pivot_W_mm) + c.pivot_W_mm + s * c.shift_mm
    np.testing.assert_allclose(socket_positions(positioners, path.axes_mm(np.array([s]))[0]), turned, atol=1e-8)


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_figure_stays_rigid_to_a_millionth_everywhere(seed: int) -> None:
    positioners, path, _ = random_path(seed)
    figure = socket_positions(positioners, path.axes_mm(np.linspace(0, 1, 101)))
    gaps = np.linalg.norm(figure[:, :, None] - figure[:, None], axis=-1)
    assert np.abs(gaps - gaps[0]).max() <= 1e-9


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_derivatives_agree_with_finite_differences(seed: int) -> None:
    positioners, path, _ = random_path(seed)
    s, h = np.linspace(0.1, 0.9, 9), 1e-4
    for order in (1, 2, 3):
        before = path.axes_mm if order == 1 else lambda x, n=order - 1: path.axis_derivative(x, n)
        numeric = (before(s + h) - before(s - h)) / (2 * h)
        np.testing.assert_allclose(path.axis_derivative(s, order), numeric, atol=2e-6)
    moved = socket_positions(positioners, path.axes_mm(s + h)) - socket_positions(positioners, path.axes_mm(s - h))
    speeds = np.linalg.norm(moved, axis=2) / (2 * h)
    np.testing.assert_allclose(path.point_speed_mm(s)[:, :4], speeds, atol=1e-6)
    assert np.all(path.axis_bounds(1) >= np.abs(path.axis_derivative(s, 1)).max(axis=0))
    assert path.travel_mm >= path.point_speed_mm(s).max() - 1e-9


def test_the_pivot_goes_straight_and_a_pure_shift_moves_all_axes_alike() -> None:
    correction = Correction(FACE, np.zeros(3), np.array([-200.0, 1.0, 2.0]))
    path = rigid_path(rc1(), np.zeros(12), correction)
    np.testing.assert_allclose(path.axes_mm(np.array([0.5]))[0], np.tile([-100.0, 0.5, 1.0], 4), atol=1e-12)
    assert path.point_speed_mm(np.array([0.3]))[0] == pytest.approx([np.linalg.norm(correction.shift_mm)] * 5)
    assert path.spread_mm == 0.0


def test_small_angles_are_not_enough() -> None:
    """0.5 deg at 3 m is off by 0.11 mm when the rotation is taken as small."""
    path = rigid_path(rc1(), np.zeros(12), Correction(BALLS[1] - [3000.0, 0, 0], np.radians([0, 0, 0.5]), np.zeros(3)))
    exact = path.axes_mm(np.array([1.0]))[0][3]
    assert exact == pytest.approx(-3000.0 * np.radians(0.5) ** 2 / 2, rel=1e-4)
    assert exact == pytest.approx(-0.114, abs=0.001)


@pytest.mark.parametrize(
    ("degrees", "expected_mm", "digit"),
    [(0.1, 0.003, 0.001), (0.2, 0.011, 0.001), (0.5, 0.067, 0.001), (1.0, 0.27, 0.01), (3.0, 2.4, 0.1)],
)
def test_chord_error_of_rc1_yaw(degrees: float, expected_mm: float, digit: float) -> None:
    """Point-to-point drives that interpolate each axis linearly squeeze the figure by L theta^2 / 8 at mid-move."""
    positioners = rc1()
    path = rigid_path(positioners, np.zeros(12), Correction(np.zeros(3), np.radians([0, 0, degrees]), np.zeros(3)))
    stated = chord_error_mm(path, np.array([0.0, 1.0]))
    assert stated == pytest.approx(expected_mm, abs=digit / 2)
    ends = path.axes_mm(np.array([0.0, 1.0]))
    middle = socket_positions(positioners, ends.mean(axis=0))
    true = np.linalg.norm(BALLS[0] - BALLS[2]) - np.linalg.norm(middle[0] - middle[2])
    assert path.spread_mm == pytest.approx(np.hypot(6000.0, 3600.0))
    assert stated == pytest.approx(true, rel=4e-4)


def test_segments_needed_keep_the_chord_error_inside_its_limit() -> None:
    path = rigid_path(rc1(), np.zeros(12), Correction(np.zeros(3), np.radians([0, 0, 3.0]), np.zeros(3)))
    n = segments_needed(path, 0.02)
    assert chord_error_mm(path, np.linspace(0, 1, n + 1)) <= 0.02
    assert chord_error_mm(path, np.linspace(0, 1, n)) > 0.02
    assert 3.0 / n == pytest.approx(0.27, abs=0.005)


def test_axes_follow_a_rotated_base() -> None:
    axes = np.tile(Rotation.from_euler("z", 90, degrees=True).as_matrix(), (4, 1, 1))
    path = rigid_path(rc1(axes), np.zeros(12), Correction(FACE, np.zeros(3), np.array([10.0, 0.0, 0.0])))
    np.testing.assert_allclose(path.axes_mm(np.array([1.0]))[0], np.tile([0.0, -10.0, 0.0], 4), atol=1e-12)
    moved = axis_positions(rc1(axes), BALLS + np.array([10.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved, path.axes_mm(np.array([1.0]))[0], atol=1e-9)
