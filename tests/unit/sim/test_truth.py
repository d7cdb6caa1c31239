"""The truth files carry the magnitudes of the main study; errors are named, switchable, independent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sim
from docking.errors import ConfigInvalid, FileUnreadable
from sim.truth import ERROR_NAMES, Draws, load_truth

CELLS = (
    "fuselage-can",
    "fuselage-modbus",
    "follower-can",
    "follower-force-can",
    "wing-modbus",
    "lab-can",
    "lab-modbus",
)


@pytest.mark.parametrize("name", CELLS)
def test_magnitudes_are_those_of_the_main_study(site, name):
    truth = site(name).truth
    lab = name.startswith("lab")
    assert truth.name == name
    assert truth.nominal_nests.sigma_mm == (0.005 if lab else 0.03)
    assert truth.feature_transfer.sigma_mm == (0.005 if lab else 0.01)
    assert truth.seating.sigma_um == (5.0, 10.0)
    assert truth.station_drift.um_per_h == (20.0, 50.0)
    assert truth.station_bump.shift_mm == 0.2
    assert truth.refraction.k_per_m == 0.5
    assert (truth.temperature.offset_k, truth.temperature.rate_k_per_h) == (0.5, 0.5)
    assert truth.stress().temperature.offset_k == 3.0
    assert truth.floor_settlement.um == (20.0, 50.0)
    assert truth.ball_clearance.um == (10.0, 30.0)
    assert truth.stick_slip.um == 5.0
    assert truth.screw_lead.um_per_m == 10.0
    assert truth.load_cell_noise.fraction == 0.0005
    assert truth.load_cell_crosstalk.fraction == 0.01
    assert truth.load_cell_drift.fraction == 0.001
    assert truth.calibration.origin_mm == 0.05
    assert truth.calibration.direction_mrad == 0.1
    assert truth.calibration.ball_mm == 0.1
    assert truth.uncalibrated_base.deg == 0.5
    assert truth.repeatability.um == 5.0
    assert truth.backlash.um == 10.0
    assert truth.clock_ppm.ppm == 50.0
    assert truth.fast_outliers.probability == 0.01
    assert truth.fast_outliers.um == (50.0, 100.0)
    assert truth.gross_errors.unseated_mm == (0.5, 5.0)
    assert truth.drives.back_drive_mm_s2 == 500.0
    assert (truth.misalignment.mm, truth.misalignment.deg) == ((5.0 if lab else 20.0), 0.5)
    assert truth.instrument.measure_s == (0.1 if lab else 2.0)


@pytest.mark.parametrize("name", CELLS)
def test_every_error_is_on_but_the_uncalibrated_base(site, name):
    scales = site(name).truth.errors
    assert set(scales) == set(ERROR_NAMES)
    assert {n for n, k in scales.items() if k != 1.0} == {"uncalibrated_base"}
    assert scales["uncalibrated_base"] == 0.0


@pytest.mark.parametrize("name", CELLS)
def test_as_built_errors_are_those_the_job_states(site, name):
    """What the job calls sigma is what the plant draws: otherwise the controller is told a wrong uncertainty."""
    place = site(name)
    nests = (*place.job.component.targets, *place.job.component.check_points, *place.job.mate.targets)
    assert {t.sigma_mm for t in nests} == {place.truth.nominal_nests.sigma_mm}
    features = place.job.component.features
    assert {s for f in features for s in (f.sigma_mm, f.mate_sigma_mm)} == {place.truth.feature_transfer.sigma_mm}


def test_scaling(site):
    truth = site("lab-can").truth
    assert truth.scaled({"station_drift": 5.0}).errors["station_drift"] == 5.0
    assert truth.errors["station_drift"] == 1.0
    only = truth.only("temperature", 5.0).errors
    assert only.pop("temperature") == 5.0
    assert set(only.values()) == {0.0}
    with pytest.raises(KeyError, match="no_such_error"):
        truth.scaled({"no_such_error": 1.0})


def test_scale_multiplies_the_same_draws(site):
    truth = site("lab-can").truth
    once = Draws(truth, 3).normal("calibration", (5,))
    five = Draws(truth.scaled({"calibration": 5.0}), 3).normal("calibration", (5,))
    np.testing.assert_allclose(five, 5.0 * once)
    assert not np.allclose(Draws(truth, 4).normal("calibration", (5,)), once)


def test_bad_truth_files_name_all_problems(tmp_path):
    good = tmp_path / "x.sim.toml"
    text = (Path(sim.__file__).parent / "cells" / "lab-can.sim.toml").read_text("utf-8")
    good.write_text(
        text.replace("k_per_m = 0.5", "k_per_metre = nan").replace("probability = 0.25", "probability = 2.0")
    )
    with pytest.raises(ConfigInvalid) as caught:
        load_truth(good)
    message = str(caught.value)
    assert "refraction.k_per_m" in message
    assert "refraction.k_per_metre" in message
    assert "station_bump.probability" in message
    good.write_text(text.replace("uncalibrated_base = 0.0", "uncalibratd_base = 0.0"))
    with pytest.raises(ConfigInvalid, match="uncalibratd_base"):
        load_truth(good)
    with pytest.raises(FileUnreadable):
        load_truth(tmp_path / "missing.sim.toml")
