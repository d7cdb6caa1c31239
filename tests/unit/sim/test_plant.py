"""The plant against hand-calculated physics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import ConfigInvalid
from docking.types import Pose
from sim.truth import ERROR_NAMES

CELLS = (
    "fuselage-can",
    "fuselage-modbus",
    "follower-can",
    "follower-force-can",
    "wing-modbus",
    "lab-can",
    "lab-modbus",
)
G = 9.80665


def axis(plant, name, value):
    delta = np.zeros(len(plant.axes))
    delta[plant.axes.index(name)] = value
    return delta


def ball_move(site, before: Pose, after: Pose):
    """Axis displacements (m,) that take the nominal balls from one pose to the other, from the cell file alone."""
    balls = {b.positioner: np.array(b.xyz_mm) for b in site.job.component.balls}
    rows = []
    for p in site.cell.positioners:
        directions = np.array([a.direction for a in p.axes]).T
        rows.append(np.linalg.solve(directions, after.apply(balls[p.name]) - before.apply(balls[p.name])))
    return np.concatenate(rows)


def squared(place):
    """The fuselage cell with orthogonal axes, so that hand-calculated figures hold to the last digit."""
    directions = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    positioners = tuple(
        p.model_copy(
            update={
                "axes": tuple(a.model_copy(update={"direction": d}) for a, d in zip(p.axes, directions, strict=True))
            }
        )
        for p in place.cell.positioners
    )
    return type(place)(place.cell.model_copy(update={"positioners": positioners}), place.job, place.truth)


def test_reactions_of_the_fuselage(site):
    """6 t with the centre of mass at (600, 200, 0): A 10.1, B 16.0, C 19.3, D 13.4 kN; centred: 14.7 each."""
    place = squared(site("fuselage-can"))
    plant = place.plant(place.truth.without_errors())
    forces = plant.true_axis_forces_n().reshape(4, 3)
    np.testing.assert_allclose(forces[:, 2] / 1e3, (10.1, 16.0, 19.3, 13.4), atol=0.05)
    np.testing.assert_allclose(forces[:, :2], 0.0, atol=1.0)
    assert forces[:, 2].sum() == pytest.approx(6000 * G, rel=1e-9)
    part = place.job.component.model_copy(update={"com_mm": (0.0, 0.0, 0.0)})
    centred = type(place)(place.cell, place.job.model_copy(update={"component": part}), place.truth)
    z_forces = centred.plant(place.truth.without_errors()).true_axis_forces_n()[2::3]
    np.testing.assert_allclose(z_forces / 1e3, 14.71, atol=0.01)


@pytest.mark.parametrize("name", CELLS)
def test_start_is_seated_free_of_internal_force_and_inside_the_strokes(site, name):
    place = site(name)
    for seed in range(20):
        plant = place.plant(seed=seed)
        assert plant.true_internal_force_n() < 0.01
        strokes = np.array([a.stroke_mm for p in place.cell.positioners for a in p.axes])
        assert np.all((strokes[:, 0] < plant.encoder_mm()) & (plant.encoder_mm() < strokes[:, 1]))
        weight = place.job.component.mass_kg * G
        assert plant.true_axis_forces_n()[2::3].sum() == pytest.approx(weight, rel=0.02)
        assert np.all(plant.true_axis_forces_n()[2::3] > 0.1 * weight / len(place.cell.positioners))


@pytest.mark.parametrize("name", CELLS)
def test_start_pose_is_the_stand_off_plus_the_misalignment(site, name):
    place = site(name)
    standoff = place.job.stages[0].standoff_mm
    exact = place.plant(place.truth.without_errors())
    np.testing.assert_allclose(exact.true_feature_errors_mm(), standoff, rtol=1e-3)
    off = place.plant(place.truth.only("misalignment"), seed=7)
    x_cc = exact.component_pose_W().R.T @ off.component_pose_W().R
    angles = np.abs(Rotation.from_matrix(x_cc).as_euler("xyz", degrees=True))
    shift = np.abs(off.component_pose_W().t_mm - exact.component_pose_W().t_mm)
    assert np.all(angles <= 0.5)
    assert angles.max() > 0.02
    assert np.all(shift <= place.truth.misalignment.mm * 1.001)
    assert shift.max() > 0.05 * place.truth.misalignment.mm


def test_start_outside_a_stroke_is_refused(site):
    place = site("lab-can")
    stage = place.job.stages[0].model_copy(update={"standoff_mm": 40.0})
    far = type(place)(place.cell, place.job.model_copy(update={"stages": (stage,)}), place.truth)
    with pytest.raises(ConfigInvalid, match=r"A\.X would start at"):
        far.plant()


@pytest.mark.parametrize(("name", "force_n"), [("A.Z", 500.0), ("C.Z", -500.0), ("B.X", 1380.0), ("D.Y", 1120.0)])
def test_one_axis_off_by_a_tenth(site, driver, name, force_n):
    """0.1 mm on one axis at 20 kN/mm: 0.25 of it (Z, warp), 0.69 (X), 0.58 (Y) becomes internal force along it."""
    place = squared(site("fuselage-can"))
    plant = place.plant(place.truth.without_errors())
    drive = driver(plant)
    before = plant.true_axis_forces_n()
    drive.move(axis(plant, name, np.sign(force_n) * 0.1))
    change = plant.true_axis_forces_n() - before
    # 6 %: the share of Y depends on the height of the balls, figures of docs/mechanics.md carry two digits.
    assert change[plant.axes.index(name)] == pytest.approx(force_n, rel=0.06)
    if name.endswith("Z"):
        warp = change[2::3] @ (1, -1, 1, -1) / 4
        assert warp == pytest.approx(force_n, rel=0.02)
        assert plant.true_internal_force_n() == pytest.approx(abs(force_n), rel=0.05)


def test_rigid_translation_makes_no_internal_force(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("misalignment"))
    drive = driver(plant)
    # Quantised encoders and set-points taken from them: half a micrometre an axis.
    noise = plant.true_internal_force_n()
    before = plant.component_pose_W()
    shift = np.array((30.0, -12.0, 8.0))
    drive.move(ball_move(place, before, Pose(before.R, before.t_mm + shift)), seconds=20.0)
    np.testing.assert_allclose(plant.component_pose_W().t_mm - before.t_mm, shift, atol=1e-4)
    assert plant.true_internal_force_n() == pytest.approx(noise, abs=0.5)
    assert noise < 30.0


def test_rigid_rotation_reaches_the_pose(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.without_errors())
    drive = driver(plant)
    before = plant.component_pose_W()
    turn = Rotation.from_euler("xyz", (0.2, -0.1, 0.3), degrees=True).as_matrix()
    after = Pose(turn @ before.R, before.t_mm + np.array((3.0, 2.0, -1.0)))
    drive.move(ball_move(place, before, after), seconds=20.0)
    reached = plant.component_pose_W()
    np.testing.assert_allclose(reached.t_mm, after.t_mm, atol=0.02)
    np.testing.assert_allclose(reached.R, after.R, atol=5e-6)
    assert plant.true_internal_force_n() < 300.0


def test_docking_exactly_closes_the_features(site, driver):
    """With every error off, the axis move calculated from the files alone brings the features together."""
    place = site("lab-can")
    plant = place.plant(place.truth.without_errors())
    before = plant.component_pose_W()
    driver(plant).move(ball_move(place, before, Pose(before.R, before.t_mm + np.array((8.0, 0.0, 0.0)))), seconds=10.0)
    assert plant.true_feature_errors_mm().max() < 0.002


def test_load_cells_read_the_weight(site):
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("load_cell_noise"))
    readings = np.array([plant.force_n() for _ in range(400)])
    np.testing.assert_allclose(readings.mean(axis=0), plant.true_axis_forces_n(), atol=6.0)
    np.testing.assert_allclose(readings[:, 2::3].std(axis=0), 25.0, rtol=0.15)
    crossed = place.plant(place.truth.only("load_cell_crosstalk"))
    side = (crossed.force_n() - crossed.true_axis_forces_n()).reshape(4, 3)
    assert 20.0 < np.abs(side[:, :2]).max() < 600.0
    none = tuple(p.model_copy(update={"load_cell": False}) for p in place.cell.positioners)
    bare = type(place)(place.cell.model_copy(update={"positioners": none}), place.job, place.truth)
    assert np.all(np.isnan(bare.plant().force_n()))


def test_load_cell_zero_drifts_with_time(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("load_cell_drift"))
    drive = driver(plant)
    drive.t_s += 3600.0
    drive.wait(0.01)
    drift = plant.force_n() - plant.true_axis_forces_n()
    assert np.all(np.abs(drift[2::3]) <= 50.1)
    assert np.abs(drift[2::3]).max() > 5.0
    assert np.all(np.abs(drift[0::3]) <= 10.1)


@pytest.mark.parametrize("name", ["fuselage-can", "follower-can", "wing-modbus", "lab-can"])
def test_same_seed_same_run(site, driver, name):
    place = site(name)

    def run(seed):
        plant = place.plant(seed=seed)
        drive = driver(plant)
        drive.move(np.full(len(plant.axes), 1.5))
        return np.concatenate((plant.encoder_mm(), plant.force_n(), plant.targets_W_mm(drive.t_s + 60).ravel()))

    np.testing.assert_array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


def test_loop_time_offset_changes_nothing(site, driver):
    """The run begins at the first time the plant sees, whatever the loop's clock says."""
    place = site("lab-can")
    late, early = place.plant(), place.plant()
    for plant, start in ((late, 1e5), (early, 0.0)):
        drive = driver(plant, start)
        drive.move(np.full(12, 1.0))
    np.testing.assert_allclose(late.targets_W_mm(1e5 + 30), early.targets_W_mm(30.0), atol=1e-6)


