"""Lift and level: straight up, the shortest rotation to level, and what the load cells then say of the part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from docking.errors import LoadCellSilent, LoadUnexpected
from docking.kinematics import Load, axis_forces_n, ball_reactions_n
from docking.planning import displaced, moved_pose
from docking.planning.load_check import check_load, find_load
from docking.planning.raising import Raising, level_pivot_C_mm
from docking.planning.relief import LoadCellErrors, Weighing
from docking.types import Pose
from tests.reference_geometry import BALLS, FACE, LOAD, crooked_axes, rc1

UP = np.array([0.0, 0.0, 1.0])
RAISING = Raising(20.0, True, 5.0, UP, UP, level_pivot_C_mm(BALLS, FACE, UP))
CELLS = LoadCellErrors(np.full(12, 50000.0), crosstalk=0.0, drift_per_h=0.0, resolution_n=0.0)


def tilted(x_deg: float, y_deg: float, z_deg: float = 0.0) -> Pose:
    return Pose(
        Rotation.from_euler("xyz", [x_deg, y_deg, z_deg], degrees=True).as_matrix(), np.array([100.0, -50, 900])
    )


def test_the_lift_goes_against_gravity_whatever_the_attitude() -> None:
    X = tilted(3.0, -2.0, 40.0)
    np.testing.assert_allclose(moved_pose(X, RAISING.lift(X)).t_mm - X.t_mm, [0.0, 0.0, 20.0], atol=1e-12)
    down_x = replace(RAISING, up_W=np.array([-1.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved_pose(X, down_x.lift(X)).t_mm - X.t_mm, [-20.0, 0.0, 0.0], atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-170, 170))
def test_levelling_leaves_no_tilt_and_keeps_the_heading(x_deg: float, y_deg: float, z_deg: float) -> None:
    X = tilted(x_deg, y_deg, z_deg)
    turn = RAISING.levelling(X)
    after = moved_pose(X, turn)
    np.testing.assert_allclose(after.R @ UP, UP, atol=1e-12)
    assert RAISING.tilt_rad(after) < 1e-9
    assert RAISING.tilt_rad(X) == pytest.approx(np.arccos(np.clip(X.R[2, 2], -1, 1)), abs=2e-8)
    assert abs(turn.rotvec_rad @ UP) < 1e-12, "no rotation about the vertical"
    np.testing.assert_allclose(after.apply(RAISING.pivot_C_mm), X.apply(RAISING.pivot_C_mm), atol=1e-9)


def test_levelling_about_the_middle_moves_the_face_neither_to_the_mate_nor_the_balls_far() -> None:
    """0.5 deg of pitch: about the face's centre the rear balls would go 61 mm, so they go 26; the gap stays."""
    X = Pose(Rotation.from_euler("y", 0.5, degrees=True).as_matrix(), np.zeros(3))
    turn = RAISING.levelling(X)
    balls = X.apply(BALLS)
    assert np.abs(displaced(turn, balls) - balls)[:, 2].max() == pytest.approx(26.2, abs=0.1)
    face = X.apply(FACE)
    assert abs((displaced(turn, face) - face)[0]) < 0.2


def test_a_job_that_docks_inclined_is_level_when_it_is_as_inclined() -> None:
    docked = tilted(4.0, 0.0)
    leaning = replace(RAISING, up_C=docked.R.T @ UP)
    assert leaning.tilt_rad(docked) < 1e-9
    assert leaning.tilt_rad(tilted(0.0, 0.0)) == pytest.approx(np.radians(4.0))


def weighed(load: Load, X: Pose, seed: int = 0, extra_z: tuple[float, ...] = (0, 0, 0, 0)) -> tuple[Weighing, object]:
    positioners = rc1(crooked_axes(seed))
    balls = X.apply(positioners.balls_C_mm)
    forces = ball_reactions_n(positioners, balls, X.apply(load.com_C_mm), load.mass_kg * load.gravity_m_s2)[0]
    forces = forces + np.outer(extra_z, UP)
    return Weighing(np.zeros(12), axis_forces_n(positioners, forces), np.zeros(12)), positioners


JOB = replace(LOAD, mass_tolerance_kg=60.0, com_tolerance_mm=np.array([30.0, 30.0, 50.0]))


@pytest.mark.parametrize("seed", [1, 2])
def test_mass_and_centre_of_mass_are_found_where_they_are(seed: int) -> None:
    X = tilted(0.3, -0.4, 5.0)
    real = replace(JOB, mass_kg=6040.0, com_C_mm=JOB.com_C_mm + np.array([12.0, -5.0, 0.0]))
    weighing, positioners = weighed(real, X, seed)
    found = find_load(weighing, X, positioners, JOB, CELLS)
    assert found.mass_kg == pytest.approx(6040.0, abs=1e-6)
    assert found.off_mm == pytest.approx(13.0, abs=0.01)
    assert found.warp_n < 60.0
    check_load(found, JOB, 600.0)


@pytest.mark.parametrize(
    ("real", "extra", "where"),
    [
        (replace(JOB, mass_kg=6070.0), (0, 0, 0, 0), "mass"),
        (replace(JOB, mass_kg=5930.0), (0, 0, 0, 0), "mass"),
        (replace(JOB, com_C_mm=JOB.com_C_mm + np.array([0.0, 60.0, 0.0])), (0, 0, 0, 0), "centre of mass"),
        (JOB, (700.0, -700.0, 700.0, -700.0), "warp"),
        (JOB, (np.nan, 0, 0, 0), ""),
    ],
)
def test_another_part_than_the_jobs_is_refused(real: Load, extra: tuple[float, ...], where: str) -> None:
    X = tilted(0.0, 0.0)
    weighing, positioners = weighed(real, X, 0, extra)
    with pytest.raises(LoadUnexpected if where else LoadCellSilent) as refused:
        check_load(find_load(weighing, X, positioners, JOB, CELLS), JOB, 600.0)
    assert refused.value.where.startswith(where)


def test_the_height_of_the_centre_of_mass_does_not_show_when_level() -> None:
    weighing, positioners = weighed(replace(JOB, com_C_mm=JOB.com_C_mm + np.array([0.0, 0.0, 400.0])), tilted(0.0, 0.0))
    assert find_load(weighing, tilted(0.0, 0.0), positioners, JOB, CELLS).off_mm < 0.1


def test_the_uncertainty_is_that_of_readings_that_err_by_themselves() -> None:
    """Sigmas against a thousand draws of the load cells' errors."""
    X, rng = tilted(0.2, 0.1), np.random.default_rng(3)
    weighing, positioners = weighed(JOB, X)
    noisy = replace(weighing, noise_n=rng.uniform(20, 60, 12))
    draws = [
        find_load(
            replace(noisy, force_n=weighing.force_n + noisy.noise_n * rng.normal(size=12)), X, positioners, JOB, CELLS
        )
        for _ in range(1000)
    ]
    stated = find_load(noisy, X, positioners, JOB, CELLS)
    assert np.std([d.mass_kg for d in draws]) == pytest.approx(stated.mass_sigma_kg, rel=0.08)
    assert np.sqrt(np.mean([d.off_mm**2 for d in draws])) == pytest.approx(stated.off_sigma_mm, rel=0.08)
