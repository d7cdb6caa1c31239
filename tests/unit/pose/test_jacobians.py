"""Every derivative of the fit against finite differences; fits that carry more than a pose follow frames and units."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.fit_report import SIGMAS, centroid_cov, pose_sigmas
from docking.geometry import euler_to_matrix, exp_so3, log_so3, matrix_to_euler
from docking.pose import FitSettings, fit_pose
from docking.pose.goal import _left_jacobian
from docking.pose.least_squares import design, normal_equations
from docking.pose.locks import ANGLES, TRANSLATIONS, Held, _freedom, _moved, _Place
from docking.pose.uncertainty import pose_difference, propagated_cov, unweighted_cov
from docking.types import Array, Fit, Pose, Screened

H = 1e-6
UNIT = np.array([1e-3] * 3 + [1.0] * 3)
"""A milliradian moves points of metres by millimetres."""
J = np.random.default_rng(2).uniform([-4000, -2000, -2000], [4000, 2000, 2000], (8, 3))
TRUE = Pose(euler_to_matrix(0.4, -0.7, 1.9), np.array([900.0, -2500.0, 400.0]))


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-10000.0, 10000.0, 3))


def covs(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(0.0, 0.05, (n, 3, 3)) + 0.05 * np.eye(3)
    result: Array = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    return result


def shifted(X: Pose, pivot: Array, step: Array) -> Pose:
    """The pose moved by [rotation, translation] about the pivot in M."""
    R = exp_so3(step[:3])
    return Pose(R @ X.R, R @ (X.t_mm - pivot) + pivot + step[3:6])


def test_the_gradient_of_maximum_likelihood() -> None:
    """A^T S^-1 r is minus half the slope of the sum of squares, with S held: the nominal's turns with R."""
    rng = np.random.default_rng(4)
    p, s, none = TRUE.apply(J) + rng.normal(0.0, 0.1, J.shape), covs(rng, 8), np.zeros((8, 3, 3))
    pivot, inverse = p.mean(axis=0), np.linalg.inv(s)

    def cost(step: Array) -> float:
        q = shifted(TRUE, pivot, step[:6]).apply(J)
        r = p - q - step[6] * (q - pivot)
        return float(np.einsum("ni,nij,nj->", r, inverse, r))

    normal, rhs = normal_equations(TRUE, 0.0, (J, p, none, s), pivot)
    unit = np.array([*UNIT, 1e-3])
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-3 * unit[k]
        slope = (cost(step) - cost(-step)) / 2e-3
        bend = (cost(step) + cost(-step) - 2.0 * cost(np.zeros(7))) / 1e-6
        assert -2.0 * rhs[k] * unit[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
        assert 2.0 * normal[k, k] * unit[k] ** 2 == pytest.approx(bend, rel=2e-2)


@pytest.mark.parametrize(
    "held", [(), ("alpha",), ("beta", "x"), ("alpha", "gamma"), ("alpha", "beta", "gamma"), ("x", "y", "z")], ids=str
)
@pytest.mark.parametrize("expansion", [0.0, 1e-4])
def test_free_directions_of_locked_fits(held: tuple[str, ...], expansion: float) -> None:
    """How the pose about the pivot follows each free parameter."""
    angles = np.array([0.4, -0.7, 1.9])
    given_values = dict(zip((*ANGLES, *TRANSLATIONS), (*angles, *TRUE.t_mm), strict=True))
    locks = Held({name: float(given_values[name]) for name in held}, expansion)
    place, pivot = _Place(TRUE, angles), TRUE.apply(J).mean(axis=0)
    basis = _freedom(place, pivot, locks)
    m = 6 - len(held)
    assert basis.shape == (7, m + (1 if expansion else 0))
    for k in range(m):
        step = np.zeros(basis.shape[1])
        step[k] = H
        plus, minus = (pose_difference(_moved(place, sign * step, locks).X, TRUE, pivot) for sign in (1.0, -1.0))
        assert np.allclose((plus - minus) / (2.0 * H), basis[:6, k], rtol=1e-6, atol=2e-3)
    if expansion:
        assert np.array_equal(basis[:, -1], np.eye(7)[6])


@pytest.mark.parametrize("w", [(0.0, 0.0, 0.0), (0.02, -0.05, 0.03), (0.2, 0.1, -0.15)])
def test_left_jacobian_of_the_goal(w: tuple[float, float, float]) -> None:
    at, jac = np.array(w), _left_jacobian(np.array(w))
    for k in range(3):
        step = H * np.eye(3)[k]
        turn = log_so3(exp_so3(at + step) @ exp_so3(at - step).T) / (2.0 * H)
        assert np.allclose(jac[:, k], turn, atol=2.0 * float(np.linalg.norm(at)) ** 4 + 1e-9)


@pytest.mark.parametrize("angles", [(0.3, -0.4, 1.9), (2.0, 1.2, -2.5), (-3.0, -1.4, 0.1)])
def test_sigmas_of_the_six_numbers(angles: tuple[float, float, float]) -> None:
    """Each sigma is the length of the gradient of its number over the six ways in which the pose can move."""
    X, pivot = Pose(euler_to_matrix(*angles), np.array([300.0, -4000.0, 100.0])), np.array([2000.0, 500.0, -700.0])
    fit = Fit(
        X_MN=X, cov=np.diag(UNIT**2), pivot_mm=pivot, names=("A", "B", "C"), residuals_mm=np.zeros((3, 3)), rms_mm=0.0,
        max_mm=0.0, method="ml", iterations=1, chi2=0.0, dof=3,
    )  # fmt: skip
    gradient = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = H * UNIT[k]
        plus, minus = (numbers(shifted(X, pivot, sign * step)) for sign in (1.0, -1.0))
        gradient[:, k] = (plus - minus) / (2.0 * H)
    found = pose_sigmas(fit)
    assert [found[name] for name in SIGMAS] == pytest.approx(np.linalg.norm(gradient, axis=1).tolist(), rel=1e-5)
    centroid = np.array([-1000.0, 800.0, 2500.0])
    moved = [shifted(X, pivot, H * UNIT * np.eye(6)[k]).apply(X.inverse().apply(centroid)) - centroid for k in range(6)]
    expected = np.array(moved).T @ np.array(moved) / H**2
    assert np.allclose(centroid_cov(fit, centroid)[3:, 3:], expected, rtol=1e-4, atol=1e-6)


def numbers(X: Pose) -> Array:
    """[alpha, beta, gamma] in degrees, then x, y, z."""
    e = matrix_to_euler(X.R)
    return np.array([*np.degrees([e.alpha_rad, e.beta_rad, e.gamma_rad]), *X.t_mm])


def test_the_equally_weighted_covariance_is_the_propagated_one() -> None:
    from docking.pose.svd import fit_svd

    rng = np.random.default_rng(6)
    p, s = TRUE.apply(J) + rng.normal(0.0, 0.01, J.shape), covs(rng, 8)
    pivot, weights = p.mean(axis=0), rng.uniform(0.5, 2.0, 8)
    for w in (None, weights):
        closed = unweighted_cov(TRUE.apply(J), s, pivot, w)
        numeric = propagated_cov(lambda j, q, w=w: fit_svd(j, q, w), J, p, s, pivot)
        scale = np.sqrt(np.diag(numeric))
        assert np.allclose(closed / np.outer(scale, scale), numeric / np.outer(scale, scale), atol=1e-4)


def test_design_of_an_expansion_about_the_pivot() -> None:
    pivot = np.array([10.0, -20.0, 30.0])
    assert np.allclose(design(J, pivot)[:, :, 6], J - pivot)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 12), st.sampled_from([1.0, 1e-3, 1 / 25.4]))