@pytest.mark.parametrize("off", ["nominal_nests", "calibration", "temperature", "mass_properties", "ers_points"])
def test_switching_one_error_leaves_the_draws_of_the_others(site, off):
    """What an error does not touch stays the same to the bit."""
    place = site("fuselage-can")
    with_it, without = place.plant(seed=9), place.plant(place.truth.scaled({off: 0.0}), seed=9)
    assert with_it.clock_ppm == without.clock_ppm
    names = np.array(with_it.target_names())
    same = np.all(with_it.targets_W_mm(0.0) == without.targets_W_mm(0.0), axis=1)
    ers, mate = np.char.startswith(names, "E"), np.char.startswith(names, "M")
    assert np.all(same[ers] == (off != "ers_points"))
    assert np.all(same[mate] == (off not in ("nominal_nests", "temperature")))


def test_each_error_does_something_or_belongs_to_the_instrument(site, driver):
    """Every error of the plant, alone, changes an observable; none of them is a dead switch."""
    place = site("fuselage-can")
    optics = {
        "seating",
        "station_drift",
        "station_bump",
        "refraction",
        "station_pose",
        "gross_errors",
        "fast_outliers",
        "instrument_noise",
        "range_zero",
        "collimation",
    }

    def observe(truth):
        plant = place.plant(truth, seed=3)
        drive = driver(plant)
        # One axis by itself loads the sockets sideways, so that their play matters.
        drive.move(axis(plant, "A.X", 0.08))
        drive.t_s += 1800.0
        drive.wait(0.05)
        clocks = np.array(list(plant.clock_ppm.values()))
        return np.concatenate((plant.targets_W_mm(drive.t_s).ravel(), plant.force_n(), plant.encoder_mm(), clocks))

    quiet = observe(place.truth.without_errors())
    dead = [n for n in ERROR_NAMES if n not in optics and np.array_equal(observe(place.truth.only(n)), quiet)]
    assert dead == []
    one = place.plant(place.truth.only("feature_transfer"), seed=3).true_feature_errors_mm()
    assert 0.0 < np.abs(one - 300.0).max() < 0.1


