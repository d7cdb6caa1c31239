"""The a-priori sigma of the features against the run-time sigma of real fits, and against drawn errors."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from docking.config import CellFile, JobFile
from docking.config.budget import docked_pose, feature_budget, least_risk, noise_of
from docking.config.job import Component, Mate
from docking.config.load import default_job_path, load_cell, load_job
from docking.config.nominal import feature_points, mate_feature_points, target_points
from docking.geometry import pose_from_vector
from docking.pose.features import Budget, Features, feature_errors
from docking.pose.fit import fit_pose
from docking.pose.settings import FitSettings
from docking.types import Array, Fit, Pose, Screened

CELLS = Path(__file__).parents[3] / "sim" / "cells"
PASSES = 2


def load(name: str) -> tuple[CellFile, JobFile]:
    path = CELLS / f"{name}.toml"
    cell = load_cell(path)
    return cell, load_job(default_job_path(path), cell)


def fit(
    cell: CellFile, part: Component | Mate, X_WN: Pose, rng: np.random.Generator | None, growth: float = 0.0
) -> Fit:
    """Fit of readings of the part standing at X_WN and grown by `growth`; with `rng` noise and nests are drawn too."""
    nominal = target_points(part.targets, part, cell)
    X_WT = pose_from_vector(cell.tracker.station_pose)
    at_T = (X_WT.inverse() @ X_WN).apply(nominal.xyz_mm)
    cov = X_WT.R @ noise_of(cell).covariance(at_T) @ X_WT.R.T / PASSES
    built = nominal.xyz_mm * (1.0 + growth) + (0.0 if rng is None else drawn(nominal.cov_mm2, rng))
    measured = X_WN.apply(built) + (0.0 if rng is None else drawn(cov, rng))
    rows = Screened(nominal.names, nominal.xyz_mm, nominal.cov_mm2, measured, cov)
    return fit_pose(rows, FitSettings(expansion_sigma=part.expansion_per_k * part.temperature_sigma_k))


def drawn(cov: Array, rng: np.random.Generator) -> Array:
    return np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=(len(cov), 3)))


def tightened(job: JobFile, sigmas: float, cell: CellFile) -> JobFile:
    """The job with every tolerance at so many of its feature's sigmas."""
    budgets = feature_budget(cell, job, PASSES)
    parts = zip(job.component.features, budgets, strict=True)
    narrow = tuple(f.model_copy(update={"tolerance_mm": sigmas * b.sigma_mm}) for f, b in parts)
    return job.model_copy(update={"component": job.component.model_copy(update={"features": narrow})})


@pytest.mark.parametrize("name", ["fuselage-can", "wing-modbus", "lab-can"])
def test_expected_sigma_and_risk_are_those_a_fit_will_state(name: str) -> None:
    cell, job = load(name)
    job = tightened(job, 2.5, cell)
    parts = job.component.features
    features = Features(
        tuple(f.name for f in parts),
        feature_points(job.component, cell).xyz_mm,
        mate_feature_points(job.component, job.mate, cell).xyz_mm,
        np.array([f.sigma_mm for f in parts]),
        np.array([f.mate_sigma_mm for f in parts]),
        np.array([f.tolerance_mm for f in parts]),
    )
    component = fit(cell, job.component, docked_pose(cell, job), None)
    mate = fit(cell, job.mate, pose_from_vector(job.mate.pose), None)
    drift_mm = cell.tracker.drift_um_per_h * 1e-3 / 12.0
    stated = feature_errors(component, mate, features, Budget(drift_mm, None, None))
    assert_allclose(stated.norm_mm, 0.0, atol=1e-9)
    expected = [b.sigma_mm for b in feature_budget(cell, job, PASSES)]
    assert_allclose(expected, stated.sigma_mm, rtol=1e-6)
    assert 0.01 < stated.risk < 0.3
    assert least_risk(cell, job, PASSES) == pytest.approx(stated.risk, abs=2e-4)


def test_the_least_risk_counts_three_directions_and_all_features() -> None:
    """Features that err alone and alike in three directions: 1 - P(chi2_3 <= k^2)^f, far over the 4.6 % of one."""
    cell, job = load("lab-can")
    alone = tuple(f.model_copy(update={"sigma_mm": 5.0, "mate_sigma_mm": 5.0}) for f in job.component.features)
    job = job.model_copy(update={"component": job.component.model_copy(update={"features": alone})})
    expected = 1.0 - chi2(3).cdf(2.5**2) ** len(alone)
    assert least_risk(cell, tightened(job, 2.5, cell), PASSES) == pytest.approx(expected, abs=0.02)
    assert least_risk(cell, tightened(job, 6.0, cell), PASSES) == 0.0


def test_expected_sigma_is_the_scatter_of_drawn_errors() -> None:
    """600 drawn fuselage measurements: noise, nests as built, temperatures; the parts left out are subtracted."""
    cell, job = load("fuselage-can")
    rng = np.random.default_rng(3)
    X_WC, X_WM = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    f_C = feature_points(job.component, cell).xyz_mm
    f_M = mate_feature_points(job.component, job.mate, cell).xyz_mm
    draws = []
    for _ in range(600):
        e_c = rng.normal() * job.component.expansion_per_k * job.component.temperature_sigma_k
        e_m = rng.normal() * job.mate.expansion_per_k * job.mate.temperature_sigma_k
        component, mate = fit(cell, job.component, X_WC, rng, e_c), fit(cell, job.mate, X_WM, rng, e_m)
        missed_c = component.predict(f_C) - X_WC.apply(f_C * (1.0 + e_c))
        missed_m = mate.predict(f_M) - X_WM.apply(f_M * (1.0 + e_m))
        draws.append(missed_c - missed_m)
    errors = np.array(draws)
    for i, budget in enumerate(feature_budget(cell, job, PASSES)):
        parts = dict(budget.parts_mm)
        left_out = parts["station drift"] ** 2 + parts["as-built nominal of the features"] ** 2
        scatter = np.sqrt(np.linalg.eigvalsh(np.cov(errors[:, i].T))[-1])
        assert_allclose(np.sqrt(budget.sigma_mm**2 - left_out), scatter, rtol=0.1)


def test_a_part_without_expansion_has_no_thermal_part() -> None:
    cell, job = load("lab-can")
    component = job.component.model_copy(update={"expansion_per_k": 0.0})
    mate = job.mate.model_copy(update={"expansion_per_k": 0.0})
    rigid = job.model_copy(update={"component": component, "mate": mate})
    for budget in feature_budget(cell, rigid, PASSES):
        assert dict(budget.parts_mm)["thermal expansion"] == 0.0


def test_more_passes_lower_the_noise_alone() -> None:
    cell, job = load("wing-modbus")
    few, many = feature_budget(cell, job, 2)[0], feature_budget(cell, job, 8)[0]
    assert many.sigma_mm < few.sigma_mm
    assert dict(many.parts_mm)["station drift"] == dict(few.parts_mm)["station drift"]
    assert few.largest[0] == "instrument noise on the mate"
