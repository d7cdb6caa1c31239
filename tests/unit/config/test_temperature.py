"""A stated temperature grows all of a part: targets, features, balls, outline, and the mate by its own."""

from pathlib import Path

import numpy as np
import pytest

from docking.config import CellFile, JobFile
from docking.config.build import mate_settings, positioners_from
from docking.config.load import default_job_path, load_cell, load_job
from docking.config.nominal import feature_points, mate_feature_points, target_points
from docking.types import Array

CELLS = Path(__file__).parents[3] / "sim" / "cells"
PART_K, MATE_K = 4.0, -3.0


def at(job: JobFile, cell: CellFile, part_k: float, mate_k: float) -> JobFile:
    """The job with both bodies so much warmer than the cell's reference, and with one expansion."""
    warm = {
        name: body.model_copy(update={"temperature_c": cell.temperature_c + by_k, "expansion_per_k": 20e-6})
        for name, body, by_k in (("component", job.component, part_k), ("mate", job.mate, mate_k))
    }
    return job.model_copy(update=warm)


@pytest.fixture(scope="module")
def loaded() -> tuple[CellFile, JobFile, JobFile]:
    """A cell with its job at the reference temperature, and with a warm component and a cold mate."""
    cell = load_cell(CELLS / "fuselage-can.toml")
    job = load_job(default_job_path(CELLS / "fuselage-can.toml"), cell)
    return cell, at(job, cell, 0.0, 0.0), at(job, cell, PART_K, MATE_K)


def grown(warm: Array, plain: Array, by_k: float) -> None:
    assert np.max(np.abs(plain)) > 500.0
    assert np.allclose(warm, plain * (1.0 + 20e-6 * by_k), rtol=0.0, atol=1e-9)


def test_targets_grow_and_their_reflectors_do_not(loaded: tuple[CellFile, JobFile, JobFile]) -> None:
    cell, plain, warm = loaded
    for a, b, by_k in ((plain.component, warm.component, PART_K), (plain.mate, warm.mate, MATE_K)):
        nests = np.array([t.xyz_mm for t in a.targets])
        offsets = target_points(a.targets, a, cell).xyz_mm - nests
        assert np.max(np.abs(offsets)) > 1.0
        grown(target_points(b.targets, b, cell).xyz_mm - offsets, nests, by_k)


def test_features_grow_each_with_its_own_side(loaded: tuple[CellFile, JobFile, JobFile]) -> None:
    cell, plain, warm = loaded
    component, mate = (
        (feature_points(job.component, cell).xyz_mm, mate_feature_points(job.component, job.mate, cell).xyz_mm)
        for job in (warm, plain)
    )
    grown(component[0], mate[0], PART_K)
    grown(component[1], mate[1], MATE_K)


def test_balls_and_outline_grow_with_the_component_and_the_envelope_with_the_mate(
    loaded: tuple[CellFile, JobFile, JobFile],
) -> None:
    cell, plain, warm = loaded
    grown(positioners_from(cell, warm).balls_C_mm, positioners_from(cell, plain).balls_C_mm, PART_K)
    hot, cold = mate_settings(cell, warm), mate_settings(cell, plain)
    grown(hot.edges_C_mm, cold.edges_C_mm, PART_K)
    grown(hot.face_C_mm, cold.face_C_mm, PART_K)
    grown(hot.boxes_M_mm, cold.boxes_M_mm, MATE_K)
