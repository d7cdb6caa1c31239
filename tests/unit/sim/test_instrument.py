"""The simulated optics against the stated noise model."""

from __future__ import annotations

import numpy as np
import pytest

from docking.config.cell import Noise
from sim.instrument import Instrument
from sim.shapes import pose_of


def build(place, truth, seed=1):
    return Instrument(place.plant(truth, seed), place.cell, truth, seed)


def local_errors(place, instrument, name, count=3000, t_s=0.0):
    """(n, 3) errors along, level and upright of the line of sight, from the cell file's station pose."""
    station = pose_of(place.cell.tracker.station_pose)
    p_T = station.inverse().apply(instrument._plant.target_W_mm(name, t_s))
    line = p_T / np.linalg.norm(p_T)
    level = np.cross((0, 0, 1), line)
    level /= np.linalg.norm(level)
    axes = np.column_stack((line, level, np.cross(line, level)))
    shots = np.array([instrument.shoot(name, t_s).p_T_mm for _ in range(count)])
    return (shots - p_T) @ axes, float(np.linalg.norm(p_T)) * 1e-3


def test_without_errors_it_sees_the_truth(site):
    place = site("fuselage-can")
    instrument = build(place, place.truth.without_errors())
    station = pose_of(place.cell.tracker.station_pose)
    for name in instrument._plant.target_names():
        shot = instrument.shoot(name, 1.0)
        assert (shot.status, shot.name) == ("ok", name)
        expected = station.inverse().apply(instrument._plant.target_W_mm(name, 1.0))
        np.testing.assert_allclose(shot.p_T_mm, expected, atol=1e-9)


def test_laser_tracker_noise_is_half_its_mpe(site):
    place = site("fuselage-can")
    instrument = build(place, place.truth.only("instrument_noise"))
    errors, metres = local_errors(place, instrument, "J05")
    along, across = (10 + 0.3 * metres) / 2e3, (15 + 6 * metres) / 2e3
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=0.003)
    np.testing.assert_allclose(errors.std(axis=0), (along, across, across), rtol=0.06)
    shot = instrument.shoot("J05", 0.0)
    assert np.sum(shot.sigma_mm**2) == pytest.approx(along**2 + 2 * across**2, rel=1e-3)


def test_total_station_is_six_tenths_along(site):
    place = site("wing-modbus")
    instrument = build(place, place.truth.only("instrument_noise"))
    name = place.job.component.targets[0].name
    errors, metres = local_errors(place, instrument, name)
    across = (1.0 + 4.85 * metres) * 1e-3
    np.testing.assert_allclose(errors.std(axis=0), (0.6, across, across), rtol=0.08)


def test_noise_of_the_cell_file_overrides_the_class(site):
    place = site("lab-can")
    noise = Noise(range_um=100.0, range_um_per_m=0.0, transverse_um=1.0, transverse_um_per_m=0.0)
    tracker = place.cell.tracker.model_copy(update={"noise": noise})
    place = type(place)(place.cell.model_copy(update={"tracker": tracker}), place.job, place.truth)
    errors, _ = local_errors(place, build(place, place.truth.only("instrument_noise")), "J01")
    np.testing.assert_allclose(errors.std(axis=0), (0.1, 0.001, 0.001), rtol=0.06)


def test_seating_scatters_by_five_to_ten_micrometres(site):
    place = site("lab-can")
    errors, _ = local_errors(place, build(place, place.truth.only("seating")), "J02")
    spread = errors.std(axis=0)
    assert np.all((spread > 0.0047) & (spread < 0.0106))


def test_station_stands_elsewhere_than_the_file_says(site):
    place = site("fuselage-can")
    instrument = build(place, place.truth.only("station_pose"))
    true, stated = instrument.station.pose(0.0), pose_of(place.cell.tracker.station_pose)
    shift = np.abs(true.t_mm - stated.t_mm)
    assert np.all(shift <= 5.0)
    assert shift.max() > 0.1


def test_station_drift_per_hour(site):
    place = site("fuselage-can")
    instrument = build(place, place.truth.only("station_drift"))
    moved = instrument.station.pose(3600.0).t_mm - instrument.station.pose(0.0).t_mm
    assert 0.020 <= np.linalg.norm(moved) <= 0.050
    half = instrument.station.pose(1800.0).t_mm - instrument.station.pose(0.0).t_mm
    np.testing.assert_allclose(2.0 * half, moved, atol=1e-12)


def test_bump_of_two_tenths(site):
    place = site("fuselage-can")
    truth = place.truth.stress().only("station_bump")
    instrument = build(place, truth)
    at = instrument.station.bump_s
    assert 0.0 < at < 3600.0
    jump = instrument.station.pose(at + 1.0).t_mm - instrument.station.pose(at - 1.0).t_mm
    assert np.linalg.norm(jump) == pytest.approx(0.2, rel=1e-9)
    stations = [build(place, place.truth.only("station_bump"), seed).station for seed in range(40)]
    bumped = sum(not np.array_equal(s.pose(3601.0).t_mm, s.pose(0.0).t_mm) for s in stations)
    # A quarter of the runs: 10 of 40, within 3 sigma.
    assert 2 <= bumped <= 18


