"""What a layout will give is what fits of drawn measurements then give; what is said of points holds by trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.geometry import euler_to_matrix
from docking.pose import LASER_TRACKER, FitSettings, fit_pose
from docking.pose.expected import (
    POWER,
    Aims,
    Layout,
    directions,
    feature_cov_mm2,
    normal_of,
    reliability,
    shares,
    shares_with,
    shares_without,
    sigmas_mm,
)
from docking.pose.quantiles import chi2_upper
from docking.pose.uncertainty import own_cov_mm2
from docking.types import Array, Screened

STATION = np.array([500.0, -9000.0, 800.0])
PLACES = np.array(
    [[x, 1975 * np.cos(a), 1975 * np.sin(a)] for x, a0 in ((-4500, 0.1), (3500, 0.5)) for a in np.arange(5) * 1.19 + a0]
)
FEATURES = np.array([[4000.0, 2000.0, 0.0], [4000.0, -2000.0, 0.0], [4000.0, 0.0, 2000.0], [4000.0, 0.0, -2000.0]])
NAMES = tuple("ABCDEFGHIJ")
NEST = 0.02


def layout(points: Array = PLACES, expansion: float = 0.0) -> Layout:
    cov = LASER_TRACKER.covariance(points - STATION) + NEST**2 * np.eye(3)
    return Layout(NAMES[: len(points)], points, cov, expansion)


def aims(rest_mm: float = 0.0) -> Aims:
    return Aims(FEATURES, np.tile(rest_mm**2 * np.eye(3), (4, 1, 1)), np.array([0.2, 0.2, 0.2, 0.1]))


def standard(rng: np.random.Generator, draws: int, size: int) -> Array:
    """Normal draws (draws, size) whose mean and covariance are exactly 0 and 1: what is left is not luck."""
    z = rng.normal(size=(draws, size))
    z -= z.mean(axis=0)
    root = np.linalg.cholesky(z.T @ z / len(z))
    return np.asarray(z @ np.linalg.inv(root).T)


def drawn_features(of: Layout, draws: int) -> Array:
    """Errors (draws, f, 3) at the features of real fits to drawn nests, readings and temperatures."""
    rng = np.random.default_rng(5)
    noise = LASER_TRACKER.covariance(of.xyz_mm - STATION)
    nest = np.tile(NEST**2 * np.eye(3), (len(of.names), 1, 1))
    n = len(of.names)
    z = standard(rng, draws, 3 * n + 1)
    found = []
    for row in z:
        off = np.einsum("nij,nj->ni", np.linalg.cholesky(of.cov_mm2), row[:-1].reshape(n, 3))
        grown = 1.0 + of.expansion_sigma * row[-1]
        s = Screened(of.names, of.xyz_mm, nest, of.xyz_mm * grown + off, noise)
        fit = fit_pose(s, FitSettings(expansion_sigma=of.expansion_sigma))
        found.append(fit.predict(FEATURES) - FEATURES * grown)
    return np.array(found)


@pytest.mark.parametrize("expansion", [0.0, 20e-6])
@pytest.mark.parametrize("count", [10, 5])
def test_expected_sigma_is_that_of_drawn_fits_within_three_percent(count: int, expansion: float) -> None:
    one = layout(PLACES[:count] if count == 10 else PLACES[::2], expansion)
    drawn = drawn_features(one, 300)
    cov = np.einsum("dfi,dfj->fij", drawn, drawn) / len(drawn)
    stated = own_cov_mm2(feature_cov_mm2(one, FEATURES))
    assert np.trace(cov, axis1=1, axis2=2) == pytest.approx(np.trace(stated, axis1=1, axis2=2), rel=0.03)
    scatter = np.sqrt(np.linalg.eigvalsh(cov)[:, -1])
    normal = normal_of(one)
    assert scatter == pytest.approx(sigmas_mm(normal.cov(), normal.pivot_mm, aims()), rel=0.03)


def test_other_causes_add_to_the_fit() -> None:
    normal = normal_of(layout())
    alone = sigmas_mm(normal.cov(), normal.pivot_mm, aims())
    assert sigmas_mm(normal.cov(), normal.pivot_mm, aims(0.03)) == pytest.approx(np.hypot(alone, 0.03))


def test_the_best_extra_point_is_the_best_by_brute_force() -> None:
    """Every candidate is added to the layout and the fit's covariance worked out anew, about its own pivot."""
    rng = np.random.default_rng(2)
    spots = rng.uniform([-4000, -2000, -2000], [4000, 0, 2000], (40, 3))
    extra = replace(layout(spots), names=tuple(f"X{i}" for i in range(40)))
    one, goal = layout(expansion=1e-5), aims(0.01)
    found = shares_with(one, extra, goal)
    brute = []
    for i in range(40):
        wider = Layout(
            (*NAMES, "X"),
            np.vstack([one.xyz_mm, spots[i]]),
            np.concatenate([one.cov_mm2, extra.cov_mm2[i : i + 1]]),
            1e-5,
        )
        normal = normal_of(wider)
        brute.append(float(shares(normal.cov(), normal.pivot_mm, goal)))
    assert found == pytest.approx(brute, rel=1e-9)
    assert int(np.argmin(found)) == int(np.argmin(brute))
    assert np.min(found) < float(shares(normal_of(one).cov(), normal_of(one).pivot_mm, goal)) < 1.0


