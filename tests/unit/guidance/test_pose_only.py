"""The pose of one camera: derivatives, robustness, and a covariance that is true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.geometry import log_so3
from docking.guidance.pose_only import (
    Sights,
    focal_misfit,
    jacobian,
    perturbed,
    refine,
    residuals,
    second_pose,
    seen_sigma_mm,
)
from docking.guidance.types import Camera
from docking.types import Array, Pose
from sim.scenery import looking

CAMERA = Camera(960, 720, 800.0, 810.0, 479.5, 359.5)
X_WC = looking(np.array([100.0, 50.0, 0.0]), np.array([0.0, 0.0, 900.0]), 10.0)


def points(n: int, rng: np.random.Generator) -> Array:
    """In view of X_WC, some standing out of the wall."""
    at = np.column_stack([rng.uniform(-250.0, 400.0, n), rng.uniform(-250.0, 300.0, n), rng.uniform(0.0, 250.0, n)])
    pixels = CAMERA.project(X_WC.inverse().apply(at))
    inside = np.all((pixels > 0.0) & (pixels < (960.0, 720.0)), axis=1)
    return at[inside]


def seen(n: int, rng: np.random.Generator, noise_px: float) -> Sights:
    at = points(n, rng)
    pixels = CAMERA.project(X_WC.inverse().apply(at)) + rng.normal(0.0, noise_px, (len(at), 2))
    return Sights(at, pixels, np.full(len(at), max(noise_px, 0.1)))


def test_jacobian_is_the_slope_of_the_projection() -> None:
    sights = seen(30, np.random.default_rng(1), 0.0)
    J = jacobian(CAMERA, X_WC.inverse().apply(sights.points_mm))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6 if k < 3 else 1e-3
        ahead, _ = residuals(CAMERA, perturbed(X_WC, step), sights)
        behind, _ = residuals(CAMERA, perturbed(X_WC, -step), sights)
        # A residual is seen minus projected.
        assert np.allclose(-(ahead - behind) / (2.0 * step[k]), J[:, :, k], rtol=1e-5, atol=1e-5)


def test_a_third_of_wrong_matches_does_not_move_the_pose() -> None:
    rng = np.random.default_rng(2)
    sights = seen(300, rng, 0.5)
    wrong = rng.choice(len(sights), len(sights) // 3, replace=False)
    sights.pixels[wrong] += rng.uniform(20.0, 90.0, (len(wrong), 2))
    start = perturbed(X_WC, np.array([0.01, -0.01, 0.02, 8.0, -6.0, 10.0]))
    fit = refine(CAMERA, start, sights)
    assert np.linalg.norm(fit.X_WC.t_mm - X_WC.t_mm) < 1.0
    assert not fit.inside[wrong].any()


def test_covariance_says_how_far_the_pose_is_off() -> None:
    """Over many draws the squared error in sigmas is that of six degrees of freedom, within what clusters cost."""
    rng = np.random.default_rng(3)
    squared = []
    for _ in range(60):
        fit = refine(CAMERA, X_WC, seen(250, rng, 0.7))
        error = X_WC.inverse() @ fit.X_WC
        e = np.concatenate([log_so3(error.R), error.t_mm])
        squared.append(e @ np.linalg.solve(fit.cov, e))
    # cov is the sum of two estimates of the same covariance: on average half of 6.
    assert 1.8 < float(np.mean(squared)) < 6.5


def test_errors_that_whole_parts_of_the_image_share_make_it_less_certain() -> None:
    rng = np.random.default_rng(4)
    sights = seen(400, rng, 0.3)
    bent = Sights(sights.points_mm, sights.pixels.copy(), sights.sigma_px)
    bent.pixels[:, 0] += 1.5 * np.sin(bent.pixels[:, 0] / 120.0)
    good, worse = (refine(CAMERA, X_WC, s) for s in (sights, bent))
    assert np.trace(worse.cov[3:, 3:]) > 4.0 * np.trace(good.cov[3:, 3:])


def test_what_is_seen_ignores_an_error_along_the_line_of_sight() -> None:
    cov = np.zeros((6, 6))
    cov[5, 5] = 25.0
    assert seen_sigma_mm(cov, np.array([0.0, 0.0, 800.0])) == pytest.approx(0.0, abs=1e-9)
    cov[5, 5], cov[3, 3], cov[1, 1] = 0.0, 4.0, 1e-6
    assert seen_sigma_mm(cov, np.array([0.0, 0.0, 1000.0])) == pytest.approx(np.sqrt(4.0 + 1.0))


def test_start_on_the_answer_stays() -> None:
    fit = refine(CAMERA, X_WC, seen(100, np.random.default_rng(5), 0.0))
    assert np.allclose(fit.X_WC.t_mm, X_WC.t_mm, atol=1e-6)
    assert isinstance(fit.X_WC, Pose)


def test_points_at_several_depths_tell_a_wrong_focal_length() -> None:
    rng = np.random.default_rng(6)
    for share in (1.0, 0.97, 1.04):
        sights = seen(400, rng, 0.5)
        told = replace(CAMERA, fx_px=CAMERA.fx_px * share, fy_px=CAMERA.fy_px * share)
        larger, sigma = focal_misfit(told, refine(told, X_WC, sights), sights)
        assert sigma < 0.006
        assert larger == pytest.approx(-np.log(share), abs=4.0 * sigma)
        assert (abs(larger) > 3.0 * sigma) == (share != 1.0)


def test_a_flat_wall_straight_ahead_says_nothing_about_the_focal_length() -> None:
    rng = np.random.default_rng(7)
    at = np.column_stack([rng.uniform(-300.0, 300.0, (300, 2)), np.full(300, 900.0)])
    X = Pose(np.eye(3), np.zeros(3))
    sights = Sights(at, CAMERA.project(at) + rng.normal(0.0, 0.5, (300, 2)), np.full(300, 0.5))
    told = replace(CAMERA, fx_px=1.05 * CAMERA.fx_px, fy_px=1.05 * CAMERA.fy_px)
    larger, sigma = focal_misfit(told, refine(told, X, sights), sights)
    assert abs(larger) < 3.0 * sigma
    assert sigma > 0.02


@pytest.mark.parametrize(
    ("half_mm", "stands_out_mm", "two"), [(30.0, 0.0, True), (300.0, 0.0, False), (30.0, 60.0, False)]
)
def test_a_small_flat_patch_fits_two_poses_a_large_or_deep_one_does_not(
    half_mm: float, stands_out_mm: float, two: bool
) -> None:
    rng = np.random.default_rng(8)
    at = np.column_stack([rng.uniform(-half_mm, half_mm, (150, 2)), rng.uniform(-stands_out_mm, 0.0, 150)])
    X = looking(np.zeros(3), np.array([150.0, 100.0, -900.0]))
    p_C = X.inverse().apply(at)
    sights = Sights(at, CAMERA.project(p_C) + rng.normal(0.0, 0.8, (150, 2)), np.full(150, 0.8))
    assert second_pose(CAMERA, refine(CAMERA, X, sights), sights) == two
