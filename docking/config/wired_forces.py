"""Load cells that are wired to I/O modules instead of to their axes' own controllers."""

from __future__ import annotations

from docking.config.cell import CellFile
from docking.config.inputs import ForceInput


def wired_forces(cell: CellFile) -> tuple[ForceInput, ...]:
    """The load cells on I/O modules; empty where there are none."""
    return cell.inputs.forces if cell.inputs is not None else ()


def load_cell_ranges_n(cell: CellFile) -> tuple[float, float, float]:
    """Ranges (N) of the load cells along the three axes, NaN where the cell has none."""
    return cell.load_cells.range_n if cell.load_cells is not None else (float("nan"),) * 3


def as_axes_know_it(cell: CellFile) -> CellFile:
    """The cell as its axis controllers know it: a load cell on an I/O module is none of theirs."""
    elsewhere = {force.positioner for force in wired_forces(cell)}
    if not elsewhere:
        return cell
    stations = [p.model_copy(update={"load_cell": False}) if p.name in elsewhere else p for p in cell.positioners]
    return cell.model_copy(update={"positioners": tuple(stations)})
