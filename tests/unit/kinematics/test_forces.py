"""Reactions, internal forces, warp: the figures of docs/mechanics.md."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import BallReactionOut
from docking.kinematics import (
    Positioners,
    axis_displacements,
    axis_forces_n,
    ball_jacobian,
    ball_reactions_n,
    consistency_projector,
    internal_force_matrix,
    internal_forces_n,
    reaction_extremes,
    sink_mm,
    warp_rows,
)
from docking.types import Pose
from tests.reference_geometry import BALLS, LOAD, crooked_axes, rc1, rc3

WEIGHT = LOAD.heaviest_n


def uneven(seed: int, rng: np.random.Generator) -> Positioners:
    """The follower cell with crooked axes and every axis of another stiffness."""
    stiffness = rng.uniform(5e3, 5e4, (4, 3))
    return replace(rc1(crooked_axes(seed), driven=rc3().driven), stiffness_n_per_mm=stiffness)


def test_rc1_reactions_are_those_of_the_reference() -> None:
    up = ball_reactions_n(rc1(), BALLS, LOAD.com_C_mm, WEIGHT)[0, :, 2]
    np.testing.assert_allclose(up / 1000.0, [10.1, 16.0, 19.3, 13.4], atol=0.06)
    centred = ball_reactions_n(rc1(), BALLS, np.zeros(3), WEIGHT)[0]
    np.testing.assert_allclose(centred[:, 2] / 1000.0, 14.7, atol=0.02)
    np.testing.assert_allclose(centred[:, :2], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("com", "expected_kn"),
    [
        ((600.0, 200.0, 0.0), (23.5, 2.6, 32.7, 0.0)),
        ((0.0, 0.0, 0.0), (29.4, 0.0, 29.4, 0.0)),
        ((600.0, 400.0, 0.0), (23.5, -0.65, 36.0, 0.0)),
    ],
)
def test_rc3_without_d_z_tips(com: tuple[float, ...], expected_kn: tuple[float, ...]) -> None:
    """A.Z, B.Z and C.Z alone carry 23.5, 2.6, 32.7 kN; B lifts off for a centre of mass 400 mm to the side."""
    up = ball_reactions_n(rc3(d_z_driven=False), BALLS, np.array(com), WEIGHT)[0, :, 2] / 1000.0
    np.testing.assert_allclose(up, expected_kn, atol=0.07)


@given(seed=st.integers(0, 1000))
def test_reactions_are_in_equilibrium_and_spare_passive_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positioners = uneven(seed, rng)
    balls = Rotation.from_rotvec(rng.uniform(-0.1, 0.1, 3)).apply(BALLS) + rng.uniform(-50, 50, 3)
    com, weight = rng.uniform(-500, 500, 3), rng.uniform(-5e4, 5e4, 3)
    forces = ball_reactions_n(positioners, balls, com, weight)[0]
    np.testing.assert_allclose(forces.sum(axis=0) + weight, 0.0, atol=1e-6)
    torque = np.cross(balls, forces).sum(axis=0) + np.cross(com, weight)
    np.testing.assert_allclose(torque, 0.0, atol=1e-2)
    np.testing.assert_allclose(axis_forces_n(positioners, forces)[~positioners.driven], 0.0, atol=1e-6)


def test_one_degree_of_tilt_is_one_kilonewton_of_side_force() -> None:
    tilted = WEIGHT[2] * np.array([np.sin(np.radians(1.0)), 0.0, np.cos(np.radians(1.0))])
    side = ball_reactions_n(rc1(), BALLS, np.zeros(3), tilted)[0, :, 0].sum()
    assert side == pytest.approx(1027.0, abs=2.0)


def test_balls_sink_by_their_load_over_the_stiffness() -> None:
    reactions = ball_reactions_n(rc1(), BALLS, LOAD.com_C_mm, WEIGHT)[0]
    sink = sink_mm(rc1(), reactions)
    np.testing.assert_allclose(sink[:, 2], [-0.507, -0.801, -0.964, -0.670], atol=0.002)
    np.testing.assert_allclose(sink[:, :2], 0.0, atol=1e-9)


def test_single_axis_errors_show_in_part() -> None:
    """0.83 in X, 0.75 in Y, 0.50 in Z of themselves, and only a quarter of a Z error at each ball."""
    N = consistency_projector(BALLS)
    assert [np.linalg.norm(N[:, k]) for k in range(3)] == pytest.approx([0.83, 0.75, 0.50], abs=0.005)
    np.testing.assert_allclose(np.abs(N[2::3, 2]), 0.25, atol=1e-12)
    assert np.linalg.matrix_rank(N) == 6
    np.testing.assert_allclose(N @ ball_jacobian(BALLS, BALLS[0]).reshape(12, 6), 0.0, atol=1e-9)


def test_internal_force_of_a_tenth_of_a_millimetre() -> None:
    """0.5 kN of Z warp, 1.4 kN in X at 20 kN/mm."""
    G = internal_force_matrix(rc1(), BALLS)
    assert (0.1 * G[2::3, 2]).tolist() == pytest.approx([500.0, -500.0, 500.0, -500.0])
    assert 0.1 * G[0, 0] == pytest.approx(1368.0, abs=1.0)


@given(seed=st.integers(0, 1000))
def test_internal_force_equilibrates_itself_and_vanishes_for_rigid_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positioners = uneven(seed, rng)
    G = internal_force_matrix(positioners, BALLS)
    rows = ball_jacobian(BALLS, np.zeros(3)).reshape(12, 6)
    forces = G @ rng.normal(size=12)
    np.testing.assert_allclose(rows[:, :3].T @ forces, 0.0, atol=1e-6)
    np.testing.assert_allclose(rows[:, 3:].T @ forces, 0.0, atol=1e-2)
    rigid = axis_displacements(positioners, (rows @ rng.uniform(-1e-3, 1e-3, 6)).reshape(4, 3))
    np.testing.assert_allclose(G @ rigid, 0.0, atol=1e-5)
    np.testing.assert_allclose(G[:, ~positioners.driven], 0.0, atol=1e-9)


def test_measured_forces_less_the_needed_ones_are_internal() -> None:
    needed = ball_reactions_n(rc1(), BALLS, LOAD.com_C_mm, WEIGHT)[0]
    strained = needed + 300.0 * np.array([1, -1, 1, -1])[:, None] * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(internal_forces_n(strained, needed)[:, 2], [300.0, -300.0, 300.0, -300.0], atol=1e-9)


def test_warp_of_four_vertical_axes_is_invisible_to_rigid_motion() -> None:
    (row,) = warp_rows(BALLS, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(row, [0.25, -0.25, 0.25, -0.25], atol=1e-12)
    vertical = ball_jacobian(BALLS, np.zeros(3))[:, 2, :]
    np.testing.assert_allclose(row @ vertical, 0.0, atol=1e-9)
    assert warp_rows(BALLS[:3], (0.0, 0.0, 1.0)).shape == (0, 3)
    irregular = np.array([[-2900.0, -1800.0, -1170.0], *BALLS[1:], [0.0, 500.0, -900.0]])
    modes = warp_rows(irregular, (0.0, 0.0, 1.0))
    assert modes.shape == (2, 5)
    np.testing.assert_allclose(modes @ ball_jacobian(irregular, np.zeros(3))[:, 2, :], 0.0, atol=1e-9)


def test_extremes_take_every_corner_of_the_centre_of_mass() -> None:
    load = replace(LOAD, com_tolerance_mm=np.array([300.0, 180.0, 0.0]), mass_tolerance_kg=600.0)
    found = reaction_extremes(rc1(), Pose.identity(), load)
    assert found.least_share[0] == pytest.approx(1.0 - 900.0 / 3000.0 - 380.0 / 1800.0, abs=1e-6)
    assert found.peak_axis_n[8] == pytest.approx(1.1 * 14709.975 * (1.0 + 900.0 / 3000.0 + 380.0 / 1800.0), rel=1e-6)


def test_a_component_that_is_not_held_is_refused() -> None:
    driven = np.zeros(12, dtype=bool)
    driven[2::3] = True
    with pytest.raises(BallReactionOut, match="six degrees of freedom"):
        ball_reactions_n(rc1(driven=driven), BALLS, np.zeros(3), WEIGHT)
