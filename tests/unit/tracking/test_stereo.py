"""A camera pair: points come back exactly, their covariance is that of many draws, what cannot be seen is no point."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from docking.errors import BadArgument
from docking.tracking.stereo import StereoCamera, triangulate
from docking.types import Array, Pose

cv2 = pytest.importorskip("cv2")
BENT = np.array([-0.11, 0.05, 0.002, -0.001, 0.01])
POINTS = np.array([[0.0, 0.0, 0.0], [400.0, -200.0, 150.0], [-500.0, 100.0, -120.0], [120.0, 300.0, 80.0]])


def camera(name: str, place: tuple[float, float, float], sigma: float = 0.3) -> StereoCamera:
    """Looks at the origin with its y axis downwards."""
    ahead = -np.array(place) / np.linalg.norm(place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(ahead, right), ahead])
    return StereoCamera(
        name, np.array([1400.0, 1390.0]), np.array([960.0, 600.0]), BENT, Pose(R, np.array(place)), sigma
    )


LEFT, RIGHT = camera("left", (-900.0, -3000.0, 500.0)), camera("right", (900.0, -2900.0, 700.0), 0.2)


def opencv_pixels(one: StereoCamera, points: Array) -> Array:
    """Projection by another program."""
    to_K = one.X_WK.inverse()
    matrix = np.array([[one.focal_px[0], 0, one.centre_px[0]], [0, one.focal_px[1], one.centre_px[1]], [0, 0, 1.0]])
    rotvec = Rotation.from_matrix(to_K.R).as_rotvec()
    pixels, _ = cv2.projectPoints(points, rotvec, to_K.t_mm, matrix, one.distortion)
    return np.asarray(pixels.reshape(-1, 2))


def test_points_come_back_from_the_pixels_that_opencv_gives() -> None:
    found = triangulate(LEFT, RIGHT, (opencv_pixels(LEFT, POINTS), opencv_pixels(RIGHT, POINTS)))
    assert_allclose(found.xyz_W_mm, POINTS, atol=1e-5)
    assert found.chi2.max() < 1e-6


def test_covariance_is_that_of_many_draws() -> None:
    rng = np.random.default_rng(4)
    draws = 4000
    clean = [np.tile(one.project(POINTS)[0], (draws, 1)) for one in (LEFT, RIGHT)]
    noisy = [p + one.pixel_sigma * rng.standard_normal(p.shape) for p, one in zip(clean, (LEFT, RIGHT), strict=True)]
    found = triangulate(LEFT, RIGHT, (noisy[0], noisy[1]))
    error = (found.xyz_W_mm - np.tile(POINTS, (draws, 1))).reshape(draws, len(POINTS), 3)
    for i in range(len(POINTS)):
        stated = found.cov_mm2[i]
        drawn = np.cov(error[:, i].T)
        white = np.linalg.solve(np.linalg.cholesky(stated), error[:, i].T)
        assert_allclose(np.cov(white), np.eye(3), atol=0.12)
        assert np.sqrt(drawn[1, 1]) > 1.2 * np.sqrt(drawn[0, 0])  # the distance is what a pair knows least
    assert np.mean(found.chi2) == pytest.approx(1.0, abs=0.05)


def test_lost_in_either_camera_is_no_point_and_rays_that_miss_are_refused() -> None:
    left, right = LEFT.project(POINTS)[0], RIGHT.project(POINTS)[0]
    left[1], right[2] = np.nan, np.nan
    right[3, 1] += 10.0  # another thing was followed: off the epipolar line
    found = triangulate(LEFT, RIGHT, (left, right))
    assert np.isfinite(found.xyz_W_mm).all(axis=1).tolist() == [True, False, False, True]
    assert found.agreeing().tolist() == [True, False, False, False]


def test_points_behind_a_camera_and_cameras_at_one_place() -> None:
    left, right = LEFT.project(POINTS)[0], RIGHT.project(POINTS)[0]
    assert not np.isfinite(triangulate(LEFT, RIGHT, (right[:, ::-1] * [-1.0, 1.0], left)).xyz_W_mm).any()
    with pytest.raises(BadArgument, match="one place"):
        triangulate(LEFT, camera("again", (-900.0, -3000.0, 500.0)), (left, left))
