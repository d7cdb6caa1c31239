"""The plant's D.Z holding its force, holding its position, jammed, and without its ball."""

from __future__ import annotations

import numpy as np
import pytest

from docking.types import Array

HELD_N = 13400.0
K = 11
BAND_N = 0.005 * HELD_N


@pytest.fixture
def cell(site):
    return site("follower-force-can")


def pressing(force_n: float = HELD_N) -> Array:
    forces = np.full(12, np.nan)
    forces[K] = force_n
    return forces


FAST = np.full(12, 12.0)


@pytest.fixture
def pressed(cell, driver):
    plant = cell.plant(cell.truth.without_errors())
    drive = driver(plant)
    plant.press(pressing(), FAST)
    drive.wait(0.1)
    return plant, drive


def z_force(plant) -> Array:
    return plant.true_axis_forces_n()[2::3]


def lifted(cell, dz_mm: float) -> Array:
    """Axis displacements of the position-driven axes that lift the component."""
    up = [np.linalg.inv(np.transpose([axis.direction for axis in p.axes]))[:, 2] for p in cell.cell.positioners]
    return np.where(cell.cell.driven, dz_mm * np.ravel(up), 0.0)


def test_it_starts_with_its_force_and_the_others_with_the_rest(cell, driver):
    plant = cell.plant(cell.truth.without_errors())
    driver(plant)
    np.testing.assert_allclose(z_force(plant), [10136.0, 16018.0, 19286.0, HELD_N], atol=10.0)
    assert plant.true_internal_force_n() < 15.0


def test_it_slides_with_the_component_and_keeps_its_force_but_for_friction(cell, pressed):
    plant, drive = pressed
    before = plant.encoder_mm()[K]
    drive.move(lifted(cell, 5.0), seconds=4.0)
    assert plant.encoder_mm()[K] - before == pytest.approx(5.0, abs=0.02)
    # Moving up, friction takes the most that it can off what the drive presses.
    assert z_force(plant)[3] == pytest.approx(HELD_N - BAND_N, abs=1.0)
    drive.move(lifted(cell, -2.0), seconds=4.0)
    assert z_force(plant)[3] == pytest.approx(HELD_N + BAND_N, abs=1.0)
    assert plant.true_internal_force_n() < 4.0 * BAND_N


def test_more_force_lifts_its_ball_by_the_elastic_support(pressed):
    """1 kN against the warp of four springs of 20 kN/mm: 0.2 mm at D, less the friction."""
    plant, drive = pressed
    before = plant.encoder_mm()[K]
    plant.press(pressing(HELD_N + 1000.0), FAST)
    drive.wait(0.1)
    assert z_force(plant)[3] == pytest.approx(HELD_N + 1000.0, abs=BAND_N + 1.0)
    assert plant.encoder_mm()[K] - before == pytest.approx(0.2, abs=0.03)


def test_told_to_hold_its_position_it_goes_on_as_it_went_and_becomes_stiff(cell, pressed):
    plant, drive = pressed
    lift = lifted(cell, 4.0)
    start = drive.target
    for i in range(1, 101):  # 2 mm/s
        drive.target = start + lift * (i / 200.0)
        drive.wait(0.01)
    here = plant.encoder_mm()[K]
    drive.target = drive.target.copy()
    plant.press(np.full(12, np.nan), FAST)
    for i in range(1, 101):  # D.Z is told to go on at 2 mm/s, as the others do
        drive.target = np.where(np.arange(12) == K, here + 0.02 * i, start + lift * (0.5 + i / 200.0))
        drive.wait(0.01)
    assert z_force(plant)[3] == pytest.approx(HELD_N, abs=250.0)
    drive.move(0.1 * (np.arange(12) == K))
    # Now it is a spring against the three others: 5 kN/mm.
    assert z_force(plant)[3] == pytest.approx(HELD_N + 500.0, abs=300.0)
    assert plant.encoder_mm()[K] == pytest.approx(here + 2.1, abs=0.005)


def test_jammed_it_stays_and_the_part_is_strained(cell, pressed):
    plant, drive = pressed
    before = plant.encoder_mm()[K]
    plant.jam("D.Z")
    drive.move(lifted(cell, 0.2))
    assert plant.encoder_mm()[K] == before
    # It hangs back by 0.2 mm against 5 kN/mm: D loses 1 kN, and so does B; A and C take it.
    np.testing.assert_allclose(z_force(plant), [11136.0, 15018.0, 20286.0, HELD_N - 1000.0], atol=120.0)
    plant.release("D.Z")
    drive.wait(0.1)
    assert z_force(plant)[3] == pytest.approx(HELD_N, abs=BAND_N + 1.0)


def test_without_its_ball_it_runs_no_faster_than_the_drive_permits(cell, pressed):
    plant, drive = pressed
    before = plant.encoder_mm()[K]
    plant.lose_ball("D.Z")
    drive.wait(0.5)
    assert plant.encoder_mm()[K] - before == pytest.approx(0.5 * 12.0, abs=0.01)
    np.testing.assert_allclose(z_force(plant) / 1000.0, [23.5, 2.6, 32.7, 0.0], atol=0.1)
    plant.press(np.full(12, np.nan), FAST)
    drive.target = drive.target.copy()
    drive.target[K] = plant.encoder_mm()[K]
    stood = plant.encoder_mm()[K]
    drive.wait(0.3)
    assert plant.encoder_mm()[K] == stood
    with pytest.raises(ValueError, match=r"A\.Z"):
        plant.lose_ball("A.Z")
