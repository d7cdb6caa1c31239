"""The INS error covariance and its correlation at the figures that were computed for it, and by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.tracking.choice import Uncertainty, ins_cov_mm2, largest_r, predicted_sd_mm
from docking.tracking.grades import GRADES

NONE = np.zeros((3, 3))
HOVER = np.array([0.0, 0.0, 9.80665])


def test_known_correlations() -> None:
    like = Uncertainty(1e-4 * np.eye(3), 1e-6 * np.eye(3), NONE)
    assert largest_r(ins_cov_mm2(np.eye(3), HOVER, like, 3.0)) == pytest.approx(0.0, abs=1e-12)
    tilted = Uncertainty(1e-4 * np.eye(3), NONE, np.diag([0.003**2, 0.003**2, 0.03**2]))
    S = ins_cov_mm2(np.eye(3), np.array([3.0, 2.0, 9.80665]), tilted, 3.0)
    assert np.sqrt(np.diag(S)) == pytest.approx([304.0, 428.0, 66.0], abs=8.0)
    assert S[0, 1] / np.sqrt(S[0, 0] * S[1, 1]) == pytest.approx(-0.84, abs=0.03)


def test_covariance_is_that_of_drawn_integrations() -> None:
    rng, draws, T, n = np.random.default_rng(1), 4000, 3.0, 60
    C = Rotation.from_euler("xyz", [0.5, 0.2, 1.0]).as_matrix()
    f = C.T @ np.array([1.0, -2.0, 9.80665])
    known = Uncertainty(np.diag([4e-4, 1e-4, 9e-4]), np.diag([1e-6, 4e-6, 1e-6]), np.diag([1e-5, 1e-5, 4e-5]))
    force = rng.normal(size=(draws, 3)) * np.sqrt(np.diag(known.force))
    rate = rng.normal(size=(draws, 3)) * np.sqrt(np.diag(known.rate))
    tilt = rng.normal(size=(draws, 3)) * np.sqrt(np.diag(known.attitude))
    v, s, dt = np.zeros((draws, 3)), np.zeros((draws, 3)), T / n
    for k in range(n):
        turned = tilt + (C @ rate.T).T * (k + 0.5) * dt
        a = (C @ force.T).T + np.cross(turned, C @ f)
        s, v = s + v * dt + 0.5 * a * dt * dt, v + a * dt
    drawn = np.cov(1000.0 * s.T)
    assert ins_cov_mm2(C, f, known, T) == pytest.approx(drawn, abs=0.07 * float(np.abs(drawn).max()))


def test_predicted_sizes_are_those_of_the_budget() -> None:
    decoupled, coupled = predicted_sd_mm(GRADES["mems"], 3.0)
    assert 5.0 < coupled < 20.0
    assert decoupled > 1.5 * coupled
