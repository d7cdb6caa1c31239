"""A difference of the two faces told as what is wrong with the instrument."""

import numpy as np
import pytest

from docking.calibration.two_face import face_errors
from docking.pose import LASER_TRACKER
from docking.types import Array

POINT = np.array([3000.0, -6000.0, 1500.0])
COV = 2.0 * LASER_TRACKER.covariance(POINT)[0]


def polar(azimuth: float, height: float, distance: float) -> Array:
    flat = distance * np.cos(height)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(height)])


def seen(left: float, high: float, far: float, face: int) -> Array:
    """The point as one face reads it: errors of the directions change their signs in face 2."""
    azimuth, distance = float(np.arctan2(POINT[1], POINT[0])), float(np.linalg.norm(POINT))
    height, sign = float(np.arcsin(POINT[2] / distance)), 1.0 if face == 1 else -1.0
    return polar(azimuth + sign * left / np.cos(height), height + sign * high, distance + (far if face == 1 else 0.0))


@pytest.mark.parametrize(
    ("left", "high", "far", "said"),
    [
        (40e-6, 0.0, 0.0, "collimation beyond"),
        (0.0, -50e-6, 0.0, "height index beyond"),
        (-40e-6, 60e-6, 0.0, "collimation and height index beyond"),
        (0.0, 0.0, 0.08, "distance beyond"),
        (2e-6, 1e-6, 0.001, "within the noise"),
    ],
)
def test_each_error_is_told_by_its_name_size_and_sign(left: float, high: float, far: float, said: str) -> None:
    found = face_errors(seen(left, high, far, 1), seen(left, high, far, 2), COV)
    assert found.collimation_rad == pytest.approx(left, abs=1e-8)
    assert found.index_rad == pytest.approx(high, abs=1e-8)
    assert found.range_mm == pytest.approx(far, abs=1e-5)
    assert said in found.words()
    assert f"collimation {left * 1e6:+.3g} urad" in found.words() or abs(left) < 1e-8


def test_the_sigma_is_that_of_the_noise() -> None:
    rng, root = np.random.default_rng(1), np.linalg.cholesky(COV / 2.0)
    found = [
        face_errors(POINT + root @ rng.normal(size=3), POINT + root @ rng.normal(size=3), COV) for _ in range(2000)
    ]
    assert np.std([f.collimation_rad for f in found]) == pytest.approx(found[0].sigma_rad, rel=0.08)
    assert np.std([f.index_rad for f in found]) == pytest.approx(found[0].sigma_rad, rel=0.08)
    assert np.std([f.range_mm for f in found]) == pytest.approx(found[0].range_sigma_mm, rel=0.08)
    assert np.mean(["within the noise" in f.words() for f in found]) > 0.98


def test_a_point_overhead_and_a_reading_that_is_no_number_have_words_too() -> None:
    top = np.array([0.0, 0.0, 4000.0])
    aside = np.array([0.0, 0.3, 0.0])
    found = face_errors(top + aside, top - aside, COV)
    assert np.hypot(found.collimation_rad, found.index_rad) == pytest.approx(0.3 / 4000.0, rel=1e-6)
    assert "beyond" in face_errors(top * np.nan, top, COV).words()