def test_refraction_bends_vertically_with_the_square_of_distance(site):
    """0.5 K/m: 0.23e-6 per metre, 19 um at 9 m."""
    place = site("fuselage-can")
    instrument = build(place, place.truth.only("refraction"))
    station = pose_of(place.cell.tracker.station_pose)
    for name in ("J01", "E1"):
        true = instrument._plant.target_W_mm(name, 0.0)
        error = station.apply(instrument.shoot(name, 0.0).p_T_mm) - true
        distance = np.linalg.norm(true - station.t_mm) * 1e-3
        assert abs(error[2]) * 1e3 == pytest.approx(0.2325 * distance**2, rel=1e-6)
        np.testing.assert_allclose(error[:2], 0.0, atol=1e-9)


def test_two_faces_see_opposite_collimation(site):
    place = site("wing-modbus")
    instrument = build(place, place.truth.only("collimation"), seed=4)
    name = place.job.component.targets[0].name
    one, two = instrument.shoot(name, 0.0, 1).p_T_mm, instrument.shoot(name, 0.0, 2).p_T_mm
    true = pose_of(place.cell.tracker.station_pose).inverse().apply(instrument._plant.target_W_mm(name, 0.0))
    np.testing.assert_allclose((one + two) / 2, true, atol=1e-9)
    assert 1e-4 < np.linalg.norm(one - two) < 0.2


def test_outliers_only_when_in_a_hurry(site):
    def outliers(name):
        place = site(name)
        errors, _ = local_errors(place, build(place, place.truth.only("fast_outliers")), "J01", count=4000)
        return np.linalg.norm(errors, axis=1)

    sizes = outliers("lab-can")
    hit = sizes > 1e-6
    assert 15 <= hit.sum() <= 75
    assert np.all((sizes[hit] >= 0.05) & (sizes[hit] <= 0.1))
    assert np.all(outliers("fuselage-can") < 1e-6)


def test_gross_errors_are_rare_and_of_every_kind(site):
    place = site("lab-can")
    truth = place.truth.only("gross_errors", 10.0)
    names = place.plant().target_names()
    status = {"ok": 0, "no-target": 0, "inaccurate": 0}
    wrong = 0
    instrument = build(place, truth, 5)
    for i in range(3000):
        name = names[i % len(names)]
        shot = instrument.shoot(name, 0.0)
        status[shot.status] += 1
        if shot.status != "no-target":
            station = pose_of(place.cell.tracker.station_pose)
            wrong += np.linalg.norm(station.apply(shot.p_T_mm) - instrument._plant.target_W_mm(name, 0.0)) > 10.0
    assert 30 <= status["no-target"] <= 95
    assert 30 <= status["inaccurate"] <= 95
    assert 30 <= wrong <= 95


def test_unseated_reflector_stays_unseated_in_a_run(site):
    place = site("lab-can")
    hits = []
    for seed in range(40):
        instrument = build(place, place.truth.only("gross_errors", 5.0), seed)
        hits.extend(np.linalg.norm(instrument._unseated, axis=1))
    sizes = np.array(hits)
    unseated = sizes[sizes > 0]
    assert 0.004 < len(unseated) / len(sizes) < 0.02
    assert np.all((unseated >= 0.5) & (unseated <= 5.0))


def test_unknown_name_is_no_target(site):
    place = site("lab-can")
    shot = build(place, place.truth).shoot("J99", 0.0)
    assert shot.status == "no-target"


def test_aiming_finds_the_nearest_reflector_inside_the_cone(site):
    place = site("wing-modbus")
    instrument = build(place, place.truth.without_errors())
    name = place.job.component.targets[2].name
    station = pose_of(place.cell.tracker.station_pose)
    aim = station.inverse().apply(instrument._plant.target_W_mm(name, 0.0) + np.array((0.0, 0.0, 20.0)))
    shot = instrument.shoot_towards(aim, 0.0)
    assert (shot.status, shot.name) == ("ok", name)
    assert np.linalg.norm(shot.p_T_mm - aim) == pytest.approx(20.0, abs=1e-6)
    assert instrument.shoot_towards(np.array((0.0, 0.0, 1.0)), 0.0).status == "no-target"


def test_same_seed_same_shots_and_independent_streams(site):
    place = site("lab-can")

    def shots(truth):
        instrument = build(place, truth, 11)
        return np.array([instrument.shoot("J03", 0.0).p_T_mm for _ in range(50)])

    full = shots(place.truth)
    np.testing.assert_array_equal(full, shots(place.truth))
    # Seating off: what is left of the difference is seating alone, so the noise was drawn alike.
    difference = full - shots(place.truth.scaled({"seating": 0.0}))
    assert 0.003 < difference.std() < 0.012


def test_targets_follow_the_component(site, driver):
    place = site("fuselage-can")
    truth = place.truth.without_errors()
    plant = place.plant(truth)
    instrument = Instrument(plant, place.cell, truth, 1)
    drive = driver(plant)
    before = {n: instrument.shoot(n, drive.t_s).p_T_mm for n in ("J01", "M01")}
    drive.move(5.0 * np.tile((0.0, 0.0, 1.0), 4), seconds=5.0)
    assert instrument.shoot("J01", drive.t_s).p_T_mm[2] - before["J01"][2] == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(instrument.shoot("M01", drive.t_s).p_T_mm, before["M01"], atol=1e-9)
