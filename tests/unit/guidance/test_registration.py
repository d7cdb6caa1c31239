"""A device that tracks itself: its world is found in the cell from pairs of poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import DevicePairsDisagree
from docking.geometry import rotation_angle
from docking.guidance.registration import OPENGL_TO_OPENCV, DevicePair, register
from docking.types import Pose

X_WD = Pose(Rotation.from_rotvec([0.2, 1.1, -0.4]).as_matrix(), np.array([1500.0, -400.0, 900.0]))


def pairs(n: int, seed: int, noise_mm: float = 1.0, scale: float = 1.0) -> list[DevicePair]:
    """Poses of a walk of a metre, in the device's world and, with noise, in the cell."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        X_DK = Pose(Rotation.from_rotvec(rng.normal(0.0, 0.4, 3)).as_matrix(), rng.uniform(-500.0, 500.0, 3))
        X_WK = X_WD @ Pose(X_DK.R, scale * X_DK.t_mm)
        turn = Rotation.from_rotvec(rng.normal(0.0, 1e-3, 3)).as_matrix()
        found.append(DevicePair(Pose(turn @ X_WK.R, X_WK.t_mm + rng.normal(0.0, noise_mm, 3)), X_DK))
    return found


def test_the_world_of_the_device_is_found() -> None:
    result = register(pairs(12, 1))
    assert np.linalg.norm(result.X_WD.t_mm - X_WD.t_mm) < 1.5
    assert rotation_angle(result.X_WD.R.T @ X_WD.R) < 1.5e-3
    assert len(result.used) == 12
    assert result.scale == pytest.approx(1.0, abs=5e-3)


def test_wrong_pairs_are_named_and_do_not_count() -> None:
    given = pairs(12, 2)
    for k in (1, 5, 8):
        wrong = given[k].X_WK @ Pose(Rotation.from_rotvec([0.0, 0.6, 0.0]).as_matrix(), np.array([200.0, 0.0, 50.0]))
        given[k] = DevicePair(wrong, given[k].X_DK)
    result = register(given)
    assert result.rejected == (1, 5, 8)
    assert np.linalg.norm(result.X_WD.t_mm - X_WD.t_mm) < 2.0


def test_a_device_whose_metre_is_too_long_shows_it() -> None:
    assert register(pairs(12, 3, scale=0.98)).scale == pytest.approx(0.98, abs=5e-3)


def test_too_few_or_scattered_pairs_are_refused() -> None:
    with pytest.raises(DevicePairsDisagree):
        register(pairs(2, 4))
    rng = np.random.default_rng(5)
    scattered = [
        DevicePair(
            Pose(Rotation.random(random_state=int(rng.integers(1e6))).as_matrix(), rng.uniform(-900, 900, 3)), p.X_DK
        )
        for p in pairs(8, 5)
    ]
    with pytest.raises(DevicePairsDisagree):
        register(scattered)


def test_axes_of_other_devices() -> None:
    """A point above and before a camera whose y is up and z backward is above and before ours."""
    assert np.allclose(OPENGL_TO_OPENCV @ [0.0, 1.0, -2.0], [0.0, -1.0, 2.0])
