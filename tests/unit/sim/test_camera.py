"""The simulated camera shows things where they are: checked with equations that the renderer does not contain."""

from __future__ import annotations

import cv2
import numpy as np

from docking.types import Array, Pose
from sim.camera import Lens, Patch, SimulatedCamera
from sim.scenery import Marker, looking, marker_patch

LENS = Lens(640, 480, 530.0, 321.0, 237.0, k1=-0.08, k2=0.02, noise=0.0)
X_WC = looking(np.array([20.0, 10.0, 0.0]), np.array([-60.0, 40.0, 380.0]), 12.0)


def projected(points: Array) -> Array:
    """Pixels by OpenCV's own projection."""
    X_CW = X_WC.inverse()
    matrix = np.array([[LENS.f_px, 0, LENS.cx_px], [0, LENS.f_px, LENS.cy_px], [0, 0, 1.0]])
    distortion = np.array([LENS.k1, LENS.k2, 0, 0, 0])
    return cv2.projectPoints(points, cv2.Rodrigues(X_CW.R)[0], X_CW.t_mm, matrix, distortion)[0].reshape(-1, 2)


def test_circles_of_a_marker_are_where_they_are_projected() -> None:
    marker = Marker(3, Pose(np.eye(3), np.array([10.0, -5.0, 0.0])))
    picture = SimulatedCamera((marker_patch(marker),), LENS).picture(X_WC)
    for centre, expected in zip(marker.circles_mm, projected(marker.circles_mm), strict=True):
        # The rim of the circle in the picture, not its centre: its mean is the centre to a hundredth here.
        rim = centre + 9.0 * np.array(
            [[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 72, endpoint=False)]
        )
        pixels = projected(rim).mean(axis=0)
        x, y = np.round(expected).astype(int)
        window = 255.0 - picture[y - 20 : y + 21, x - 20 : x + 21].astype(float)
        rows, columns = np.mgrid[y - 20 : y + 21, x - 20 : x + 21]
        dark = np.where(
            np.hypot(rows - expected[1], columns - expected[0]) < 17.0, np.clip(window - 40.0, 0.0, None), 0.0
        )
        seen = np.array([np.sum(columns * dark), np.sum(rows * dark)]) / dark.sum()
        assert np.linalg.norm(seen - pixels) < 0.15


def test_the_marker_is_read_the_right_way_round() -> None:
    marker = Marker(5, Pose(np.eye(3), np.zeros(3)))
    picture = SimulatedCamera((marker_patch(marker),), LENS).picture(X_WC)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    corners, ids, _ = detector.detectMarkers(picture)
    assert ids.ravel().tolist() == [5]
    upper_left = projected(np.array([[-25.0, 25.0, 0.1]]))[0]
    assert np.linalg.norm(corners[0].reshape(4, 2)[0] - upper_left) < 1.0


def test_the_nearer_patch_covers_the_farther_and_backs_are_not_seen() -> None:
    def plate(z: float, shade: int, flip: float = 1.0) -> Patch:
        texture = np.full((50, 50), shade, np.uint8)
        start = np.array([-50.0 * flip, 50.0, z])
        return Patch(start, np.array([100.0 * flip, 0.0, 0.0]), np.array([0.0, -100.0, 0.0]), texture)

    eye = looking(np.zeros(3), np.array([0.0, 0.0, 500.0]))
    straight = Lens(64, 48, 60.0, 31.5, 23.5, noise=0.0)
    near, far = plate(60.0, 200), plate(0.0, 100)
    for order in ((near, far), (far, near)):
        assert SimulatedCamera(order, straight).picture(eye)[24, 32] == 200
    assert SimulatedCamera((far, plate(60.0, 200, -1.0)), straight).picture(eye)[24, 32] == 100


def test_noise_is_that_of_its_seed() -> None:
    lens = Lens(64, 48, 60.0, 31.5, 23.5, noise=4.0)
    a, b, c = (SimulatedCamera((), lens, seed).picture(X_WC).astype(float) for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert abs(float(np.std(a)) - 4.0) < 0.3
