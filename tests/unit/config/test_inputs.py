"""The inputs of a cell file: what is refused by name, and what temperature sensors make of a job."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.config.cell import CellFile
from docking.config.findings import Severity
from docking.config.input_checks import input_findings
from docking.config.inputs import InputsConfig
from docking.config.load import load_cell, load_job
from docking.config.temperatures import part_temperatures, with_temperatures

CELLS = Path(__file__).parents[3] / "sim" / "cells"


def lab(name: str = "lab-can") -> CellFile:
    return load_cell(CELLS / f"{name}.toml")


def changed(cell: CellFile, group: str, index: int, **changes: Any) -> CellFile:
    items = list(getattr(cell.inputs, group))
    items[index] = items[index].model_copy(update=changes)
    return cell.model_copy(update={"inputs": cell.inputs.model_copy(update={group: tuple(items)})})


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_reference_cells_have_clean_inputs(name):
    assert input_findings(lab(name)) == []
    assert input_findings(lab("fuselage-can")) == []


@pytest.mark.parametrize(
    ("group", "index", "changes", "key", "words"),
    [
        ("modules", 0, {"node": 3}, "inputs.modules[0].node", "axis A.Z"),
        ("modules", 0, {"node": 127}, "inputs.modules[0].node", "the controller"),
        ("digital", 3, {"module": "io9"}, "inputs.digital[3].module", "not a module (io1)"),
        ("digital", 3, {"channel": 5}, "inputs.digital[4].channel", "inputs.digital[3].channel has the same"),
        ("digital", 3, {"name": "gate"}, "inputs.digital[3].name", "duplicate"),
        ("digital", 3, {"name": "crane"}, "inputs.digital[3].name", "not in permissives"),
        ("digital", 3, {"use": "protective-stop"}, "inputs.digital[3].use", "permissive"),
        ("digital", 0, {"use": "limit-switch"}, "inputs.digital[0].axis", "needs one"),
        ("digital", 0, {"use": "limit-switch", "axis": "Q.X"}, "inputs.digital[0].axis", "'Q.X'"),
        ("digital", 0, {"axis": "A.X"}, "inputs.digital[0].axis", "belongs to no axis"),
        ("digital", 0, {"on": "high"}, "inputs.digital[0].on", "broken wire"),
        ("digital", 3, {"on": "low"}, "inputs.digital[3].on", "broken wire"),
        ("temperatures", 1, {"of": "component"}, "inputs.temperatures[1].of", "same part"),
    ],
)
def test_every_mistake_is_named_with_its_key(group, index, changes, key, words):
    found = [f for f in input_findings(changed(lab(), group, index, **changes)) if f.key == key]
    assert found
    assert any(words in f.text for f in found), found
    levels = {f.severity for f in found}
    assert levels == ({Severity.WARNING} if "broken wire" in words else {Severity.ERROR})


def test_a_canopen_module_needs_a_canopen_bus_and_a_modbus_one_a_name_of_its_own():
    modbus = lab("lab-modbus").model_copy(update={"inputs": lab("lab-can").inputs})
    assert any("CANopen bus" in f.text for f in input_findings(modbus))
    assert any("is a positioner" in f.text for f in input_findings(changed(lab("lab-modbus"), "modules", 0, name="A")))


def test_a_present_sensor_narrows_by_the_weights_and_a_missing_one_adds_its_share():
    cell, job = lab(), load_job(CELLS / "lab-can.job.toml", lab())
    component, mate, floor = part_temperatures(cell, job, {"component_sensor": 21.0, "floor_sensor": 19.0})
    # Stated 20.0 +- 1.5, read 21.0 +- 0.3: the weights are 1/2.25 and 1/0.09.
    assert component.used_c == pytest.approx((20.0 / 2.25 + 21.0 / 0.09) / (1 / 2.25 + 1 / 0.09))
    assert component.used_sigma_k == pytest.approx(1.0 / math.sqrt(1 / 2.25 + 1 / 0.09))
    assert component.used_sigma_k < 0.3
    assert (mate.used_c, mate.used_sigma_k) == (20.0, pytest.approx(math.hypot(1.5, 0.5)))
    assert math.isnan(mate.read_c)
    assert floor.read_c == 19.0
    warm = with_temperatures(job, (component, mate, floor))
    assert (warm.component.temperature_c, warm.mate.temperature_sigma_k) == (component.used_c, mate.used_sigma_k)
    assert warm.stages == job.stages


def test_the_combined_temperature_is_as_good_as_it_says():
    """Drawn truths, statements and readings: the error over its sigma has the spread 1."""
    cell, job = lab(), load_job(CELLS / "lab-can.job.toml", lab())
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(2000):
        true_c = 20.0 + 1.5 * rng.standard_normal()
        read_c = true_c + 0.3 * rng.standard_normal()
        component = part_temperatures(cell, job, {"component_sensor": read_c})[0]
        scores.append((component.used_c - true_c) / component.used_sigma_k)
    assert np.std(scores) == pytest.approx(1.0, abs=0.06)
    assert abs(np.mean(scores)) < 0.08


def test_names_by_use():
    inputs = lab().inputs
    assert isinstance(inputs, InputsConfig)
    assert inputs.names("emergency-stop", "protective-stop") == ("e_stop", "gate")
    assert inputs.names("permissive") == ("crane_free", "ball_locked", "area_clear")
