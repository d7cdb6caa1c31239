"""The covariance of a fit is honest, and the weighted fit reaches the Cramer-Rao bound."""

import numpy as np
import pytest

from docking.errors import BadArgument
from docking.pose import LASER_TRACKER, NOISE_PRESETS, TOTAL_STATION, FitSettings, NoiseModel, fit_pose
from docking.pose.uncertainty import joint_cov_mm2, largest_sigma_mm, own_cov_mm2, pose_difference
from docking.types import Array, Fit, Pose, Screened
from tests.support.nees import nees

STATION = np.array([500.0, -9000.0, 800.0])
BARREL = np.array(
    [[x, 1975 * np.cos(a), 1975 * np.sin(a)] for x, a0 in ((-4500, 0.1), (4500, 0.5)) for a in np.arange(5) * 1.19 + a0]
)


def fits(method: str, draws: int, nominal_sigma_mm: float = 0.0, expansion: float = 0.0) -> list[Fit]:
    """Fits of the barrel at identity, seen by a laser tracker nine metres to the side."""
    rng = np.random.default_rng(11)
    cov = LASER_TRACKER.covariance(BARREL - STATION)
    root = np.linalg.cholesky(cov)
    nominal_cov = np.broadcast_to(nominal_sigma_mm**2 * np.eye(3), (10, 3, 3))
    names = tuple("ABCDEFGHIJ")
    found = []
    for _ in range(draws):
        grown = BARREL * (1.0 + expansion * rng.normal())
        p = grown + np.einsum("nij,nj->ni", root, rng.normal(size=(10, 3)))
        j = BARREL + nominal_sigma_mm * rng.normal(size=(10, 3))
        s = Screened(names, j, np.array(nominal_cov), p, cov)
        found.append(fit_pose(s, FitSettings(method=method, expansion_sigma=expansion)))  # type: ignore[arg-type]
    return found


def point_cov_mm2(fit: Fit, points_mm: Array) -> Array:
    return own_cov_mm2(joint_cov_mm2(fit, points_mm))


def point_rms_mm(found: list[Fit]) -> float:
    off = np.array([f.X_MN.apply(BARREL) - BARREL for f in found])
    return float(np.sqrt(np.mean(np.sum(off**2, axis=2))))


@pytest.mark.parametrize(("method", "draws"), [("ml", 1500), ("svd", 600), ("three-point", 300)])
def test_normalised_error_squared_is_six(method: str, draws: int) -> None:
    values = [nees(f, Pose.identity()) for f in fits(method, draws)]
    assert np.mean(values) == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / draws))


def test_the_nominal_covariance_counts_too() -> None:
    values = [nees(f, Pose.identity()) for f in fits("ml", 600, 0.05)]
    assert np.mean(values) == pytest.approx(6.0, abs=4.5 * np.sqrt(12.0 / 600))


def test_chi_square_matches_its_degrees_of_freedom() -> None:
    found = fits("ml", 800)
    assert np.mean([f.chi2 for f in found]) == pytest.approx(found[0].dof, abs=4.5 * np.sqrt(2 * 24 / 800))


def test_weighted_fit_reaches_the_bound_and_svd_does_not() -> None:
    ml, svd, three = (fits(m, 600) for m in ("ml", "svd", "three-point"))
    bound = float(np.sqrt(np.mean(np.trace(point_cov_mm2(ml[0], BARREL), axis1=1, axis2=2))))
    assert point_rms_mm(ml) == pytest.approx(bound, rel=0.05)
    assert point_rms_mm(svd) / point_rms_mm(ml) >= 1.10
    assert point_rms_mm(three) / point_rms_mm(ml) >= 1.8


def test_covariance_at_a_far_point_is_what_happens_there() -> None:
    found, far = fits("ml", 1000), np.array([[12000.0, 500.0, 0.0]])
    off = np.array([(f.X_MN.apply(far) - far)[0] for f in found])
    measured = off.T @ off / len(off)
    assert np.allclose(measured, point_cov_mm2(found[0], far)[0], atol=0.15 * np.max(measured))


def test_expansion_is_estimated_and_its_covariance_is_honest() -> None:
    found, far = fits("ml", 800, expansion=20e-6), np.array([[9000.0, 0.0, 1000.0]])
    assert np.std([f.expansion for f in found]) == pytest.approx(20e-6, rel=0.1)
    rng = np.random.default_rng(11)
    ratio = []
    for f in found:
        e = 20e-6 * rng.normal()
        rng.normal(size=(10, 3))
        rng.normal(size=(10, 3))
        off = (f.predict(far) - far * (1.0 + e))[0]
        ratio.append(off @ np.linalg.solve(point_cov_mm2(f, far)[0], off))
    assert np.mean(ratio) == pytest.approx(3.0, abs=4.5 * np.sqrt(6.0 / 800))


def test_rigid_fit_carries_no_expansion() -> None:
    f = fits("ml", 1)[0]
    assert f.expansion == 0.0
    assert f.expansion_cov is None
    assert np.allclose(f.predict(BARREL), f.X_MN.apply(BARREL))


def test_pose_difference_about_a_pivot() -> None:
    pivot = np.array([1000.0, 0.0, 0.0])
    turned = Pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1000.0, -1000.0, 7.0]))
    assert np.allclose(pose_difference(turned, Pose.identity(), pivot), [0, 0, np.pi / 2, 0, 0, 7.0])


def test_laser_tracker_noise_is_half_the_mpe() -> None:
    along, across = LASER_TRACKER.sigmas_mm([3000.0, 9000.0, 20000.0])
    assert across == pytest.approx(np.array([0.033, 0.069, 0.135]) / 2)
    mpe_um = np.hypot([10.9, 12.7, 16.0], 5.0)
    assert along == pytest.approx(mpe_um * 1e-3 / 2)


def test_noise_lies_along_and_across_the_line_of_sight() -> None:
    cov = LASER_TRACKER.covariance([[0.0, 9000.0, 0.0], [0.0, 0.0, -9000.0]])
    along, across = (float(v[0]) for v in LASER_TRACKER.sigmas_mm([9000.0]))
    assert np.allclose(np.sqrt(np.diag(cov[0])), [across, along, across])
    assert np.allclose(np.sqrt(np.diag(cov[1])), [across, across, along])
    assert across > 3 * along
    assert largest_sigma_mm(cov) == pytest.approx([across, across])


def test_total_station_and_own_numbers() -> None:
    along, across = TOTAL_STATION.sigmas_mm([10000.0])
    assert along[0] == pytest.approx(0.61)
    assert across[0] == pytest.approx(0.0985)
    assert NOISE_PRESETS["total-station"] is TOTAL_STATION
    own = NoiseModel.from_um(5.0, 0.15, 7.5, 3.0)
    assert own.sigmas_mm([9000.0])[1] == pytest.approx([0.0345])


def test_impossible_noise_is_refused() -> None:
    for numbers in ((0.0, 0.0, 1.0, 0.0), (1.0, -1.0, 1.0, 0.0), (float("nan"), 0.0, 1.0, 0.0)):
        with pytest.raises(BadArgument):
            NoiseModel(*numbers)
    with pytest.raises(BadArgument):
        LASER_TRACKER.covariance([[0.0, 0.0, 0.0]])
