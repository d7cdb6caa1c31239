"""Every limit of the monitors, and the lease, is the cell file's own: none is swapped with another or scaled."""

from __future__ import annotations

from dataclasses import fields

import pytest

from docking.assemble.motion_side import lease_settings, service_settings
from docking.config.build import LOAD_CELL_CYCLES, jam_settings
from docking.config.cell import ModbusBus
from docking.config.load import load_cell
from docking.motion.monitors.build import watch_limits
from docking.motion.monitors.limits import WatchLimits
from drivers.maps.objects import load_object_map
from tests.support.planned_moves import CELLS

IN_THE_FILE = {
    "following_rest_mm": "following_error_rest_mm",
    "following_vmax_mm": "following_error_vmax_mm",
    "overload": "overload_fraction",
    "underload": "underload_fraction",
}
"""Where the monitor's name is not the file's."""
OWN = {"rating"}
"""What no file says."""


@pytest.mark.parametrize("name", [field.name for field in fields(WatchLimits) if field.name not in OWN])
def test_each_limit_is_the_files(name: str) -> None:
    cell = load_cell(CELLS / "lab-can.toml")
    key, value = IN_THE_FILE.get(name, name), 0.123
    changed = cell.model_copy(update={"limits": cell.limits.model_copy(update={key: value})})
    assert getattr(watch_limits(changed), name) == value
    others = {field.name for field in fields(WatchLimits)} - {name}
    before, after = watch_limits(cell), watch_limits(changed)
    assert all(getattr(before, other) == getattr(after, other) for other in others)


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_lease_and_the_limit_of_lateness_are_the_files(name: str) -> None:
    cell = load_cell(CELLS / f"{name}.toml")
    cell = cell.model_copy(update={"motion": cell.motion.model_copy(update={"lease_s": 0.3, "feedback_s": 0.07})})
    served, owed = service_settings(cell), lease_settings(cell)
    assert (served.lease_s, served.feedback_s) == (owed.lease_s, owed.feedback_s) == (0.3, 0.07)
    if isinstance(cell.bus, ModbusBus):
        assert served.late_limit_s == 0.5 * cell.bus.watchdog_s
    else:
        assert served.late_limit_s == cell.limits.tick_late_cycles * cell.bus.cycle_s
        assert served.sync_error_mm == cell.limits.sync_error_mm


def test_load_cells_report_as_often_as_the_planner_counts_on() -> None:
    assert load_object_map("cia402").pdos["force"].transmission == LOAD_CELL_CYCLES


def test_the_planner_counts_on_the_limits_that_the_monitors_have() -> None:
    cell = load_cell(CELLS / "lab-can.toml")
    jam, watch = jam_settings(cell), watch_limits(cell)
    assert (jam.stuck_mm, jam.passive_mm) == (watch.stuck_mm, watch.passive_mm)
    assert (jam.force_n, jam.warp_n) == (watch.internal_force_n, watch.warp_force_n)
    assert jam.held_warp_n == watch.measured_warp_n
    assert jam.residual_mm == watch.ball_residual_mm
    assert jam.sampled_s == cell.bus.cycle_s
