"""The bundle adjustment against numbers from elsewhere: finite differences, SciPy's dense solver, known truths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from docking.geometry import exp_so3, log_so3
from docking.guidance.bundle import Bundle, adjust, camera_with
from docking.guidance.projection import linearise, project_rows
from docking.guidance.types import Camera
from docking.types import Array

CAMERA = Camera(960, 720, 800.0, 805.0, 480.0, 360.0, -0.02, 0.01, 0.001, -0.002, 0.003)


def _scene(frames: int, points: int, noise_px: float, seed: int = 0) -> Bundle:
    """A camera that walks along a bumpy wall; every point is seen by every frame whose image it falls in."""
    rng = np.random.default_rng(seed)
    P = np.c_[rng.uniform(-300.0, 300.0 + 60.0 * frames, points), rng.uniform(-300.0, 300.0, points)]
    P = np.c_[P, rng.uniform(600.0, 900.0, points)]
    R = np.array([exp_so3(rng.normal(0.0, 0.05, 3)) for _ in range(frames)])
    t = np.array([-R[i] @ [60.0 * i, rng.normal(0, 20.0), rng.normal(0, 20.0)] for i in range(frames)])
    rows, cols, pixels = [], [], []
    for i in range(frames):
        z = CAMERA.project(P @ R[i].T + t[i])
        seen = np.flatnonzero(np.all((z > 0.0) & (z < (960.0, 720.0)), axis=1))
        rows.append(np.full(len(seen), i))
        cols.append(seen)
        pixels.append(z[seen])
    frame, point = np.concatenate(rows), np.concatenate(cols)
    keep = (np.bincount(point, minlength=points) >= 2)[point]
    z = np.concatenate(pixels)[keep] + rng.normal(0.0, noise_px, (int(keep.sum()), 2))
    ones = np.ones(len(z))
    held = np.zeros(frames, bool)
    return Bundle(CAMERA, R, t, P, frame[keep], point[keep], z, ones, np.inf * ones, held)


def _disturbed(b: Bundle, angle: float = 0.003, shift: float = 4.0, seed: int = 1) -> Bundle:
    rng = np.random.default_rng(seed)
    free = ~b.held_frames
    R = np.array([exp_so3(rng.normal(0.0, angle, 3) * f) @ r for r, f in zip(b.R, free, strict=True)])
    t = b.t + rng.normal(0.0, shift, b.t.shape) * free[:, None]
    return replace(b, R=R, t=t, points=b.points + rng.normal(0.0, shift, b.points.shape))


def _gathered(b: Bundle) -> tuple[Array, Array, Array]:
    return b.R.transpose(1, 2, 0)[:, :, b.frame_rows], b.t.T[:, b.frame_rows], b.points.T[:, b.point_rows]


def test_derivatives_are_those_of_finite_differences() -> None:
    b = _scene(4, 200, 0.0)
    rows = linearise(CAMERA, *_gathered(b))
    here, depth = project_rows(CAMERA, *_gathered(b))
    assert np.allclose(here.T, b.pixels, atol=1e-9)
    assert depth.min() > 0.0
    step = 1e-6
    for i in range(3):
        d = np.eye(3)[i]
        turned = replace(b, R=exp_so3(d * step) @ b.R)
        shifted, moved = replace(b, t=b.t + 1e3 * step * d), replace(b, points=b.points + 1e3 * step * d)
        for other, size, column in (
            (turned, step, rows.by_frame[:, i]),
            (shifted, 1e3 * step, rows.by_frame[:, 3 + i]),
            (moved, 1e3 * step, rows.by_point[:, i]),
        ):
            slope = (project_rows(CAMERA, *_gathered(other))[0] - here) / size
            assert np.abs(slope - column).max() < 1e-4 * np.abs(slope).max()
    for k in range(5):
        slope = (project_rows(camera_with(CAMERA, np.eye(5)[k] * step), *_gathered(b))[0] - here) / step
        assert np.abs(slope - rows.by_camera[:, k]).max() < 1e-5 * np.abs(slope).max()


def test_it_ends_where_a_dense_solver_ends() -> None:
    b = _scene(4, 40, 0.5)
    b = _disturbed(replace(b, held_frames=np.array([True, True, False, False])))
    seen = np.unique(b.point_rows)

    def unpacked(x: Array) -> Bundle:
        points = b.points.copy()
        points[seen] = x[12:].reshape(-1, 3)
        R = np.array([*b.R[:2], exp_so3(x[:3]), exp_so3(x[6:9])])
        return replace(b, R=R, t=np.array([*b.t[:2], x[3:6], x[9:12]]), points=points)

    def residuals(x: Array) -> Array:
        other = unpacked(x)
        result: Array = (project_rows(CAMERA, *_gathered(other))[0].T - b.pixels).ravel()
        return result

    start = [log_so3(b.R[2]), b.t[2], log_so3(b.R[3]), b.t[3], b.points[seen].ravel()]
    other = least_squares(residuals, np.concatenate(start), method="trf", x_scale="jac", xtol=1e-12, ftol=1e-12)
    done = adjust(b, 50, 1e-10)
    assert done.cost == pytest.approx(2.0 * other.cost, rel=1e-6)
    assert np.allclose(done.points[seen], unpacked(other.x).points[seen], atol=1e-2)


def test_held_frames_stay_and_the_rest_finds_the_truth() -> None:
    truth = _scene(10, 400, 0.0)
    held = np.zeros(10, bool)
    held[[0, 5]] = True
    start = _disturbed(replace(truth, held_frames=held))
    done = adjust(start, 30, 1e-9)
    assert np.array_equal(done.R[held], truth.R[held])
    assert np.array_equal(done.t[held], truth.t[held])
    assert np.abs(done.t - truth.t).max() < 1e-3
    seen = np.unique(truth.point_rows)
    assert np.abs(done.points[seen] - truth.points[seen]).max() < 1e-2
    assert np.abs(done.residuals_px).max() < 1e-3


def test_one_wild_observation_moves_a_robust_adjustment_little() -> None:
    truth = _scene(6, 150, 0.3)
    held = np.zeros(6, bool)
    held[:2] = True
    wild = truth.pixels.copy()
    wild[::50] += 80.0
    robust = np.full(len(wild), 2.0)
    off = [
        np.abs(adjust(replace(truth, pixels=wild, held_frames=held, robust_at=limit), 30).t - truth.t).max()
        for limit in (robust, truth.robust_at)
    ]
    assert off[0] < 5.0
    assert off[1] > 4.0 * off[0]


def test_known_points_give_frame_and_scale_and_a_prior_lets_the_camera_move() -> None:
    truth = _scene(8, 300, 0.1)
    known = np.unique(truth.point_rows)[:12]
    wrong = replace(CAMERA, fx_px=802.0, fy_px=807.0, cx_px=482.0, k1=-0.026)
    bundle = replace(
        _disturbed(truth, 0.001, 2.0),
        camera=wrong,
        prior_rows=known,
        prior_points=truth.points[known],
        prior_sigma=np.full((12, 3), 0.1),
    )
    held = adjust(bundle, 30, 1e-6)
    moved = adjust(replace(bundle, camera_sigma=np.array([0.003, 3.0, 3.0, 0.01, 0.01])), 30, 1e-6)
    assert abs(moved.camera.fx_px - 800.0) < 1.3
    assert abs(moved.camera.cx_px - 480.0) < 1.0
    assert abs(moved.camera.k1 + 0.02) < 0.003
    assert moved.camera.fx_px / moved.camera.fy_px == pytest.approx(800.0 / 805.0, rel=1e-3)
    assert np.abs(moved.t - truth.t).max() < 0.5 * np.abs(held.t - truth.t).max()


def test_points_behind_a_camera_are_never_accepted() -> None:
    truth = _scene(4, 100, 0.2)
    held = np.array([True, True, False, False])
    start = _disturbed(replace(truth, held_frames=held), 0.02, 60.0)
    done = adjust(start, 40)
    _, depth = project_rows(CAMERA, *_gathered(replace(truth, R=done.R, t=done.t, points=done.points)))
    assert depth.min() > 0.0