def test_temperature_moves_targets_by_expansion(site):
    """0.5 K on aluminium, 3.9 m from the origin: at most 45 um, and it is the component that grows."""
    place = site("fuselage-can")
    still, warm = place.plant(place.truth.without_errors()), place.plant(place.truth.only("temperature"), seed=2)
    names = still.target_names()
    moved = np.linalg.norm(warm.targets_W_mm(0.0) - still.targets_W_mm(0.0), axis=1)
    far = moved[names.index("J10")]
    assert 0.001 < far < 0.5 * 23e-6 * 4500
    assert moved[names.index("E1")] == 0.0
    hot = place.plant(place.truth.stress().only("temperature"), seed=2)
    far_hot = np.linalg.norm((hot.targets_W_mm(0.0) - still.targets_W_mm(0.0))[names.index("J10")])
    assert far_hot == pytest.approx(6.0 * far, rel=0.02)


def test_floor_sinks_after_load_transfer(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("floor_settlement"))
    before = plant.component_pose_W().t_mm
    drive = driver(plant)
    drive.t_s += 4 * 3600.0
    drive.wait(0.01)
    sunk = before[2] - plant.component_pose_W().t_mm[2]
    assert 0.020 < sunk < 0.060
    assert plant.true_internal_force_n() > 20.0


