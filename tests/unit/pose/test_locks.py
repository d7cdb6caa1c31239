"""Held degrees of freedom keep their value, the others are at their best, and the covariance says so."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.errors import BadArgument
from docking.geometry import euler_to_matrix, log_so3, matrix_to_euler
from docking.pose import LASER_TRACKER, FitSettings, fit_pose
from docking.pose.locks import turning_axes
from docking.pose.settings import FREEDOMS
from docking.pose.uncertainty import pose_difference
from docking.types import Array, Fit, Pose, Screened

BARREL = np.array(
    [[x, 1975 * np.cos(a), 1975 * np.sin(a)] for x, a0 in ((-4500, 0.1), (4500, 0.5)) for a in np.arange(5) * 1.19 + a0]
)
TRUE = (0.4, 0.3, -1.9, 1000.0, -3000.0, 200.0)
NAMES = tuple("ABCDEFGHIJ")


def pose(v: tuple[float, ...] | Array) -> Pose:
    return Pose(euler_to_matrix(v[0], v[1], v[2]), np.array(v[3:]))


def measured(true: tuple[float, ...], seed: int) -> Screened:
    rng = np.random.default_rng(seed)
    p = pose(true).apply(BARREL)
    cov = LASER_TRACKER.covariance(p - np.array([500.0, -29000.0, 800.0]))
    p = p + np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=p.shape))
    return Screened(NAMES, BARREL, np.zeros((10, 3, 3)), p, cov)


def chi2(s: Screened, v: Array) -> float:
    r = s.measured_mm - pose(v).apply(s.nominal_mm)
    return float(np.vdot(r, np.linalg.solve(s.measured_cov_mm2, r[:, :, None])[:, :, 0]))


def vector(fit: Fit, near: tuple[float, ...]) -> Array:
    """Angles and translation of a fit, on the branch of the angles that holds `near`."""
    e = np.array(matrix_to_euler(fit.X_MN.R)[:3])
    other = np.array([e[0] + np.pi, np.pi - e[1], e[2] + np.pi])
    turns = [b + 2 * np.pi * np.round((np.array(near[:3]) - b) / (2 * np.pi)) for b in (e, other)]
    best = min(turns, key=lambda b: float(np.sum((b - near[:3]) ** 2)))
    return np.concatenate([best, fit.X_MN.t_mm])


def locks_of(names: tuple[str, ...], true: tuple[float, ...]) -> tuple[tuple[str, float], ...]:
    return tuple((name, true[FREEDOMS.index(name)]) for name in names)


@pytest.mark.parametrize("beta", [0.3, 2.2])
@pytest.mark.parametrize("names", [c for k in (1, 2, 5) for c in combinations(FREEDOMS, k)][::3], ids="-".join)
def test_held_entries_are_exact_and_the_rest_is_at_the_minimum(names: tuple[str, ...], beta: float) -> None:
    true = (TRUE[0], beta, *TRUE[2:])
    s = measured(true, 3)
    fit = fit_pose(s, FitSettings(locks=locks_of(names, true)))  # type: ignore[arg-type]
    v = vector(fit, true)
    for name in names:
        k = FREEDOMS.index(name)
        assert v[k] == pytest.approx(true[k], abs=1e-9 if k < 3 else 1e-7)
    for k, name in enumerate(FREEDOMS):
        if name not in names:
            h = 1e-5 if k < 3 else 0.05
            plus, minus = (chi2(s, v + sign * h * np.eye(6)[k]) for sign in (1, -1))
            assert abs(plus - minus) < 1e-3 * (plus + minus - 2 * fit.chi2)
    assert fit.chi2 == pytest.approx(chi2(s, v), rel=1e-6)
    assert fit.dof == 24 + len(names)


@pytest.mark.parametrize(
    "names", [("alpha",), ("beta",), ("gamma",), ("alpha", "gamma"), ("beta", "x", "z")], ids="-".join
)
def test_locks_hold_at_a_right_angle(names: tuple[str, ...]) -> None:
    true = (TRUE[0], np.pi / 2, *TRUE[2:])
    s = measured(true, 4)
    free, fit = fit_pose(s), fit_pose(s, FitSettings(locks=locks_of(names, true)))  # type: ignore[arg-type]
    assert free.chi2 <= fit.chi2 < free.chi2 + 30.0
    assert np.linalg.norm(log_so3(fit.X_MN.R @ pose(true).R.T)) < 1e-4
    assert np.all(np.isfinite(fit.cov))


def test_far_from_the_held_values_the_fit_is_bad_and_chi_square_says_so() -> None:
    fit = fit_pose(measured(TRUE, 5), FitSettings(locks=(("alpha", TRUE[0] + 0.01),)))
    assert fit.chi2 > 1e4
    assert matrix_to_euler(fit.X_MN.R).alpha_rad == pytest.approx(TRUE[0] + 0.01, abs=1e-9)


def test_the_covariance_is_honest_in_the_free_directions_and_nothing_in_the_held() -> None:
    names, values, to_mm = ("alpha", "z"), [], np.array([3000.0] * 3 + [1.0] * 3)
    for seed in range(200):
        fit = fit_pose(measured(TRUE, seed), FitSettings(locks=locks_of(names, TRUE)))  # type: ignore[arg-type]
        d = to_mm * pose_difference(fit.X_MN, pose(TRUE), fit.pivot_mm)
        cov = fit.cov * np.outer(to_mm, to_mm)
        assert np.linalg.matrix_rank(cov, rtol=1e-9, hermitian=True) == 4
        values.append(d @ np.linalg.pinv(cov, rcond=1e-9, hermitian=True) @ d)
    assert np.mean(values) == pytest.approx(4.0, abs=4.5 * np.sqrt(8.0 / 200))


@settings(max_examples=30, deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_turning_axes_against_finite_differences(alpha: float, beta: float, gamma: float) -> None:
    R, h = euler_to_matrix(alpha, beta, gamma), 1e-6
    for k in range(3):
        step = np.eye(3)[k] * h
        turn = euler_to_matrix(*(np.array([alpha, beta, gamma]) + step)) @ R.T
        assert log_so3(turn) / h == pytest.approx(turning_axes(beta, gamma)[:, k], abs=1e-5)


def test_an_expansion_is_estimated_beside_the_locks() -> None:
    grown = measured(TRUE, 6)
    warm = Screened(NAMES, BARREL / (1.0 + 4e-5), grown.nominal_cov_mm2, grown.measured_mm, grown.measured_cov_mm2)
    fit = fit_pose(warm, FitSettings(locks=locks_of(("beta", "y"), TRUE), expansion_sigma=1e-4))  # type: ignore[arg-type]
    assert fit.expansion == pytest.approx(4e-5, abs=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"locks": (("theta", 0.0),)},
        {"locks": (("x", 0.0), ("x", 1.0))},
        {"locks": (("x", float("nan")),)},
        {"locks": (("x", 0.0),), "method": "svd"},
        {"weights": (("A", 0.0),)},
        {"triangle": ("A", "B", "A")},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(BadArgument):
        FitSettings(**wrong)  # type: ignore[arg-type]


# weights and a chosen triangle ----------------------------------------------------------------------------------------
def test_a_weight_is_a_smaller_variance() -> None:
    s = measured(TRUE, 7)
    cov = np.array(s.measured_cov_mm2)
    cov[2] *= 4.0
    loose = Screened(NAMES, BARREL, s.nominal_cov_mm2, s.measured_mm, cov)
    one, two = fit_pose(s, FitSettings(weights=(("C", 0.25),))), fit_pose(loose)
    assert np.allclose(one.X_MN.matrix(), two.X_MN.matrix(), atol=1e-9)
    assert np.allclose(one.cov, two.cov)
    assert one.chi2 == pytest.approx(two.chi2)


def test_weights_of_the_equally_weighted_methods_agree_and_matter() -> None:
    s = measured(TRUE, 8)
    weights = (("A", 30.0), ("E", 0.01))
    svd, gn = (fit_pose(s, FitSettings(method=m, weights=weights)) for m in ("svd", "least-squares"))  # type: ignore[arg-type]
    assert np.max(np.linalg.norm(svd.X_MN.apply(BARREL) - gn.X_MN.apply(BARREL), axis=1)) < 1e-8
    assert np.allclose(svd.cov, gn.cov, rtol=1e-6)
    plain = fit_pose(s, FitSettings(method="svd"))
    assert np.linalg.norm(svd.residuals_mm[0]) < 0.5 * np.linalg.norm(plain.residuals_mm[0])


def test_weighted_covariance_is_honest() -> None:
    values = []
    for seed in range(300):
        fit = fit_pose(measured(TRUE, seed), FitSettings(method="svd", weights=(("A", 9.0), ("J", 0.1))))
        d = pose_difference(fit.X_MN, pose(TRUE), fit.pivot_mm)
        values.append(d @ np.linalg.solve(fit.cov, d))
    assert np.mean(values) == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / 300))


def test_a_chosen_triangle_is_the_one_that_is_used() -> None:
    s = measured(TRUE, 9)
    fit = fit_pose(s, FitSettings(method="three-point", triangle=("B", "H", "E")))
    best = fit_pose(s, FitSettings(method="three-point"))
    assert not np.allclose(fit.X_MN.matrix(), best.X_MN.matrix(), atol=1e-9)
    # Frame 2 has its origin in the third corner, which is therefore met exactly.
    assert np.linalg.norm(fit.residuals_mm[4]) < 1e-9
    with pytest.raises(BadArgument, match="Z"):
        fit_pose(s, FitSettings(method="three-point", triangle=("B", "H", "Z")))
