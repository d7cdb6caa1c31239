"""An expansion that the fits found stands in the scene of a move and in its correction, about the right points."""

from __future__ import annotations

import numpy as np
import pytest

from docking.approach import Approach, Station
from docking.geometry import euler_to_matrix
from docking.planning import ConvergenceSettings, displaced
from docking.pose import Features
from docking.types import Fit, Pose

FACE = np.array([[4000.0, 2000.0, 0.0], [4000.0, -2000.0, 0.0], [4000.0, 0.0, 2000.0], [4000.0, 0.0, -2000.0]])
CENTRE = np.array([4000.0, 0.0, 0.0])
TURN = euler_to_matrix(0.0, 0.0, 0.4)


def fit(X: Pose, expansion: float, pivot_W: np.ndarray) -> Fit:
    return Fit(
        X, np.zeros((6, 6)), pivot_W, (), np.zeros((0, 3)), 0.0, 0.0, "ml", 1, 0.0, 0,
        expansion=expansion, expansion_cov=np.zeros(7),
    )  # fmt: skip


@pytest.mark.parametrize(("part", "mate"), [(0.0, 0.0), (60e-6, 0.0), (0.0, 60e-6), (50e-6, 80e-6)])
def test_faces_meet_where_the_grown_parts_have_them(part: float, mate: float) -> None:
    """The gap of the scene is the stand-off and nothing else, and the correction takes the grown face to the mate's."""
    small = np.full(4, 0.01)
    features = Features(("A", "B", "C", "D"), FACE, FACE - CENTRE, small, small, np.full(4, 0.2))
    stations = (Station("near", 30.0, 1.0, ()), Station("dock", 0.0, 1.0, ()))
    one = Approach(features, 0.0, 0.0, np.array([1.0, 0, 0]), CENTRE, stations, ConvergenceSettings())
    there = Pose(TURN, np.array([9000.0, 3000.0, 2500.0]))
    here = Pose(TURN, there.apply([-4100.0, 3.0, -2.0]))
    component = fit(here, part, here.apply([-1500.0, -400.0, 300.0]))
    other = fit(there, mate, there.apply([4000.0, 500.0, 0.0]))
    scene = one.scene(component, other, stations[0])
    assert np.allclose(scene.X_WC.apply(CENTRE), component.predict(CENTRE), atol=1e-9)
    assert np.allclose(scene.X_WM.apply(np.zeros(3)), other.predict(np.zeros(3)), atol=1e-3)
    assert np.allclose(scene.X_WG.apply(CENTRE), scene.X_WM.apply(np.zeros(3)), atol=1e-3)
    landed = displaced(one.correction(component, other, stations[1]), component.predict(CENTRE))
    assert np.allclose(landed, other.predict(np.zeros(3)), atol=1e-6)
