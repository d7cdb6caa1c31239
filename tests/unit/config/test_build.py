"""What the stages take is what the files say, in the units of the inside."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from docking.config import CellFile, JobFile
from docking.config.build import (
    convergence_settings,
    guard_settings,
    load_from,
    plan_period_s,
    plan_settings,
    positioners_from,
    rank_settings,
)
from docking.kinematics import conditioning, socket_positions

CELLS = Path(__file__).parents[3] / "sim" / "cells"


def files(name: str) -> tuple[CellFile, JobFile]:
    def text(path: Path) -> str:
        return json.dumps(tomllib.loads(path.read_text("utf-8")))

    return (
        CellFile.model_validate_json(text(CELLS / f"{name}.toml")),
        JobFile.model_validate_json(text(CELLS / f"{name}.job.toml")),
    )


@pytest.mark.parametrize(
    "name",
    ["fuselage-can", "fuselage-modbus", "follower-can", "follower-force-can", "wing-modbus", "lab-can", "lab-modbus"],
)
def test_geometry_is_that_of_the_files(name: str) -> None:
    cell, job = files(name)
    positioners = positioners_from(cell, job)
    for i, station in enumerate(cell.positioners):
        for j, axis in enumerate(station.axes):
            q = np.zeros(len(cell.axis_names))
            q[3 * i + j] = 10.0
            socket = np.array(station.origin_mm) + 10.0 * np.array(axis.direction)
            np.testing.assert_allclose(socket_positions(positioners, q)[i], socket, atol=1e-9)
            assert positioners.a_quick_mm_s2[3 * i + j] == axis.a_quick_mm_s2
            assert tuple(positioners.stroke_mm[3 * i + j]) == axis.stroke_mm
        ball = next(b for b in job.component.balls if b.positioner == station.name)
        np.testing.assert_allclose(positioners.balls_C_mm[i], ball.xyz_mm, rtol=1e-3)
    assert positioners.driven.tolist() == list(cell.driven)
    assert conditioning(positioners, rank_settings(cell)).full_rank


def test_units_of_the_inside() -> None:
    cell, job = files("fuselage-can")
    assert positioners_from(cell, job).swivel_rad[0] == pytest.approx(np.pi * cell.positioners[0].swivel_deg / 180)
    assert guard_settings(cell).first_rad == pytest.approx(np.pi * cell.limits.first_correction_deg / 180)
    assert load_from(cell, job).gravity_m_s2 == pytest.approx([0.0, 0.0, -9.80665])
    assert load_from(cell, job).heaviest_n[2] == pytest.approx(
        -9.80665 * (job.component.mass_kg + job.component.mass_tolerance_kg)
    )
    assert convergence_settings(cell, job).max_passes == job.measuring.max_passes


def test_only_own_clocks_have_skew() -> None:
    can, queued = files("fuselage-can"), files("fuselage-modbus")
    streamed, played = plan_settings(*can), plan_settings(*queued)
    assert (streamed.start_skew_s, streamed.clock_ppm, streamed.playback_ramp_s) == (0.0, 0.0, 0.0)
    bus = queued[0].bus
    assert bus.kind == "modbus-tcp"
    assert (played.start_skew_s, played.clock_ppm) == (bus.start_skew_s, bus.clock_ppm)
    assert played.playback_ramp_s == bus.ramp_s
    assert (plan_period_s(can[0]), plan_period_s(queued[0])) == (0.01, bus.segment_s)
