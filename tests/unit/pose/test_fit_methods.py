"""The three methods of [Luo]: exact without noise, equal where they must be equal, invariant to frames and order."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import BadArgument, DegenerateTargets, TooFewPoints
from docking.geometry import euler_to_matrix, exp_so3, rotation_angle
from docking.pose import METHODS, FitSettings, fit_pose
from docking.pose.least_squares import design, euler_jacobian, fit_gauss_newton
from docking.pose.svd import fit_svd, mirrored_rms_mm
from docking.pose.three_point import best_triangle, fit_three_point, triangle_frame
from docking.types import Pose, Screened

ESTIMATORS = {"svd": fit_svd, "three-point": fit_three_point, "gauss-newton": lambda j, p: fit_gauss_newton(j, p)[0]}
BARREL = np.array(
    [[x, 1975 * np.cos(a), 1975 * np.sin(a)] for x, a0 in ((-4500, 0.1), (4500, 0.5)) for a in np.arange(5) * 1.19 + a0]
)


def random_pose(rng: np.random.Generator, reach_mm: float = 10000.0) -> Pose:
    return Pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-reach_mm, reach_mm, 3))


def screened(
    j: np.ndarray, p: np.ndarray, cov: np.ndarray | None = None, nominal_cov: np.ndarray | None = None
) -> Screened:
    n = len(j)
    s = np.broadcast_to(0.05**2 * np.eye(3), (n, 3, 3)) if cov is None else cov
    s_j = np.zeros((n, 3, 3)) if nominal_cov is None else nominal_cov
    return Screened(tuple(f"P{i}" for i in range(n)), j, s_j, p, np.array(s))


def largest_gap_mm(X: Pose, Y: Pose, j: np.ndarray) -> float:
    return float(np.max(np.linalg.norm(X.apply(j) - Y.apply(j), axis=1)))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n", [3, 4, 10])
def test_noiseless_pose_to_a_picometre(method: str, n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(50):
        X = random_pose(rng)
        j = BARREL[rng.permutation(10)[:n]]
        fit = fit_pose(screened(j, X.apply(j)), FitSettings(method=method))
        assert largest_gap_mm(fit.X_MN, X, j) <= 1e-9
        assert fit.max_mm <= 1e-9
        assert np.linalg.det(fit.X_MN.R) == pytest.approx(1.0, abs=1e-12)
        assert fit.dof == 3 * n - 6


def test_gauss_newton_reaches_the_svd_optimum() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        X, j = random_pose(rng), BARREL
        p = X.apply(j) + rng.uniform(-0.5, 0.5, j.shape)
        found, iterations = fit_gauss_newton(j, p)
        assert largest_gap_mm(found, fit_svd(j, p), j) <= 1e-9
        assert iterations <= 8


def test_maximum_likelihood_with_equal_covariances_is_the_svd_fit() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        X = random_pose(rng)
        p = X.apply(BARREL) + rng.normal(0.0, 0.3, BARREL.shape)
        fit = fit_pose(screened(BARREL, p))
        assert largest_gap_mm(fit.X_MN, fit_svd(BARREL, p), BARREL) <= 1e-9


def test_unweighted_setting_ignores_covariances() -> None:
    rng = np.random.default_rng(3)
    p = BARREL + rng.normal(0.0, 0.3, BARREL.shape)
    cov = rng.uniform(0.01, 10.0, (10, 1, 1)) * np.eye(3)
    loose = fit_pose(screened(BARREL, p, cov), FitSettings(method="least-squares"))
    assert largest_gap_mm(loose.X_MN, fit_svd(BARREL, p), BARREL) <= 1e-9
    assert largest_gap_mm(fit_pose(screened(BARREL, p, cov)).X_MN, fit_svd(BARREL, p), BARREL) > 1e-3


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 20), st.sampled_from(sorted(ESTIMATORS)))
def test_moving_both_frames_moves_the_pose(seed: int, n: int, name: str) -> None:
    """X(A j, B p) = B X(j, p) A^-1 for any rigid A, B."""
    rng = np.random.default_rng(seed)
    j = rng.uniform(-3000.0, 3000.0, (n, 3))
    p = random_pose(rng).apply(j) + rng.normal(0.0, 0.1, j.shape)
    A, B = random_pose(rng), random_pose(rng)
    estimate = ESTIMATORS[name]
    moved = estimate(A.apply(j), B.apply(p))
    assert largest_gap_mm(moved @ A, B @ estimate(j, p), j) <= 1e-6


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 15), st.sampled_from(METHODS), st.sampled_from([1.0, 1e-3, 1 / 25.4]))
def test_a_whole_fit_follows_frames_and_unit_of_length(seed: int, n: int, method: str, unit: float) -> None:
    """Pose, covariance and chi-square of any method, with covariances of both sides that turn and scale along."""
    rng = np.random.default_rng(seed)
    j = rng.uniform(-3000.0, 3000.0, (n, 3))
    root = rng.normal(0.0, 0.05, (2, n, 3, 3)) + 0.05 * np.eye(3)
    cov, nominal_cov = root @ root.transpose(0, 1, 3, 2) + 1e-4 * np.eye(3)
    p = random_pose(rng).apply(j) + rng.normal(0.0, 0.1, j.shape)
    A, B = random_pose(rng), random_pose(rng)
    one = fit_pose(screened(j, p, cov, nominal_cov), FitSettings(method=method))
    turned = unit**2 * B.R @ cov @ B.R.T, unit**2 * A.R @ nominal_cov @ A.R.T
    moved = screened(unit * A.apply(j), unit * B.apply(p), *turned)
    two = fit_pose(moved, FitSettings(method=method))
    back = B.inverse() @ Pose(two.X_MN.R, two.X_MN.t_mm / unit) @ A
    assert largest_gap_mm(back, one.X_MN, j) <= 1e-6
    turn = np.kron(np.diag([1.0, unit]), B.R)
    sigma = np.sqrt(np.diag(two.cov))
    assert np.allclose(turn @ one.cov @ turn.T / np.outer(sigma, sigma), two.cov / np.outer(sigma, sigma), atol=1e-5)
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 15), st.sampled_from(METHODS))
def test_order_of_points_does_not_matter(seed: int, n: int, method: str) -> None:
    rng = np.random.default_rng(seed)
    j = rng.uniform(-3000.0, 3000.0, (n, 3))
    p = random_pose(rng).apply(j) + rng.normal(0.0, 0.1, j.shape)
    order = rng.permutation(n)
    one, two = (fit_pose(screened(*q), FitSettings(method=method)) for q in ((j, p), (j[order], p[order])))
    assert largest_gap_mm(one.X_MN, two.X_MN, j) <= 1e-8
    assert np.allclose(one.residuals_mm[order], two.residuals_mm, atol=1e-8)


def test_coplanar_targets_keep_a_rotation() -> None:
    """A flat layout makes det(V U^T) negative in a third of the fits: an ordinary path."""
    rng = np.random.default_rng(4)
    flips = 0
    for _ in range(200):
        j = np.column_stack([rng.uniform(-2000, 2000, (8, 2)), np.zeros(8)])
        X = random_pose(rng)
        p = X.apply(j) + rng.normal(0.0, 0.3, j.shape)
        flips += mirrored_rms_mm(j, p) < 1.0
        for estimate in ESTIMATORS.values():
            found = estimate(j, p)
            assert np.linalg.det(found.R) == pytest.approx(1.0, abs=1e-9)
            assert rotation_angle(found.R @ X.R.T) < 2e-3
    assert flips == 200


def test_gimbal_lock_is_no_obstacle() -> None:
    rng = np.random.default_rng(5)
    for beta in (90.0, -90.0, 89.9999999):
        X = Pose(euler_to_matrix(0.3, np.radians(beta), -1.1), np.array([100.0, -2000.0, 30.0]))
        p = X.apply(BARREL) + rng.normal(0.0, 0.1, BARREL.shape)
        best = fit_svd(BARREL, p)
        assert largest_gap_mm(fit_gauss_newton(BARREL, p)[0], best, BARREL) <= 1e-7
        assert largest_gap_mm(fit_pose(screened(BARREL, p)).X_MN, best, BARREL) <= 1e-9


def test_gauss_newton_from_a_far_start() -> None:
    rng = np.random.default_rng(6)
    p = BARREL + rng.normal(0.0, 0.3, BARREL.shape)
    for angle in (0.5, 1.5, 2.9):
        start = Pose(exp_so3(angle * np.array([0.6, -0.64, 0.48])), np.full(3, 5000.0))
        assert largest_gap_mm(fit_gauss_newton(BARREL, p, start)[0], fit_svd(BARREL, p), BARREL) <= 1e-9


@pytest.mark.parametrize("angles", [(0.3, -0.4, 1.9), (2.0, 1.2, -2.5), (0.0, np.pi / 2, 0.4)])
def test_euler_jacobian_against_finite_differences(angles: tuple[float, float, float]) -> None:
    jac, h = euler_jacobian(*angles, BARREL), 1e-6
    for k in range(3):
        step = np.eye(3)[k] * h
        plus, minus = (BARREL @ euler_to_matrix(*(np.array(angles) + s)).T for s in (step, -step))
        assert np.allclose(jac[:, :, k], (plus - minus) / (2 * h), atol=1e-4)
    assert np.array_equal(jac[:, :, 3:], np.broadcast_to(np.eye(3), (10, 3, 3)))


def test_design_matrix_against_finite_differences() -> None:
    pivot, h = np.array([100.0, 200.0, -50.0]), 1e-6
    jac = design(BARREL, pivot)
    for k in range(7):
        moved = []
        for s in (h, -h):
            x = np.eye(7)[k] * s
            moved.append((1 + x[6]) * (BARREL - pivot) @ exp_so3(x[:3]).T + pivot + x[3:6])
        assert np.allclose(jac[:, :, k], (moved[0] - moved[1]) / (2 * h), atol=1e-4)


def test_frame_of_a_triangle() -> None:
    """Origin C, Y along CA, X in the plane towards B, right-handed."""
    X = triangle_frame(np.array([1.0, 5.0, 0.0]), np.array([4.0, 2.0, 0.0]), np.array([1.0, 1.0, 0.0]))
    assert np.allclose(X.t_mm, [1.0, 1.0, 0.0])
    assert np.allclose(X.R, np.eye(3))


def test_best_triangle_is_the_largest() -> None:
    rng = np.random.default_rng(7)
    j = rng.uniform(-1.0, 1.0, (12, 3))

    def area(t: tuple[int, ...]) -> float:
        a, b, c = (j[k] for k in t)
        return float(np.linalg.norm(np.cross(a - c, b - c)))

    assert area(best_triangle(j)) == pytest.approx(max(area(t) for t in combinations(range(12), 3)))
    assert len(set(best_triangle(rng.uniform(-1.0, 1.0, (198, 3))))) == 3


@pytest.mark.parametrize("method", METHODS)
def test_degenerate_layouts_are_refused(method: str) -> None:
    line = np.column_stack([np.linspace(0, 5000, 8), np.zeros(8), np.zeros(8)])
    for j, error in (
        (line[:2], TooFewPoints),
        (line, DegenerateTargets),
        (line[:3], DegenerateTargets),
        (line[[0] * 5], DegenerateTargets),
    ):
        with pytest.raises(error):
            fit_pose(screened(j, j + 100.0), FitSettings(method=method))


def test_distance_to_the_line_decides() -> None:
    line = np.column_stack([np.linspace(0, 5000, 8), np.zeros(8), np.zeros(8)])
    for off, refused in ((0.5, True), (1.0, True), (20.0, False), (500.0, False)):
        j = line + np.array([0.0, off, 0.0]) * (np.arange(8) % 2)[:, None]
        if refused:
            with pytest.raises(DegenerateTargets) as caught:
                fit_pose(screened(j, j))
            assert caught.value.value < caught.value.limit  # type: ignore[operator]
        else:
            assert fit_pose(screened(j, j)).max_mm < 1e-9


def test_settings_are_checked() -> None:
    for bad in (
        {"method": "guess"},
        {"false_alarm": float("nan")},
        {"min_agreeing": 2},
        {"expansion_sigma": float("nan")},
    ):
        with pytest.raises(BadArgument):
            FitSettings(**bad)  # type: ignore[arg-type]
