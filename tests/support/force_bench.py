"""One three-component load cell under positioner B on a simulated I/O module, and the driver that reads it."""

from __future__ import annotations

from typing import Any

import numpy as np

from docking.config.inputs import CanModule, ForceInput, InputsConfig, ModbusModule
from drivers.inputs import InputModule
from drivers.load_cells import AnalogueLoadCells
from tests.support.module_bench import ModuleBench

MODULE, NAME, NODE = "force_B", "cell_B", 42
_MODULES = {
    "cia401": CanModule(kind="cia401", name=MODULE, node=NODE, refresh_s=0.01),
    "modbus-io": ModbusModule(kind="modbus-io", name=MODULE, host="127.0.0.1", port=15042),
}


class Loaded:
    """A plant with forces of a test's own (12,), N."""

    def __init__(self) -> None:
        self.forces_n = np.zeros(12)

    def force_n(self) -> Any:
        return self.forces_n

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        return dict.fromkeys(("component", "mate", "floor"), 20.0)


class ForceBench(ModuleBench[AnalogueLoadCells]):
    """The module of one kind, what pulls at its load cell, and what may be done to it."""

    def __init__(self, kind: str, counts: tuple[int, int] = (5530, 27648)) -> None:
        force = ForceInput(name=NAME, positioner="B", module=MODULE, channels=(0, 2, 3), counts=counts)
        super().__init__(InputsConfig(modules=(_MODULES[kind],), forces=(force,)), Loaded())

    def driver(self, module: InputModule) -> AnalogueLoadCells:
        return AnalogueLoadCells(self.cell, {MODULE: module})

    def pull(self, x_n: float, y_n: float, z_n: float) -> None:
        """Load on the axes B.X, B.Y, B.Z."""
        self.plant.forces_n = np.concatenate((np.zeros(3), (x_n, y_n, z_n), np.zeros(6)))

    def current(self, ma: float | None) -> None:
        """The transmitters drive this current; None: the load's."""
        self.world.free_current(NAME) if ma is None else self.world.force_current(NAME, ma)

    def tear(self, torn: bool) -> None:
        self.world.break_sensor(NAME, torn)
