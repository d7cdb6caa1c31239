"""RC-3 with D.Z holding 13.4 kN: reactions, extremes, sink, internal force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from docking.kinematics import Positioners, ball_reactions_n, reaction_extremes, sink_mm
from docking.kinematics.forces import internal_force_matrix
from docking.types import Pose
from tests.reference_geometry import AXES, BALLS, LOAD, rc1, rc3

D_Z = AXES.index("D.Z")
HELD_N, TOLERANCE_N = 13400.0, 268.0
WEIGHT = np.array([0.0, 0.0, -6000.0 * 9.80665])


def follower(held_n: float = HELD_N, tolerance_n: float = TOLERANCE_N) -> Positioners:
    held, tolerance = np.zeros(12), np.zeros(12)
    held[D_Z], tolerance[D_Z] = held_n, tolerance_n
    return replace(rc3(d_z_driven=False), held_n=held, held_tolerance_n=tolerance)


def up_n(positioners: Positioners, com_mm: list[float]) -> np.ndarray:
    forces: np.ndarray = ball_reactions_n(positioners, BALLS, np.array(com_mm), WEIGHT)[0]
    moment = np.cross(BALLS - np.array(com_mm), forces).sum(axis=0)
    assert_allclose(forces.sum(axis=0), -WEIGHT, atol=1e-6)
    assert_allclose(moment, 0.0, atol=1e-3)
    return forces[:, 2]


def test_reactions_are_those_of_four_carrying_axes() -> None:
    """A 10.1 B 16.0 C 19.3 D 13.4 kN, and without the force the part nearly tips: 23.5, 2.6, 32.7, 0."""
    assert_allclose(up_n(follower(), [600.0, 200.0, 0.0]), [10136.0, 16018.0, 19286.0, 13400.0], atol=5.0)
    free = up_n(rc3(d_z_driven=False), [600.0, 200.0, 0.0])
    assert_allclose(free / 1000.0, [23.5, 2.6, 32.7, 0.0], atol=0.05)


def test_the_held_ball_keeps_its_force_and_the_others_share_the_rest_by_statics() -> None:
    """A, on the side of D, is told by D alone: weight that moves across goes from B to C."""
    centred, aside = up_n(follower(), [0.0, 0.0, 0.0]), up_n(follower(), [0.0, 400.0, 0.0])
    assert aside[3] == pytest.approx(centred[3]) == HELD_N
    moved = np.linalg.norm(WEIGHT) * 400.0 / 3600.0
    assert_allclose(aside - centred, [0.0, -moved, moved, 0.0], atol=1e-6)
    stronger = up_n(follower(HELD_N + 1000.0), [0.0, 0.0, 0.0])
    assert_allclose(stronger - centred, [-1000.0, 1000.0, -1000.0, 1000.0], atol=1e-6)


def test_extremes_cover_the_tolerance_of_the_force_and_the_lightest_part() -> None:
    load = replace(LOAD, mass_tolerance_kg=60.0)
    exact, wide = (reaction_extremes(follower(HELD_N, t), Pose.identity(), load) for t in (0.0, TOLERANCE_N))
    assert_allclose(exact.least_up_n - wide.least_up_n, TOLERANCE_N, atol=1e-6)
    assert wide.peak_axis_n[D_Z] == pytest.approx(HELD_N + TOLERANCE_N)
    light = up_n(follower(), [600.0, 200.0, 0.0])[0] - 0.4 * 60.0 * 9.80665
    assert exact.least_up_n[0] == pytest.approx(light, abs=1.0)
    heaviest = reaction_extremes(rc1(), Pose.identity(), load)
    assert heaviest.least_up_n[0] == pytest.approx(10136.0 * 1.01, rel=1e-3), "without followers the heaviest counts"


@pytest.mark.parametrize(("held_n", "ball"), [(25000.0, 0), (0.0, 3)])
def test_a_force_that_lifts_another_ball_off_is_seen(held_n: float, ball: int) -> None:
    found = reaction_extremes(follower(held_n, 0.0), Pose.identity(), LOAD)
    assert int(np.argmin(found.least_share)) == ball
    assert found.least_share[ball] < 0.1


def test_a_held_force_gives_no_internal_force_and_sinks_as_a_driven_axis() -> None:
    matrix = internal_force_matrix(follower(), BALLS)
    assert_allclose(matrix[:, D_Z], 0.0, atol=1e-9)
    assert_allclose(matrix[D_Z], 0.0, atol=1e-9)
    reactions = ball_reactions_n(follower(), BALLS, LOAD.com_C_mm, WEIGHT)[0]
    assert_allclose(sink_mm(follower(), reactions)[3], [0.0, 0.0, -HELD_N / 20000.0], atol=1e-9)


def test_an_axis_holds_a_position_or_a_force() -> None:
    held = np.zeros(12)
    held[D_Z] = HELD_N
    with pytest.raises(ValueError, match="not both"):
        replace(rc3(), held_n=held)
    assert follower().followers.nonzero()[0].tolist() == [D_Z]
    assert follower().powered.sum() == 7
