"""The coupling check of one cycle."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docking.kinematics import (
    Positioners,
    ball_jacobian,
    consistency_projector,
    coupling_monitor,
    internal_force_matrix,
    pose_step_matrix,
    socket_positions,
)
from tests.reference_geometry import BALLS, crooked_axes, rc1, rc3, three_positioners


def test_one_vertical_axis_wrong_by_a_tenth_is_warp() -> None:
    dq = np.zeros(12)
    dq[5] = 0.1  # B.Z
    found = coupling_monitor(rc1(), BALLS).evaluate(dq)
    assert found[:3] == pytest.approx((0.025, 500.0, 500.0))
    # All four balls are a quarter out, up or down; no distance changes to first order.
    assert found[3:] == pytest.approx((0.025, 0.0), abs=1e-12)


@pytest.mark.parametrize("positioners", [rc1(), rc3()], ids=["rc1", "rc3"])
def test_a_rigid_deviation_is_no_fault(positioners: Positioners) -> None:
    twist = np.array([0.3, -0.2, 0.1, 1e-5, -2e-5, 3e-5])
    dq = (ball_jacobian(BALLS, np.zeros(3)) @ twist).reshape(-1)
    assert coupling_monitor(positioners, BALLS).evaluate(dq) == pytest.approx((0.0,) * 5, abs=1e-6)


def test_a_passive_axis_shows_in_the_residual_and_makes_no_force() -> None:
    dq = np.zeros(12)
    dq[6] = 0.2  # C.X
    monitor = coupling_monitor(rc3(), BALLS)
    found = monitor.evaluate(dq)
    residual, force, warp = found[:3]
    assert np.abs(monitor.beside_mm).max() == pytest.approx(0.2, rel=1e-9)
    assert monitor.free[np.argmax(np.abs(monitor.beside_mm))] == 6
    assert residual == pytest.approx(0.2 * math.hypot(*consistency_projector(BALLS)[6:9, 6]), rel=1e-9)
    assert residual > 0.13
    assert (force, warp) == pytest.approx((0.0, 0.0), abs=1e-9)


@given(seed=st.integers(0, 500))
def test_it_is_the_long_calculation(seed: int) -> None:
    positioners = rc1(crooked_axes(seed))
    dq = np.random.default_rng(seed).normal(size=12)
    shifts = np.einsum("kij,kj->ki", positioners.axes_W, dq.reshape(4, 3)).reshape(12)
    residual = np.linalg.norm((consistency_projector(BALLS) @ shifts).reshape(4, 3), axis=1).max()
    forces = (internal_force_matrix(positioners, BALLS) @ dq).reshape(4, 3)
    warp = abs(forces[:, 2] @ [0.25, -0.25, 0.25, -0.25])
    found = coupling_monitor(positioners, BALLS).evaluate(dq)
    assert found[:3] == pytest.approx((residual, np.linalg.norm(forces, axis=1).max(), warp), rel=1e-9)
    each = (consistency_projector(BALLS) @ shifts).reshape(4, 3)
    assert found.rms_mm == pytest.approx(np.sqrt(np.mean(np.sum(each**2, axis=1))), rel=1e-9)


@given(seed=st.integers(0, 500))
def test_pair_distances_change_as_those_of_the_sockets_do(seed: int) -> None:
    positioners = rc1(crooked_axes(seed))
    dq = 1e-3 * np.random.default_rng(seed).normal(size=12)
    before = socket_positions(positioners, np.zeros(12))
    after = socket_positions(positioners, dq)
    pairs = list(itertools.combinations(range(4), 2))
    changes = [np.linalg.norm(after[i] - after[j]) - np.linalg.norm(before[i] - before[j]) for i, j in pairs]
    assert coupling_monitor(positioners, before).evaluate(dq).pair_mm == pytest.approx(np.abs(changes).max(), rel=1e-4)


def test_passive_axes_go_where_the_driven_ones_take_the_component() -> None:
    # The driven axes alone know the pose: what they say about it, the passive ones must show.
    driven = np.array(rc3().driven)
    twist = np.array([0.3, -0.2, 0.1, 1e-5, -2e-5, 3e-5])
    dq = (ball_jacobian(BALLS, BALLS.mean(axis=0)) @ twist).reshape(-1)
    np.testing.assert_allclose(pose_step_matrix(rc3(), BALLS) @ dq, twist, rtol=1e-9)
    stayed = np.where(driven, dq, 0.0)
    monitor = coupling_monitor(rc3(), BALLS)
    monitor.evaluate(stayed)
    assert np.abs(monitor.beside_mm).max() == pytest.approx(np.abs(dq[~driven]).max(), rel=1e-9)
    assert pose_step_matrix(rc3(), BALLS) @ stayed == pytest.approx(twist, rel=1e-9)


@pytest.mark.parametrize("axis", range(12))
def test_nan_fails_every_limit(axis: int) -> None:
    dq = np.zeros(12)
    dq[axis] = np.nan
    assert all(not value <= 1e9 for value in coupling_monitor(rc1(), BALLS).evaluate(dq)[:5])
    assert all(not value <= 1e9 for value in coupling_monitor(rc3(), BALLS).evaluate(dq))


def test_three_balls_have_no_warp() -> None:
    assert coupling_monitor(three_positioners(), BALLS[:3]).evaluate(np.full(9, 0.1))[2] == 0.0
