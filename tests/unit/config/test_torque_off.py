"""What `docking check` says of a single axis's error and of torque off, against the numbers of docs/mechanics.md."""

from __future__ import annotations

from pathlib import Path

import pytest

from docking.config import CellFile, JobFile
from docking.config.check import check_files
from docking.config.load import load_cell, load_job
from docking.config.torque_off import detectability, strain_text, torque_off

CELLS = Path(__file__).parents[3] / "sim" / "cells"


def files(name: str) -> tuple[CellFile, JobFile]:
    cell = load_cell(CELLS / f"{name}.toml")
    return cell, load_job(CELLS / f"{name}.job.toml", cell)


def changed(cell: CellFile, **of_positioners: object) -> CellFile:
    return cell.model_copy(update={"positioners": tuple(p.model_copy(update=of_positioners) for p in cell.positioners)})


def test_a_single_axis_shows_its_share_at_the_balls() -> None:
    """RC-1: 0.83, 0.75, 0.50 of itself over all balls; 5 kN of warp a millimetre of a vertical axis."""
    rows = {row.kind: row for row in detectability(*files("fuselage-can"))}
    assert [rows[k].all_balls for k in "XYZ"] == pytest.approx([0.83, 0.75, 0.50], abs=0.01)
    assert [rows[k].worst_ball for k in "XYZ"] == pytest.approx([0.69, 0.58, 0.25], abs=0.01)
    assert rows["Z"].warp_n == pytest.approx(20000.0 / 4.0, rel=1e-3)
    assert rows["X"].force_n == pytest.approx(14000.0, rel=0.02)


def test_what_only_one_axis_drives_shows_nothing() -> None:
    rows = {row.kind: row for row in detectability(*files("follower-can"))}
    assert rows["X"].worst_ball < 1e-3
    assert rows["Z"].worst_ball == pytest.approx(0.25, abs=0.01)


def test_encoders_of_axes_that_follow_show_the_error_of_one_that_leads() -> None:
    """Where the axis errs, the part goes with it, and the others' encoders show that as if they all led."""
    whole = {row.kind: row.seen for row in detectability(*files("fuselage-can"))}
    assert [whole[k] for k in "XYZ"] == pytest.approx([0.69, 0.58, 0.25], abs=0.01)
    for name in ("follower-can", "follower-force-can"):
        assert {row.kind: row.seen for row in detectability(*files(name))} == pytest.approx(whole, abs=0.01)
    told = {name: "\n".join(strain_text(*files(name))) for name in ("follower-force-can", "wing-modbus")}
    assert "tracker alone" not in told["follower-force-can"]
    # Three balls: whatever height the three vertical axes say, some attitude has it.
    assert "an encoder of Z that errs: the tracker alone" in told["wing-modbus"]


def test_a_held_force_is_a_held_position_once_its_brake_has_closed() -> None:
    """Six axes lead: nothing strains the part in a move. In a stop of category 0 four brakes close, as in RC-1."""
    held, leading = (torque_off(*files(name)) for name in ("follower-force-can", "fuselage-can"))
    assert held is not None
    assert leading is not None
    assert held.all_force_n == pytest.approx(leading.all_force_n, rel=0.01)
    assert held.one_force_n == pytest.approx(12500.0, rel=0.01)
    assert held.needs_ss1


def test_torque_off_of_one_and_of_all_axes() -> None:
    """0.5 m/s^2 for 50 to 100 ms: 0.625 to 2.5 mm; one axis alone 2.5 x 5 kN; all with brakes at different times: two
    opposite corners 1.875 mm lower than the others, half of it each way."""
    cell, job = files("fuselage-can")
    off = torque_off(cell, job)
    assert off is not None
    assert off.fall_mm == pytest.approx((0.625, 2.5))
    assert off.axis.endswith(".Z")
    assert (off.one_residual_mm, off.one_force_n) == (pytest.approx(0.625, rel=0.01), pytest.approx(12500.0, rel=0.01))
    assert off.all_residual_mm == pytest.approx(0.5 * (2.5 - 0.625), rel=0.01)
    assert off.all_force_n == pytest.approx(0.5 * (2.5 - 0.625) * 20000.0, rel=0.01)
    assert off.needs_ss1
    assert "SS1" in "\n".join(strain_text(cell, job))


def test_brakes_of_one_time_drop_the_part_straight() -> None:
    cell, job = files("fuselage-can")
    together = torque_off(changed(cell, brake_s=(0.1, 0.1)), job)
    assert together is not None
    assert together.all_force_n < 100.0
    holding = changed(cell, back_drive_m_s2=0.0)
    assert torque_off(holding, job) is None
    assert "SS1" not in "\n".join(strain_text(holding, job))
    quick = torque_off(changed(cell, back_drive_m_s2=0.01), job)
    assert quick is not None
    assert not quick.needs_ss1


def test_the_check_says_so_to_people_and_programs() -> None:
    result = check_files(CELLS / "fuselage-can.toml")
    told = result.as_json()
    assert (told["redundancy"], told["category_0"]["needs_ss1"]) == (6, True)
    assert told["condition"] < 50.0
    assert [row["kind"] for row in told["detectability"]] == ["X", "Y", "Z"]
    assert "redundancy 6" in result.text
    assert "category-0 stop" in result.text