def test_a_fit_with_expansion_and_weights_follows_frames_order_and_unit(seed: int, n: int, unit: float) -> None:
    """The scale is a pure number: no frame, order or unit of length changes it."""
    rng = np.random.default_rng(seed)
    j, s, none = rng.uniform(-3000.0, 3000.0, (n, 3)), covs(rng, n), np.zeros((n, 3, 3))
    p = random_pose(rng).apply(j * (1.0 + 1e-4 * rng.normal())) + rng.normal(0.0, 0.05, j.shape)
    A, B, order = random_pose(rng), random_pose(rng), rng.permutation(n)
    names = tuple(f"P{i}" for i in range(n))
    settings_ = FitSettings(expansion_sigma=1e-3, weights=(("P0", 3.0), ("P2", 0.4)))
    one = fit_pose(Screened(names, j, none, p, s), settings_)
    there = Screened(
        tuple(names[i] for i in order), unit * A.apply(j[order]), none, unit * B.apply(p[order]),
        unit**2 * B.R @ s[order] @ B.R.T,
    )  # fmt: skip
    two = fit_pose(there, settings_)
    back = B.inverse() @ Pose(two.X_MN.R, two.X_MN.t_mm / unit) @ A
    assert float(np.max(np.linalg.norm(back.apply(j) - one.X_MN.apply(j), axis=1))) <= 1e-6
    assert two.expansion == pytest.approx(one.expansion, abs=1e-10)
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-5)
    assert two.expansion_cov is not None
    assert one.expansion_cov is not None
    assert two.expansion_cov[6] == pytest.approx(one.expansion_cov[6], rel=1e-5)
