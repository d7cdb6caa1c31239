"""Axis positions -> pose: docs/mechanics.md (10), (11)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import FrameImplausible
from docking.kinematics import (
    axis_positions,
    figure_residual_mm,
    pose_from_axes,
)
from docking.types import Pose
from tests.reference_geometry import BALLS, crooked_axes, rc1, rc3


def pose(seed: int, degrees: float = 5.0) -> Pose:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(-degrees, degrees, 3))).as_matrix()
    return Pose(turn, rng.uniform(-60, 60, 3))


@given(seed=st.integers(0, 1000))
def test_pose_is_recovered_from_all_axes_and_from_six(seed: int) -> None:
    positioners, X = rc1(crooked_axes(seed)), pose(seed)
    q = axis_positions(positioners, X.apply(BALLS))
    for rows in (None, rc3().driven, rc3(d_z_driven=False).driven):
        found = pose_from_axes(positioners, q, rows)
        np.testing.assert_allclose(found.apply(BALLS), X.apply(BALLS), atol=1e-8)


def test_a_passive_deviation_is_a_residual_only_when_its_encoder_is_used() -> None:
    positioners, X = rc3(d_z_driven=False), pose(1)
    q = axis_positions(positioners, X.apply(BALLS))
    q[6] += 0.4  # C.X, passive
    driven_only = pose_from_axes(positioners, q, positioners.driven)
    np.testing.assert_allclose(driven_only.apply(BALLS), X.apply(BALLS), atol=1e-8)
    residual = figure_residual_mm(positioners, q, driven_only)
    np.testing.assert_allclose(residual[2], [0.4, 0.0, 0.0], atol=1e-8)
    shared = figure_residual_mm(positioners, q, pose_from_axes(positioners, q))
    assert np.abs(shared).max() == pytest.approx(0.4 * 0.6838, rel=0.02)


def test_rows_that_fix_no_pose_are_refused() -> None:
    rows = np.zeros(12, dtype=bool)
    rows[2::3] = True
    with pytest.raises(FrameImplausible):
        pose_from_axes(rc1(), np.zeros(12), rows)
    with pytest.raises(FrameImplausible):
        pose_from_axes(rc1(), np.full(12, np.nan))
