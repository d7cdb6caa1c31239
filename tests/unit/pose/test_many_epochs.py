"""Fits of many epochs at once against the single fit, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import DegenerateTargets, TooFewPoints
from docking.pose.batch import fit_poses
from docking.pose.svd import fit_svd
from docking.types import Array

LAYOUTS = {"volume": (4000.0, 2000.0, 1500.0), "plane": (4000.0, 2000.0, 0.0), "thin": (4000.0, 2000.0, 0.1)}


def _epochs(extent: tuple[float, float, float], count: int, noise_mm: float) -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(7)
    nominal = rng.uniform(-1.0, 1.0, (10, 3)) * extent + (5e3, -2e3, 1e3)
    R, t = Rotation.random(count, random_state=3).as_matrix(), rng.uniform(-1e4, 1e4, (count, 3))
    measured = np.einsum("bij,nj->bni", R, nominal) + t[:, None, :] + rng.normal(0.0, noise_mm, (count, 10, 3))
    return nominal, measured, R, t


@pytest.mark.parametrize("extent", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("weighted", [False, True])
def test_each_epoch_is_the_optimum_that_the_single_fit_finds(
    extent: tuple[float, float, float], weighted: bool
) -> None:
    nominal, measured, _, _ = _epochs(extent, 300, 0.5)
    weights = np.linspace(0.2, 3.0, 10) if weighted else None
    many = fit_poses(nominal, measured, weights)
    for k in range(0, 300, 5):
        one = fit_svd(nominal, measured[k], weights)
        np.testing.assert_allclose(many.R[k], one.R, atol=1e-12)
        np.testing.assert_allclose(many.t_mm[k], one.t_mm, atol=1e-8)


def test_without_noise_the_true_poses_come_back() -> None:
    nominal, measured, R, t = _epochs(LAYOUTS["volume"], 5000, 0.0)
    many = fit_poses(nominal, measured)
    at_points = np.einsum("bij,nj->bni", many.R - R, nominal) + (many.t_mm - t)[:, None, :]
    assert np.abs(at_points).max() <= 1e-8
    np.testing.assert_allclose(np.linalg.det(many.R), 1.0, atol=1e-12)


def test_a_mirror_image_is_fitted_by_a_rotation() -> None:
    nominal, measured, _, _ = _epochs(LAYOUTS["volume"], 20, 0.0)
    many = fit_poses(nominal, measured * (1.0, 1.0, -1.0))
    np.testing.assert_allclose(np.linalg.det(many.R), 1.0, atol=1e-12)
    one = fit_svd(nominal, measured[4] * (1.0, 1.0, -1.0))
    np.testing.assert_allclose(many.R[4], one.R, atol=1e-12)


def test_a_lost_epoch_leaves_the_others_alone() -> None:
    nominal, measured, _, _ = _epochs(LAYOUTS["volume"], 50, 0.1)
    broken = measured.copy()
    broken[17, 3] = np.nan
    many = fit_poses(nominal, broken)
    assert np.isnan(many.R[17]).all()
    assert np.isnan(many.t_mm[17]).all()
    np.testing.assert_allclose(np.delete(many.R, 17, 0), np.delete(fit_poses(nominal, measured).R, 17, 0), atol=1e-15)


def test_what_leaves_the_rotation_open_is_refused_by_name() -> None:
    nominal, measured, _, _ = _epochs(LAYOUTS["volume"], 8, 0.0)
    with pytest.raises(TooFewPoints):
        fit_poses(nominal[:2], measured[:, :2])
    with pytest.raises(DegenerateTargets):
        fit_poses(np.outer(np.arange(10.0), (1.0, 2.0, 3.0)), measured)
    line = measured.copy()
    line[5] = np.outer(np.arange(10.0), (100.0, 50.0, 20.0))
    with pytest.raises(DegenerateTargets, match="epoch 5"):
        fit_poses(nominal, line)
    with pytest.raises(DegenerateTargets, match="epoch 5005"):
        fit_poses(nominal, np.concatenate([np.tile(measured[:1], (5000, 1, 1)), line]))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_units_and_order_of_points_do_not_matter(seed: int, unit: float) -> None:
    nominal, measured, _, _ = _epochs(LAYOUTS["volume"], 3, 0.5)
    order = np.random.default_rng(seed).permutation(10)
    plain, other = fit_poses(nominal, measured), fit_poses(unit * nominal[order], unit * measured[:, order])
    np.testing.assert_allclose(other.R, plain.R, atol=1e-11)
    np.testing.assert_allclose(other.t_mm, unit * plain.t_mm, atol=1e-7 * unit)
