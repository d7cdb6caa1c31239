"""Trajectory errors are those of evo on its own test data, and each part of the figure can be broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import BadTrajectory, DegenerateTrajectory
from docking.guidance.trajectory import Alignment, Trajectory, error_json, read_tum, trajectory_error, write_tum
from docking.types import Pose
from tests.support.shared_data import shared_data

EVO: tuple[tuple[str, Alignment, float], ...] = (
    ("fr2_desk_ORB.txt", "none", 3.173994),
    ("fr2_desk_ORB.txt", "se3", 0.008119),
    ("fr2_desk_ORB_kf_mono.txt", "sim3", 0.007729),
)


def spiral(n: int = 40, shift: float = 0.0) -> Trajectory:
    """A path in three directions, 10 Hz."""
    a = np.linspace(0.0, 6.0, n)
    poses = [
        (
            k / 10.0 + shift,
            Pose(Rotation.from_rotvec([0.1 * x, 0.2, -x]).as_matrix(), np.array([9 * np.cos(x), x * x, x])),
        )
        for k, x in enumerate(a)
    ]
    return Trajectory.of(poses)


@pytest.mark.parametrize(("name", "align", "printed"), EVO)
def test_figures_of_evo(name: str, align: Alignment, printed: float) -> None:
    """What evo prints for its own data, to its last digit."""
    folder = shared_data("evo_fr2_desk")
    error = trajectory_error(read_tum(folder / name), read_tum(folder / "fr2_desk_groundtruth.txt"), align)
    assert error.ate_rmse_m == pytest.approx(printed, abs=1e-6)


def test_a_shifted_path_is_off_by_the_shift_and_aligned_to_nothing() -> None:
    true = spiral()
    moved = Trajectory(true.t_s, true.R, true.t_mm + np.array([3.0, 4.0, 0.0]))
    assert trajectory_error(moved, true).ate_rmse_m == pytest.approx(5e-3)
    assert trajectory_error(moved, true, "se3").ate_rmse_m < 1e-12


def test_a_scale_is_an_error_until_it_is_fitted() -> None:
    true = spiral()
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    scaled = Trajectory(true.t_s, true.R, 0.5 * true.t_mm @ R.T + (1.0, 2.0, 3.0))
    assert trajectory_error(scaled, true, "se3").ate_rmse_m > 1e-3
    fitted = trajectory_error(scaled, true, "sim3")
    assert fitted.ate_rmse_m < 1e-12
    assert fitted.scale == pytest.approx(2.0)


def test_a_mirrored_path_cannot_be_aligned_away() -> None:
    true = spiral()
    mirrored = Trajectory(true.t_s, true.R, true.t_mm * (1.0, 1.0, -1.0))
    assert trajectory_error(mirrored, true, "sim3").ate_rmse_m > 1e-4


def test_frames_that_are_missing_are_counted() -> None:
    true = spiral()
    some = Trajectory(true.t_s[::4], true.R[::4], true.t_mm[::4])
    error = trajectory_error(some, true)
    assert (error.frames, error.localised, error.poses) == (40, 10, 10)
    assert set(error_json(error)) >= {"ate_rmse_m", "median", "max", "frames", "localised"}


def test_moments_further_apart_than_a_hundredth_are_others() -> None:
    assert trajectory_error(spiral(shift=0.009), spiral()).localised == 40
    with pytest.raises(DegenerateTrajectory):
        trajectory_error(spiral(shift=0.03), spiral())


def test_a_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    true = spiral()
    write_tum(true, tmp_path / "a.tum")
    again = read_tum(tmp_path / "a.tum")
    assert np.allclose(again.t_mm, true.t_mm, atol=1e-5)
    assert np.allclose(again.R, true.R, atol=1e-8)
    first = (tmp_path / "a.tum").read_text().splitlines()[1].split()
    assert float(first[1]) == pytest.approx(9e-3)  # metres


@pytest.mark.parametrize("line", ["1 2 3", "0 0 0 0 0 0 0 2", "0 nan 0 0 0 0 0 1", "a b c d e f g h"])
def test_a_bad_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text("0.0 0 0 0 0 0 0 1\n" + line + "\n")
    with pytest.raises(BadTrajectory, match="line 2"):
        read_tum(path)
