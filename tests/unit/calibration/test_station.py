"""The station's pose from ERS points, and the reference check."""

import numpy as np
import pytest

from docking.calibration import locate_station, reference_shift, to_world
from docking.errors import NotCongruent, SigmaMissing, TooFewPoints
from docking.geometry import euler_to_matrix
from docking.pose import LASER_TRACKER
from docking.types import Points, Pose
from tests.support.nees import nees

X_WT = Pose(euler_to_matrix(0.01, -0.02, 2.1), np.array([500.0, -9000.0, 800.0]))
ERS = np.array(
    [[-6000, -5000, 0], [6000, -5000, 0], [7000, 4000, 0], [-7000, 4000, 0], [0, 6000, 1500], [0, -6500, 2500]],
    dtype=float,
)
NAMES = tuple(f"E{i + 1}" for i in range(6))


def nominal() -> Points:
    return Points(NAMES, ERS, np.broadcast_to(0.01**2 * np.eye(3), (6, 3, 3)))


def readings(rng: np.random.Generator, moved: Pose | None = None, sigma_nominal: float = 0.01) -> Points:
    at_T = X_WT.inverse().apply(ERS if moved is None else moved.apply(ERS))
    cov = LASER_TRACKER.covariance(at_T)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=(6, 3)))
    return Points(NAMES, at_T + noise + rng.normal(0, sigma_nominal, (6, 3)), cov)


def test_station_pose_is_t_to_w() -> None:
    fit = locate_station(nominal(), readings(np.random.default_rng(1)))
    assert np.allclose(fit.X_MN.t_mm, X_WT.t_mm, atol=0.2)
    assert np.allclose(fit.X_MN.R, X_WT.R, atol=2e-5)
    assert fit.names == NAMES
    assert np.max(np.abs(fit.pivot_mm)) < 7000


def test_its_covariance_is_honest() -> None:
    rng = np.random.default_rng(2)
    values = [nees(locate_station(nominal(), readings(rng)), X_WT) for _ in range(300)]
    assert np.mean(values) == pytest.approx(6.0, abs=4.5 * np.sqrt(12 / 300))


def test_a_disturbed_ers_point_is_left_out() -> None:
    r = readings(np.random.default_rng(3))
    xyz = r.xyz_mm.copy()
    xyz[2] += [0.0, 1.0, 0.0]
    fit = locate_station(nominal(), Points(r.names, xyz, r.cov_mm2))
    assert [x.name for x in fit.rejected] == ["E3"]
    with pytest.raises(NotCongruent):
        locate_station(nominal(), Points(r.names, np.random.default_rng(0).uniform(1000, 9000, (6, 3)), r.cov_mm2))


def test_to_world_turns_the_covariance() -> None:
    r = readings(np.random.default_rng(4))
    w = to_world(X_WT, r)
    assert np.allclose(w.xyz_mm, ERS, atol=0.3)
    assert np.allclose(np.linalg.eigvalsh(w.cov_mm2), np.linalg.eigvalsh(r.cov_mm2))
    sight = w.xyz_mm - X_WT.t_mm
    u = sight / np.linalg.norm(sight, axis=1)[:, None]
    along = np.sqrt(np.einsum("ni,nij,nj->n", u, w.cov_mm2, u))
    assert along == pytest.approx(LASER_TRACKER.sigmas_mm(np.linalg.norm(r.xyz_mm, axis=1))[0])


def three(rng: np.random.Generator, shift: np.ndarray, passes: int = 1) -> Points:
    rows = [readings(rng, Pose(np.eye(3), shift), 0.0) for _ in range(passes)]
    return Points(
        NAMES[:3] * passes, np.vstack([r.xyz_mm[:3] for r in rows]), np.concatenate([r.cov_mm2[:3] for r in rows])
    )


def test_an_unmoved_station_passes() -> None:
    rng = np.random.default_rng(5)
    moved = [
        reference_shift(X_WT, to_world(X_WT, readings(rng, None, 0.0)), three(rng, np.zeros(3))).moved
        for _ in range(1000)
    ]
    assert 0 < np.sum(moved) < 16


@pytest.mark.parametrize("shift", [[0.2, 0, 0], [0, 0.3, 0], [0, 0, -0.4]])
def test_a_bump_is_seen_and_measured(shift: list[float]) -> None:
    rng = np.random.default_rng(6)
    found = reference_shift(X_WT, to_world(X_WT, readings(rng, None, 0.0)), three(rng, np.array(shift), 2))
    assert found.moved
    assert np.allclose(found.common_mm, shift, atol=0.12)
    assert found.worst_mm > found.limit_mm
    assert found.names == NAMES[:3]
    assert found.shift_mm.shape == (3, 3)


def test_one_moved_point_is_seen() -> None:
    rng = np.random.default_rng(7)
    r = three(rng, np.zeros(3))
    xyz = r.xyz_mm.copy()
    xyz[1] += [0.0, 0.0, 0.5]
    found = reference_shift(X_WT, to_world(X_WT, readings(rng, None, 0.0)), Points(r.names, xyz, r.cov_mm2))
    assert found.moved
    assert found.worst_mm == pytest.approx(0.5, abs=0.2)


def test_too_few_or_unknown_references_refuse() -> None:
    rng = np.random.default_rng(8)
    known, r = to_world(X_WT, readings(rng)), three(rng, np.zeros(3))
    with pytest.raises(TooFewPoints):
        reference_shift(
            X_WT, known, Points(r.names[:2] * 2, np.tile(r.xyz_mm[:2], (2, 1)), np.tile(r.cov_mm2[:2], (2, 1, 1)))
        )
    with pytest.raises(SigmaMissing):
        reference_shift(X_WT, known, Points(r.names, r.xyz_mm, np.full((3, 3, 3), np.nan)))
    assert reference_shift(X_WT, known, Points(r.names, r.xyz_mm * np.nan, r.cov_mm2)).moved
