"""Every limit of the monitors is the cell file's own: none is swapped with another or scaled on its way."""

from __future__ import annotations

from dataclasses import fields

import pytest

from docking.config.load import load_cell
from docking.motion.monitors.build import watch_limits
from docking.motion.monitors.limits import WatchLimits
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