def test_leaving_a_point_out_is_the_layout_without_it() -> None:
    one, goal = layout(), aims()
    brute = []
    for i in range(10):
        keep = [k for k in range(10) if k != i]
        normal = normal_of(Layout(tuple(NAMES[k] for k in keep), one.xyz_mm[keep], one.cov_mm2[keep]))
        brute.append(float(shares(normal.cov(), normal.pivot_mm, goal)))
    assert shares_without(one, goal) == pytest.approx(brute, rel=1e-9)


def test_without_a_point_that_it_needs_the_pose_is_open() -> None:
    spots = np.array([[-3000.0, 0, 0], [0, 0, 0], [3000.0, 0, 0], [0.0, 1500.0, 0.0]])
    alone = shares_without(layout(spots), aims())
    assert np.isfinite(alone).tolist() == [True, True, True, False]
    three = reliability(layout(spots[[0, 2, 3]]), aims(), 0.01)
    assert np.all(np.isinf(three.detectable_mm))
    assert np.all(np.isinf(three.harm_mm))


def test_redundancy_adds_up_to_the_degrees_of_freedom() -> None:
    for count in (4, 7, 10):
        found = reliability(layout(PLACES[:count]), aims(), 0.01)
        assert 3.0 * np.sum(found.redundancy) == pytest.approx(3 * count - 6)
        assert np.all((found.redundancy > 0.0) & (found.redundancy < 1.0))


def test_an_error_of_the_detectable_size_is_found_with_the_stated_power() -> None:
    """The least visible error of one point is added to drawn readings; the test of its residual judges it."""
    one, rng, i = layout(), np.random.default_rng(8), 3
    found = reliability(one, aims(), 0.01)
    normal = normal_of(one)
    a = normal.design[i]
    v = one.cov_mm2[i] - a @ np.linalg.inv(normal.matrix) @ a.T
    values, vectors = np.linalg.eigh(normal.weight[i] @ v @ normal.weight[i])
    error = found.detectable_mm[i] * vectors[:, 0]
    nest, limit, hits = np.tile(NEST**2 * np.eye(3), (10, 1, 1)), chi2_upper(0.001, 3), 0
    noise = LASER_TRACKER.covariance(PLACES - STATION)
    for row in rng.normal(size=(400, 10, 3)):
        off = np.einsum("nij,nj->ni", np.linalg.cholesky(one.cov_mm2), row)
        off[i] += error
        r = fit_pose(Screened(NAMES, PLACES, nest, PLACES + off, noise)).residuals_mm[i]
        hits += bool(r @ np.linalg.solve(v, r) > limit)
    assert values[0] < values[1]
    assert hits / 400 == pytest.approx(POWER, abs=4.0 * np.sqrt(POWER * (1.0 - POWER) / 400))


def test_harm_is_the_most_that_an_unnoticed_error_moves_a_feature() -> None:
    one, i = layout(), 6
    found = reliability(one, aims(), 0.01)
    normal = normal_of(one)
    inverse = np.linalg.inv(normal.matrix)
    v = one.cov_mm2[i] - normal.design[i] @ inverse @ normal.design[i].T
    shown = normal.weight[i] @ v @ normal.weight[i]
    least = found.detectable_mm[i] ** 2 * float(np.linalg.eigvalsh(shown)[0])
    rng, worst = np.random.default_rng(1), 0.0
    nest, noise = np.zeros((10, 3, 3)), one.cov_mm2
    for direction in rng.normal(size=(400, 3)):
        error = direction * np.sqrt(least / (direction @ shown @ direction))
        off = np.zeros((10, 3))
        off[i] = error
        fit = fit_pose(Screened(NAMES, PLACES, nest, PLACES + off, noise))
        worst = max(worst, float(np.max(np.linalg.norm(fit.X_MN.apply(FEATURES) - FEATURES, axis=1))))
    assert worst == pytest.approx(found.harm_mm[i], rel=0.03)
    assert worst <= found.harm_mm[i] * (1.0 + 1e-3)


def test_weak_directions_are_told_in_the_parts_own_axes() -> None:
    """Points near the X axis of the part hold the rotation about X badly, however the part is turned."""
    R = euler_to_matrix(0.4, -0.3, 1.2)
    thin = np.array([[-4000.0, 100, 0], [-4000.0, -100, 80], [4000.0, 100, -90], [4000.0, -100, 0], [0, 0, 100.0]])
    cov = np.tile(0.05**2 * np.eye(3), (5, 1, 1))
    normal = normal_of(Layout(NAMES[:5], thin @ R.T, cov))
    weakest = directions(normal.cov(), 2000.0, R)[0]
    unit = weakest.rotation_rad / np.linalg.norm(weakest.rotation_rad)
    assert abs(unit[0]) > 0.99
    assert weakest.moves_mm == pytest.approx(2000.0 * np.linalg.norm(weakest.rotation_rad), rel=0.01)
    parts = directions(normal.cov(), 2000.0, R)
    total = sum(d.moves_mm**2 for d in parts)
    scaled = np.trace(normal.cov()[:3, :3]) * 2000.0**2 + np.trace(normal.cov()[3:6, 3:6])
    assert total == pytest.approx(scaled)
    assert [d.moves_mm for d in parts] == sorted((d.moves_mm for d in parts), reverse=True)
