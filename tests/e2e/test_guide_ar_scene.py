"""A scene rendered by a program that is no part of this one: from its scan to poses judged against its truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest

from docking.errors import OverlayUncertain
from docking.guidance.images import pictures
from docking.guidance.input_files import read_layout
from docking.guidance.localiser import Localiser, LocaliseSettings
from docking.guidance.map_build import BuildRequest, Method, Scanned, place, scan
from docking.guidance.map_methods import MethodSettings
from docking.guidance.overlay import draw
from docking.guidance.scene import Scene
from docking.guidance.tracking import Tracker
from docking.guidance.trajectory import Trajectory, TrajectoryError, read_tum, trajectory_error
from docking.guidance.types import MarkerLayout
from tests.support.shared_data import shared_data


@cache
def scanned() -> tuple[Scanned, MarkerLayout]:
    """The free map of the scan, built once."""
    folder = shared_data("ar_scene")
    layout = read_layout(folder / "markers.csv")
    return scan(BuildRequest(folder / "scan", folder / "camera.toml", folder / "markers.csv"), layout), layout


@cache
def judged(method: Method, every: int) -> TrajectoryError:
    """Every so many-th test picture localised by the map alone, as a stream."""
    free, layout = scanned()
    tracker = Tracker(
        Localiser(place(free, layout, method, MethodSettings()), settings=LocaliseSettings(by_markers=False))
    )
    folder = shared_data("ar_scene")
    stamped = []
    for picture in islice(pictures(folder / "test"), 0, None, every):
        found = tracker.step(picture.name, picture.t_s, picture.image)
        assert found.source == "map"
        stamped.append((picture.t_s, found.X_WC))
    return trajectory_error(Trajectory.of(stamped), read_tum(folder / "truth_test.tum"))


def test_the_joint_map_is_right_to_three_millimetres_and_six_times_better_than_one_marker() -> None:
    joint, single = judged("joint", 6), judged("single-aruco", 6)
    assert joint.localised == single.localised == 10
    assert joint.ate_rmse_m <= 3.0e-3
    assert joint.max_m <= 6.0e-3
    assert single.ate_rmse_m <= 25e-3
    assert single.ate_rmse_m >= 6.0 * joint.ate_rmse_m


def test_markers_in_one_corner_promise_less_the_further_away() -> None:
    """The frame runs away from three markers of nine; what is drawn there would be off, and is refused in time."""
    free, layout = scanned()
    kept = (0, 1, 2)
    corner = replace(layout, ids=kept, circles_mm=layout.circles_mm[:3], sigma_mm=layout.sigma_mm[:3])
    localiser = Localiser(place(free, corner, "joint", MethodSettings()), settings=LocaliseSettings(by_markers=False))
    folder = shared_data("ar_scene")
    truth = read_tum(folder / "truth_test.tum")
    promised = []
    for picture in islice(pictures(folder / "test"), 4, None, 18):
        found = localiser.localise(picture.image)
        promised.append(found.predicted_error_mm())
        X_true = truth.pose(int(np.argmin(np.abs(truth.t_s - picture.t_s))))
        there = np.array([[0.0, 0.0, 1.0], [0.3, 0.2, 1.0], [-0.3, -0.2, 1.0]]) * found.depth_mm
        drawn = found.X_WC.inverse().apply(X_true.apply(there))
        off_mm = np.linalg.norm(drawn[:, :2] / drawn[:, 2:] - there[:, :2] / there[:, 2:], axis=1) * found.depth_mm
        assert np.max(off_mm) <= promised[-1]
    assert promised[0] < 4.0
    assert promised[-1] > 10.0
    scene = Scene(found.X_WC.apply(np.array([0.0, 0.0, found.depth_mm])), (), (), (), (), (), {})
    with pytest.raises(OverlayUncertain):
        draw(picture.image, found, scene, 10.0)


@pytest.mark.full
@pytest.mark.parametrize("method", ["joint", "published"])
def test_all_pictures_by_both_methods(method: Method) -> None:
    error, single = judged(method, 1), judged("single-aruco", 1)
    assert error.localised == error.frames == 60
    assert error.ate_rmse_m <= 3.0e-3
    assert single.ate_rmse_m >= 6.0 * error.ate_rmse_m
