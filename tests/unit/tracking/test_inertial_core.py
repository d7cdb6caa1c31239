"""The blocks of the error-state filter against differences of the integration itself: a flipped sign fails here."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.tracking import inertial_core as core
from docking.types import Array

LAYOUT = core.Layout(core.Extras(0.01, 0.01, 0.01, 10.0))
STEP_S, SAMPLES = 0.0005, 20


def _start() -> core.Navigation:
    rng = np.random.default_rng(8)
    C = Rotation.from_euler("ZYX", [0.7, -0.3, 0.4]).as_matrix()
    return core.Navigation(
        0.0, rng.normal(0.0, 100.0, 3), rng.normal(0.0, 300.0, 3), C, rng.normal(0.0, 20.0, 3),
        rng.normal(0.0, 0.01, 3), 0.0, rng.normal(0.0, 0.01, (3, 3)), rng.normal(0.0, 0.01, (3, 3)), np.zeros(3),
    )  # fmt: skip


def _run(nav: core.Navigation) -> tuple[core.Navigation, core.Since]:
    since = core.NOTHING
    for k in range(SAMPLES):
        nav, since = core.integrate(nav, since, nav.t_s + STEP_S, FORCE * (1.0 + 0.01 * k), RATE)
    return nav, since


FORCE, RATE = np.array([900.0, -2000.0, 9500.0]), np.array([0.5, -0.8, 0.3])


def _difference(a: core.Navigation, b: core.Navigation) -> Array:
    """Error state that takes `a` to `b`."""
    d = np.zeros(LAYOUT.size)
    d[core.P], d[core.V] = b.p_mm - a.p_mm, b.v_mm_s - a.v_mm_s
    d[core.PHI] = Rotation.from_matrix(b.C_WI @ a.C_WI.T).as_rotvec()
    d[core.BA], d[core.BG] = b.force_bias_mm_s2 - a.force_bias_mm_s2, b.rate_bias - a.rate_bias
    assert LAYOUT.scale is not None
    assert LAYOUT.force_scale is not None
    d[LAYOUT.scale] = (b.scale - a.scale).ravel()
    d[LAYOUT.force_scale] = (b.force_scale - a.force_scale).ravel()
    return d


def test_transition_is_the_derivative_of_the_integration() -> None:
    start = _start()
    after, since = _run(start)
    from docking.tracking.grades import GRADES

    cov = np.eye(LAYOUT.size)
    phi, _ = core.Propagation(GRADES["mems"], LAYOUT)(cov, start.C_WI, after.C_WI, since)
    size = {0: 1.0, 3: 10.0, 6: 1e-4, 9: 10.0, 12: 1e-3}
    for column in range(LAYOUT.size):
        if LAYOUT.time is not None and column == LAYOUT.time.start:
            continue
        if LAYOUT.lever is not None and LAYOUT.lever.start <= column < LAYOUT.lever.stop:
            continue
        h = size.get(3 * (column // 3), 1e-3) if column < core.BASE else 1e-4
        dx = np.zeros(LAYOUT.size)
        dx[column] = h
        plus, minus = _run(start.moved(dx, LAYOUT))[0], _run(start.moved(-dx, LAYOUT))[0]
        numeric = (_difference(after, plus) - _difference(after, minus)) / (2.0 * h)
        largest = max(float(np.abs(numeric[6:]).max()), 1e-9)
        assert phi[6:, column] == pytest.approx(numeric[6:], abs=0.2 * largest), column
        for block in (core.P, core.V):
            scale = max(float(np.abs(numeric[block]).max()), 1e-6)
            assert phi[block, column] == pytest.approx(numeric[block], abs=0.2 * scale), column


def test_rows_of_a_point_are_the_derivative_of_its_place() -> None:
    nav = _start()
    arms = np.array([[300.0, -200.0, 150.0], [0.0, 400.0, -100.0]])
    turning = np.array([0.2, -0.4, 0.6])

    def places(n: core.Navigation) -> Array:
        here = (arms + n.lever_mm) @ n.C_WI.T
        return (n.p_mm + here + n.late_s * (n.v_mm_s + np.cross(turning, here))).ravel()

    rows = core.point_rows(nav, LAYOUT, arms @ nav.C_WI.T, turning)
    for column in range(LAYOUT.size):
        dx = np.zeros(LAYOUT.size)
        dx[column] = 1e-5
        numeric = (places(nav.moved(dx, LAYOUT)) - places(nav.moved(-dx, LAYOUT))) / 2e-5
        assert rows[:, column] == pytest.approx(numeric, abs=1e-3), column


def test_update_is_that_of_least_squares() -> None:
    """Prior and measurements as one linear system give the same estimate and covariance."""
    rng = np.random.default_rng(5)
    n, m = 15, 6
    a = rng.normal(size=(n, n))
    cov, rows, noise = a @ a.T + np.eye(n), rng.normal(size=(m, n)), np.diag(rng.uniform(0.5, 2.0, m))
    residual = rng.normal(size=m)
    dx, after = core.taken_in(cov, rows, residual, noise)
    information = np.linalg.inv(cov) + rows.T @ np.linalg.inv(noise) @ rows
    assert after == pytest.approx(np.linalg.inv(information), rel=1e-9, abs=1e-9)
    assert dx == pytest.approx(np.linalg.solve(information, rows.T @ np.linalg.inv(noise) @ residual), rel=1e-9)
