"""Servo axes, brakes and what lies behind the motor."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def quiet(site):
    place = site("fuselage-can")
    return place, place.plant(place.truth.without_errors())


def unit(plant, name):
    result = np.zeros(len(plant.axes))
    result[plant.axes.index(name)] = 1.0
    return result


def test_following_error_is_rate_times_lag_and_vanishes_at_rest(quiet, driver):
    _, plant = quiet
    drive = driver(plant)
    for _ in range(200):
        drive.target = drive.target + 0.05
        drive.wait(0.01)
    # 5 mm/s at a lag of 2 ms, tuned within 5 %.
    np.testing.assert_allclose(plant.following_error_mm(), 0.010, rtol=0.06)
    assert not plant.at_rest()
    drive.wait(0.2)
    np.testing.assert_allclose(plant.following_error_mm(), 0.0, atol=1e-6)
    assert plant.at_rest()


def test_nothing_moves_before_power(quiet, driver):
    _, plant = quiet
    start = plant.encoder_mm().copy()
    drive = driver(plant)
    drive.powered[:], drive.braked[:] = False, True
    drive.target = drive.target + 5.0
    drive.wait(1.0)
    np.testing.assert_array_equal(plant.encoder_mm(), start)
    assert plant.at_rest()
    drive.powered[:] = True
    drive.wait(0.5)
    np.testing.assert_array_equal(plant.encoder_mm(), start)
    np.testing.assert_allclose(plant.following_error_mm(), 0.0, atol=1e-9)


def test_encoder_counts_are_whole_micrometres(quiet, driver):
    _, plant = quiet
    drive = driver(plant)
    drive.move(np.full(12, 0.01234))
    counts = plant.encoder_mm() * 1e3
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    assert plant.encoder_mm() is plant.encoder_mm()


def test_a_jump_is_followed_inside_the_drive_limits(quiet, driver):
    place, plant = quiet
    drive = driver(plant)
    start, speeds = plant.encoder_mm().copy(), []
    drive.target = drive.target + 3.0 * unit(plant, "A.X")
    last = start[0]
    for _ in range(60):
        drive.wait(0.01)
        speeds.append((plant.encoder_mm()[0] - last) / 0.01)
        last = plant.encoder_mm()[0]
    axis = place.cell.positioners[0].axes[0]
    assert max(speeds) <= 1.2 * axis.v_mm_s + 0.11
    assert max(np.diff(speeds, prepend=0.0)) <= 1.5 * axis.a_quick_mm_s2 * 0.01 + 0.21
    assert last - start[0] == pytest.approx(3.0, abs=0.002)
    assert max(plant.encoder_mm()[0] - start[0], 3.0) <= 3.02


def test_back_driving_until_the_brake_closes(quiet, driver):
    """0.5 m/s^2 for 100 ms: 2.5 mm down on every loaded axis; level axes stay."""
    _, plant = quiet
    drive = driver(plant)
    start, height = plant.encoder_mm().copy(), plant.component_pose_W().t_mm[2]
    drive.powered[:] = False
    drive.wait(0.1)
    fall = plant.encoder_mm() - start
    np.testing.assert_allclose(fall[2::3], -2.75, atol=0.3)
    np.testing.assert_array_equal(fall[0::3], 0.0)
    np.testing.assert_array_equal(fall[1::3], 0.0)
    drive.braked[:] = True
    drive.wait(0.2)
    rest = plant.encoder_mm().copy()
    drive.wait(1.0)
    np.testing.assert_array_equal(plant.encoder_mm(), rest)
    assert plant.at_rest()
    assert plant.component_pose_W().t_mm[2] - height == pytest.approx(np.mean(rest[2::3] - start[2::3]), abs=0.05)


def test_one_axis_falls_only_until_its_neighbours_carry(quiet, driver):
    """A.Z alone gives way: with 5 kN/mm of warp it is unloaded (10.1 kN) after about 2 mm and stops there."""
    _, plant = quiet
    drive = driver(plant)
    start = plant.encoder_mm()[2]
    drive.powered[2] = False
    drive.wait(2.0)
    assert plant.encoder_mm()[2] - start == pytest.approx(-2.0, abs=0.4)
    assert abs(plant.true_axis_forces_n()[2]) < 2500.0


def test_self_locking_screws_do_not_fall(site, driver):
    place = site("fuselage-can")
    drives = place.truth.drives.model_copy(update={"back_drive_mm_s2": 0.0})
    plant = place.plant(place.truth.model_copy(update={"drives": drives}))
    drive = driver(plant)
    start = plant.encoder_mm().copy()
    drive.powered[:] = False
    drive.wait(0.5)
    np.testing.assert_array_equal(plant.encoder_mm(), start)


def test_backlash_hysteresis(site, driver):
    """The component lags the encoder by the backlash on reversal; a loaded vertical axis has none."""
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("backlash"))
    drive = driver(plant)
    x_axes = np.tile((1.0, 0.0, 0.0), 4)
    z_axes = np.tile((0.0, 0.0, 1.0), 4)

    def stand():
        return plant.component_pose_W().t_mm.copy(), plant.encoder_mm().copy()

    drive.move(1.0 * x_axes)
    forward, e_forward = stand()
    drive.move(0.5 * x_axes)
    drive.move(-0.5 * x_axes)
    back, e_back = stand()
    np.testing.assert_array_equal(e_forward, e_back)
    assert back[0] - forward[0] == pytest.approx(0.010, abs=5e-4)
    drive.move(0.3 * z_axes)
    drive.move(-0.3 * z_axes)
    assert stand()[0][2] == pytest.approx(back[2], abs=2e-4)


def test_backlash_swallows_small_moves(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("backlash"))
    drive = driver(plant)
    before = plant.component_pose_W().t_mm[0]
    drive.move(0.004 * np.tile((1.0, 0.0, 0.0), 4))
    assert plant.component_pose_W().t_mm[0] == pytest.approx(before, abs=5e-4)


def test_screw_lead_error_grows_with_travel(site, driver):
    place = site("fuselage-can")
    plant, exact = place.plant(place.truth.only("screw_lead")), place.plant(place.truth.without_errors())
    for one in (plant, exact):
        driver(one).move(100.0 * np.tile((1.0, 0.0, 0.0), 4), seconds=40.0)
    difference = plant.component_pose_W().t_mm[0] - exact.component_pose_W().t_mm[0]
    # Mean of four screws, 10 um/m each, 0.1 m: sigma 0.5 um.
    assert 1e-6 < abs(difference) < 2.5e-3


def test_repeatability_is_five_micrometres(site, driver):
    """The same command, reached on ways of different length, again and again."""
    place = site("lab-can")
    plant = place.plant(place.truth.only("repeatability"))
    drive = driver(plant)
    seen = []
    for i in range(60):
        way = (0.5 + 0.05 * (i % 17)) * np.tile((0.0, 0.0, 1.0), 4)
        drive.move(way, seconds=1.0, rest_s=0.05)
        drive.move(-way, seconds=1.0, rest_s=0.05)
        seen.append(plant.component_pose_W().t_mm[2])
    # The component averages four axes.
    assert 0.0012 < np.std(seen) < 0.0042


def test_stick_slip_changes_at_every_stop(site, driver):
    place = site("lab-can")
    plant = place.plant(place.truth.only("stick_slip"))
    drive = driver(plant)
    seen = []
    for _ in range(40):
        drive.move(np.tile((0.0, 0.0, 0.2), 4), seconds=0.5, rest_s=0.05)
        drive.move(np.tile((0.0, 0.0, -0.2), 4), seconds=0.5, rest_s=0.05)
        seen.append(plant.component_pose_W().t_mm[2])
    assert 0.0005 < np.std(seen) < 0.005
    assert np.ptp(seen) < 0.010


def test_load_sinks_the_ball_by_its_compliance(site):
    """15 kN at 20 kN/mm: the sockets stand 0.5 to 1 mm above where the balls are."""
    place = site("fuselage-can")
    plant = place.plant(place.truth.without_errors())
    pose = plant.component_pose_W()
    ball = {b.positioner: np.array(b.xyz_mm) for b in place.job.component.balls}["A"]
    positioner = place.cell.positioners[0]
    directions = np.array([a.direction for a in positioner.axes]).T
    socket = np.array(positioner.origin_mm) + directions @ plant.encoder_mm()[:3]
    force = plant.true_axis_forces_n()[2]
    assert socket[2] - pose.apply(ball)[2] == pytest.approx(force / 20000.0, abs=0.002)


def test_time_standing_still_is_ignored(quiet, driver):
    _, plant = quiet
    drive = driver(plant)
    before = plant.encoder_mm().copy()
    plant.step(drive.t_s, drive.target + 1.0, drive.powered, drive.braked)
    np.testing.assert_array_equal(plant.encoder_mm(), before)
    drive.wait(0.1)
    np.testing.assert_allclose(plant.encoder_mm(), before, atol=0.002)
