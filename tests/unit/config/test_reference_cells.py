"""The seven reference cells load, check clean and are what docs/mechanics.md says."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from docking.config import CellFile, JobFile
from docking.config.budget import docked_pose, feature_budget
from docking.config.build import load_from, positioners_from
from docking.config.check import check_cell, check_files, check_job
from docking.config.load import default_job_path, load_cell, load_job
from docking.config.nominal import target_points
from docking.config.support import stage_positions
from docking.geometry import pose_from_vector
from docking.kinematics.forces import ball_reactions_n

CELLS = Path(__file__).parents[3] / "sim" / "cells"
NAMES = (
    "fuselage-can",
    "fuselage-modbus",
    "follower-can",
    "follower-force-can",
    "wing-modbus",
    "lab-can",
    "lab-modbus",
)


def load(name: str) -> tuple[CellFile, JobFile]:
    path = CELLS / f"{name}.toml"
    cell = load_cell(path)
    return cell, load_job(default_job_path(path), cell)


@pytest.mark.parametrize("name", NAMES)
def test_cell_and_job_are_clean_without_warnings(name: str) -> None:
    cell, job = load(name)
    assert cell.name == name
    assert check_cell(cell) + check_job(cell, job) == []


@pytest.mark.parametrize("name", NAMES)
def test_docked_axes_stand_at_zero_but_for_the_sink(name: str) -> None:
    cell, job = load(name)
    q = stage_positions(cell, job).reshape(len(job.stages), -1, 3)
    weight_per_ball = job.component.mass_kg * 9.80665 / len(cell.positioners)
    sink = weight_per_ball / cell.positioners[0].stiffness_n_per_mm[2]
    assert_allclose(q[-1, :, :2], 0.0, atol=5e-3)
    assert np.all(q[-1, :, 2] > 0.6 * sink)
    assert np.all(q[-1, :, 2] < 1.4 * sink)
    first = job.stages[0].standoff_mm
    assert_allclose(q[0, :, 0], -first, atol=0.05)


@pytest.mark.parametrize("name", NAMES)
def test_even_the_first_fit_leaves_room_for_an_error(name: str) -> None:
    cell, job = load(name)
    for budget in feature_budget(cell, job, job.measuring.passes):
        assert 2.0 * budget.sigma_mm < 0.6 * budget.tolerance_mm


@pytest.mark.parametrize("name", NAMES)
def test_every_swap_of_two_targets_changes_a_distance_visibly(name: str) -> None:
    """A swapped pair must not be explained by a rigid motion: some distance changes by far more than the noise."""
    cell, job = load(name)
    for part in (job.component, job.mate):
        xyz = target_points(part.targets, part, cell).xyz_mm
        distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
        for i, j in combinations(range(len(xyz)), 2):
            order = np.arange(len(xyz))
            order[[i, j]] = j, i
            assert np.abs(distance - distance[np.ix_(order, order)]).max() > (20.0 if "lab" not in name else 5.0)


@pytest.mark.parametrize("name", NAMES)
def test_tracker_stands_outside_and_sees_the_side_of_the_targets(name: str) -> None:
    cell, job = load(name)
    station = pose_from_vector(cell.tracker.station_pose).t_mm
    X_WC, X_WM = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    for part, X in ((job.component, X_WC), (job.mate, X_WM)):
        at = X.apply(target_points(part.targets, part, cell).xyz_mm)
        normal = np.array([t.normal for t in part.targets]) @ X.R.T
        assert np.all(np.einsum("ni,ni->n", station - at, normal) > 0.0)
    away = float(np.linalg.norm(station - X_WC.apply(job.component.docking_face_mm)))
    assert 2500.0 < away < 4000.0 if "lab" in name else 8000.0 < away < 12500.0


def test_fuselage_reactions_are_those_of_the_reference() -> None:
    """A 10.1 B 16.0 C 19.3 D 13.4 kN (docs/mechanics.md, RC-1)."""
    cell, job = load("fuselage-can")
    positioners, load_on = positioners_from(cell, job), load_from(cell, job)
    docked = docked_pose(cell, job)
    balls, com = docked.apply(positioners.balls_C_mm), docked.apply(load_on.com_C_mm)
    up = ball_reactions_n(positioners, balls, com, load_on.mass_kg * load_on.gravity_m_s2)[0][:, 2]
    assert_allclose(up, [10100.0, 16000.0, 19300.0, 13400.0], atol=60.0)


def test_follower_has_seven_driven_axes_and_only_x_and_y_follow() -> None:
    cell, _ = load("follower-can")
    driven = [name for name, on in zip(cell.axis_names, cell.driven, strict=True) if on]
    assert driven == ["A.X", "A.Y", "A.Z", "B.Y", "B.Z", "C.Z", "D.Z"]


def test_wing_docks_turned_by_90_degrees() -> None:
    cell, job = load("wing-modbus")
    X_WC = docked_pose(cell, job)
    assert_allclose(X_WC.R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-9)
    assert_allclose(X_WC.apply(job.component.docking_face_mm), pose_from_vector(job.mate.pose).t_mm, atol=1e-9)


@pytest.mark.parametrize(("can", "modbus"), [("fuselage-can", "fuselage-modbus"), ("lab-can", "lab-modbus")])
def test_both_buses_carry_the_same_mechanics_and_job(can: str, modbus: str) -> None:
    (a, job_a), (b, job_b) = load(can), load(modbus)
    assert job_a == job_b
    assert a.tracker == b.tracker
    # Only the bus decides how many read-backs may be missed and how late a control cycle may be.
    by_the_bus = {key: getattr(a.limits, key) for key in ("missing_cycles", "tick_late_cycles")}
    assert a.limits == b.limits.model_copy(update=by_the_bus)
    for one, other in zip(a.positioners, b.positioners, strict=True):
        bus_keys = {"host": None, "port": None, "unit": None}
        bare = tuple(axis.model_copy(update={"node": None, "serial_number": None}) for axis in one.axes)
        assert one.model_copy(update={"axes": bare}) == other.model_copy(update=bus_keys)


def test_check_says_what_drives_what_carries_and_what_is_proved() -> None:
    result = check_files(CELLS / "follower-can.toml")
    for words in ("12, 7 driven, redundancy 1", "B.X, C.X, C.Y, D.X, D.Y", "19.29", "no warnings", "right"):
        assert words in result.text
    body = result.as_json()
    assert body["ok"] is True
    assert len(body["driven"]) == 7
    assert {f["name"] for f in body["features"]} == {"top", "bottom", "left", "right"}
    assert len(body["cell"]["sha256"]) == 64
