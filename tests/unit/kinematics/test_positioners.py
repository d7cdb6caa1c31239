"""Sockets, axes, Jacobian and rank: docs/mechanics.md (3) to (5), (8), (9)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.kinematics import (
    RankSettings,
    axis_displacements,
    axis_jacobian,
    axis_positions,
    conditioning,
    socket_positions,
)
from tests.reference_geometry import AXES, BALLS, crooked_axes, rc1, rc3


def test_a_socket_moves_along_the_real_axis_direction() -> None:
    axes = np.tile(np.eye(3), (4, 1, 1))
    axes[1] = [[0.0, -1.001, 0.0], [1.0, 0.0, 0.0], [0.01, 0.0, 1.0]]
    q = np.zeros(12)
    q[3:6] = 100.0, 10.0, 1.0
    moved = socket_positions(rc1(axes), q) - BALLS
    np.testing.assert_allclose(moved[1], [-10.01, 100.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(moved[[0, 2, 3]], 0.0, atol=0.0)


@given(seed=st.integers(0, 1000))
def test_axis_positions_invert_socket_positions(seed: int) -> None:
    positioners = rc1(crooked_axes(seed))
    q = np.random.default_rng(seed).uniform(-70, 70, (5, 12))
    np.testing.assert_allclose(axis_positions(positioners, socket_positions(positioners, q)), q, atol=1e-9)


def test_jacobian_agrees_with_finite_differences() -> None:
    positioners = rc1(crooked_axes(3))
    balls, centre, h = BALLS + np.array([5.0, -3.0, 2.0]), np.array([4000.0, 10.0, -20.0]), 1e-6
    numeric = np.empty((12, 6))
    for column in range(6):
        twist = h * np.eye(6)[column]
        moved = Rotation.from_rotvec(twist[3:]).apply(balls - centre) + centre + twist[:3]
        numeric[:, column] = axis_displacements(positioners, moved - balls) / h
    np.testing.assert_allclose(axis_jacobian(positioners, balls, centre), numeric, atol=5e-3)


def test_rc3_is_well_conditioned_and_has_one_check_left() -> None:
    six = conditioning(rc3(d_z_driven=False), RankSettings())
    assert six.full_rank
    assert six.redundancy == 0
    assert six.condition == pytest.approx(3.0, abs=0.06)
    seven = conditioning(rc3(), RankSettings())
    assert (seven.redundancy, seven.full_rank) == (1, True)
    assert seven.condition < six.condition
    assert conditioning(rc1(), RankSettings()).redundancy == 6


def test_only_128_of_924_choices_of_six_axes_hold_four_coplanar_balls() -> None:
    held = 0
    for chosen in itertools.combinations(range(12), 6):
        driven = np.zeros(12, dtype=bool)
        driven[list(chosen)] = True
        held += conditioning(rc1(driven=driven), RankSettings(condition_max=1e6, sigma_min=1e-6)).full_rank
    assert held == 128


def test_five_axes_are_never_enough() -> None:
    found = conditioning(rc1(driven=np.isin(AXES, ["A.X", "A.Y", "A.Z", "B.Z", "C.Z"])), RankSettings())
    assert (found.full_rank, found.redundancy, found.condition) == (False, -1, float("inf"))


def test_geometry_is_read_only_and_of_one_size() -> None:
    positioners = rc1()
    with pytest.raises(ValueError, match="read-only"):
        positioners.balls_C_mm[0, 0] = 1.0
    with pytest.raises(ValueError, match="axes_W"):
        rc1(np.eye(3)[None])
    with pytest.raises(ValueError, match="driven"):
        rc1(driven=np.ones(11, dtype=bool))
