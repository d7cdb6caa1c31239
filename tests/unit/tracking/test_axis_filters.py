"""The small filters against filterpy on the same matrices, and their noise against van Loan's exponential."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.linalg import expm

from docking.tracking.axis_filters import (
    BiasFilters,
    ThreeStateFilters,
    drift_noise,
    polynomial_noise,
    transition,
)
from docking.types import Array

STEPS = 400


def van_loan(drive: Array, dt: float) -> Array:
    """Q of x' = F x + drive noise for the integrator chain, by the exponential of the doubled system."""
    F = np.diag([1.0, 1.0], 1)
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:], block[3:, 3:] = -F, drive, F.T
    E = expm(block * dt)
    return E[3:, 3:].T @ E[:3, 3:]


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.5])
def test_noise_is_that_of_the_continuous_model(dt: float) -> None:
    assert polynomial_noise(dt, 7.0) == pytest.approx(van_loan(np.diag([0.0, 0.0, 7.0]), dt), rel=1e-9, abs=1e-18)
    whole = van_loan(np.diag([0.0, 9.0, 0.0]), dt) + np.diag([0.0, 0.0, 5.0 * dt])
    assert drift_noise(dt, 3.0, 5.0) == pytest.approx(whole, rel=1e-9, abs=1e-18)
    assert transition(dt) == pytest.approx(expm(np.diag([1.0, 1.0], 1) * dt), rel=1e-12)


@pytest.mark.parametrize("kind", ["position", "errors"])
def test_three_states_equal_filterpy(kind: str) -> None:
    rng = np.random.default_rng(3)
    dts = rng.choice([0.02, 0.021, 0.005], STEPS)
    q = (lambda dt: polynomial_noise(dt, 50.0)) if kind == "position" else (lambda dt: drift_noise(dt, 1.0, 4.0))
    cov0 = np.diag([1.0, 100.0, 25.0])
    mine = ThreeStateFilters(np.zeros((3, 2)), cov0, q)
    peers = []
    for _ in range(2):
        peer = KalmanFilter(dim_x=3, dim_z=1)
        peer.x, peer.P, peer.H = np.zeros((3, 1)), cov0.copy(), np.array([[1.0, 0.0, 0.0]])
        peers.append(peer)
    for dt in dts:
        z, seen, var = rng.normal(0.0, 10.0, 2), rng.random(2) > 0.3, rng.uniform(0.5, 2.0, 2)
        mine.predict(float(dt))
        mine.update(z, var, seen)
        for k, peer in enumerate(peers):
            peer.predict(F=transition(dt), Q=q(dt))
            if seen[k]:
                peer.update(np.array([[z[k]]]), R=np.array([[var[k]]]))
    for k, peer in enumerate(peers):
        assert mine.x[:, k] == pytest.approx(peer.x[:, 0], rel=1e-12, abs=1e-12 * float(np.abs(peer.x).max()))
        assert mine.cov(k) == pytest.approx(peer.P, rel=1e-12, abs=1e-12 * float(np.abs(peer.P).max()))


def test_bias_filter_equals_filterpy() -> None:
    rng = np.random.default_rng(4)
    mine = BiasFilters(1, 900.0, 0.3)
    peer = KalmanFilter(dim_x=1, dim_z=1)
    peer.x, peer.P = np.zeros((1, 1)), np.array([[900.0]])
    for k in range(1, STEPS):
        t, z = 0.02 * k, float(rng.normal(0.0, 5.0))
        mine.step(0.02, t, np.array([z]), np.array([1.0]), np.array([True]))
        peer.predict(F=np.eye(1), Q=np.array([[0.3 * 0.02]]))
        peer.update(np.array([[z]]), R=np.eye(1), H=np.array([[0.5 * t * t]]))
    assert mine.b[0] == pytest.approx(peer.x[0, 0], rel=1e-12)
    assert mine.p[0] == pytest.approx(peer.P[0, 0], rel=1e-12)


def test_bias_has_the_sign_of_ins_minus_image() -> None:
    """A sensor that reads 30 mm/s^2 too much runs ahead of the image by b t^2 / 2."""
    mine = BiasFilters(1, 900.0, 0.0)
    for k in range(1, 200):
        t = 0.02 * k
        mine.step(0.02, t, np.array([15.0 * t * t]), np.array([1.0]), np.array([True]))
    assert mine.b[0] == pytest.approx(30.0, rel=1e-3)


def test_a_hidden_channel_only_predicts() -> None:
    mine = ThreeStateFilters(np.array([[1.0], [2.0], [0.5]]), np.eye(3), lambda dt: drift_noise(dt, 1.0, 1.0))
    mine.predict(0.1)
    mine.update(np.array([np.nan]), 1.0, np.array([False]))
    assert mine.x[:, 0] == pytest.approx([1.2025, 2.05, 0.5])
