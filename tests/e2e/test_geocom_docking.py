"""The laboratory cell with its tracker behind GeoCOM: a whole docking, both faces compared, settings written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from docking.config.instruments import AirConfig, GeocomConfig
from docking.state import State
from sim.tracker.geocom_head import Air
from sim.virtual_time import run_virtual
from tests.support.dry_cell import DryCell


def test_a_cell_docks_with_a_station_that_speaks_geocom(tmp_path: Path) -> None:
    air = AirConfig(pressure_hpa=985.0, dry_c=22.0, wet_c=15.0)
    geocom = GeocomConfig(checksum=True, prism_mm=-17.5, air=air)

    async def main() -> DryCell:
        run = DryCell("lab-can", 3, tmp_path / "run.jsonl")
        tracker = run.cell.tracker.model_copy(update={"protocol": "geocom", "two_face": True, "geocom": geocom})
        run.cell = run.cell.model_copy(update={"tracker": tracker})
        await run.build()
        # Prism and air of the hall are those of the cell file: the distances are right only when both were written.
        run.tracker.head.true_prism_mm, run.tracker.head.true_air = -17.5, Air(985.0, 22.0, 15.0)
        await run.dock()
        return run

    run = run_virtual(main)
    assert run.state is State.DOCKED, run.alarms()
    assert float(np.max(run.far.plant.true_feature_errors_mm())) < 0.2
    assert run.records("two_face")