def test_uncalibrated_base_is_seen_as_internal_force(site, driver):
    """Bases turned by 0.5 deg, either way: a straight move of 30 mm pulls the balls 0.26 mm apart."""
    place = site("fuselage-can")
    plant = place.plant(place.truth.only("uncalibrated_base"))
    before = plant.component_pose_W()
    drive = driver(plant)
    drive.move(ball_move(place, before, Pose(before.R, before.t_mm + np.array((30.0, 0.0, 0.0)))), seconds=10.0)
    assert plant.true_internal_force_n() > 1500.0


def test_passive_axes_float_with_the_component(site, driver):
    place = site("follower-can")
    plant = place.plant(place.truth.without_errors())
    before, encoders = plant.component_pose_W(), plant.encoder_mm().copy()
    wanted = ball_move(place, before, Pose(before.R, before.t_mm + np.array((25.0, 10.0, 0.0))))
    driven = np.array(place.cell.driven)
    drive = driver(plant)
    drive.move(np.where(driven, wanted, 0.0), seconds=10.0)
    # A.X drags three sliders of 50 N at 20 kN/mm: 7.5 um of sink, 3.6 um of yaw, 2.5 um of stretch, 0.5 um rounding.
    np.testing.assert_allclose((plant.encoder_mm() - encoders)[~driven], wanted[~driven], atol=0.016)
    assert plant.true_internal_force_n() < 200.0
    assert np.all(plant.true_axis_forces_n()[2::3] > 8000.0)


def test_encoders_of_passive_axes_follow_between_solutions(site, driver):
    """The linear prediction that every cycle uses agrees with the full solution."""
    place = site("follower-can")
    plant = place.plant()
    drive = driver(plant)
    drive.powered[:] = True
    start = drive.target.copy()
    for i in range(1, 26):
        drive.target = start + 0.05 * i * np.array(place.cell.driven)
        drive.wait(0.01)
        plant.encoder_mm()
    predicted = plant.encoder_mm().copy()
    plant.targets_W_mm(drive.t_s + 1.0)
    np.testing.assert_allclose(plant.encoder_mm(), predicted, atol=0.006)


def test_jammed_axis_stays_and_strains(site, driver):
    place = site("fuselage-can")
    plant = place.plant(place.truth.without_errors())
    drive = driver(plant)
    stuck = plant.axes.index("B.X")
    position = plant.encoder_mm()[stuck]
    plant.jam("B.X")
    before = plant.component_pose_W()
    drive.move(ball_move(place, before, Pose(before.R, before.t_mm + np.array((0.2, 0.0, 0.0)))))
    assert plant.encoder_mm()[stuck] == position
    assert plant.following_error_mm()[stuck] == pytest.approx(0.2, abs=0.01)
    assert plant.true_internal_force_n() == pytest.approx(0.69 * 0.2 * 20000, rel=0.1)
    plant.release("B.X")
    drive.wait(0.5)
    assert plant.following_error_mm()[stuck] == pytest.approx(0.0, abs=1e-3)
    assert plant.true_internal_force_n() < 30.0


def test_ball_slips_inside_its_clearance_only(site, driver):
    """Side force beyond friction uses up the play, at most half of 30 um; then the force grows as without play."""
    place = squared(site("fuselage-can"))
    stiff = place.plant(place.truth.without_errors())
    loose = place.plant(place.truth.only("ball_clearance"))
    for plant in (stiff, loose):
        driver(plant).move(axis(plant, "B.X", 0.1))
    relief = stiff.true_internal_force_n() - loose.true_internal_force_n()
    assert 20.0 < relief < 2 * 0.015 * 20000
