"""One three-component load cell under positioner B on a simulated I/O module, and the driver that reads it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from docking.config.inputs import CanModule, ForceInput, InputsConfig, ModbusModule
from docking.config.load import load_cell
from docking.ports import CanLink
from drivers.canopen.io_module import CanIoModule
from drivers.canopen.shared import SharedCan
from drivers.inputs import InputModule
from drivers.load_cells import AnalogueLoadCells
from drivers.modbus_inputs import ModbusIoModule
from sim.canopen.io_module import IoModule
from sim.input_world import InputWorld
from sim.plc.io_module import IoRegisters, IoServer

CELL = Path(__file__).parents[2] / "sim" / "cells" / "lab-can.toml"
KINDS = ("cia401", "modbus-io")
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


class ForceBench:
    """The module of one kind, what pulls at its load cell, and what may be done to it."""

    def __init__(self, kind: str, counts: tuple[int, int] = (5530, 27648)) -> None:
        self.loop = asyncio.get_running_loop()
        self.plant = Loaded()
        force = ForceInput(name=NAME, positioner="B", module=MODULE, channels=(0, 2, 3), counts=counts)
        self.inputs = InputsConfig(modules=(_MODULES[kind],), forces=(force,))
        self.cell = load_cell(CELL).model_copy(update={"inputs": self.inputs})
        self.world = InputWorld(self.cell, self.plant, self.loop, 1)
        self.closing: list[Callable[[], Any]] = []

    async def on_can(self, far: Any, near: CanLink) -> AnalogueLoadCells:
        """The module at the end `far` of a bus, the driver at `near`."""
        await far.open()
        device = IoModule(MODULE, NODE, self.world, far, self.loop)
        device.start()
        self.closing.insert(0, device.close)
        config = self.inputs.modules[0]
        assert isinstance(config, CanModule)
        end = SharedCan(near).end(CanIoModule.cobs(config))
        return self._cells(CanIoModule(config, end, lambda code: f"{code:08X}h"))

    async def on_tcp(self, port: int) -> AnalogueLoadCells:
        """The module behind a TCP port (0: a free one), and its driver."""
        config = self.inputs.modules[0]
        assert isinstance(config, ModbusModule)
        server = IoServer(IoRegisters(MODULE, self.world, self.loop.time), config.unit)
        address = await server.serve("127.0.0.1", port)
        self.closing.append(server.close)
        return self._cells(ModbusIoModule(config, address))

    def _cells(self, module: InputModule) -> AnalogueLoadCells:
        return AnalogueLoadCells(self.cell, {MODULE: module})

    def pull(self, x_n: float, y_n: float, z_n: float) -> None:
        """Load on the axes B.X, B.Y, B.Z."""
        self.plant.forces_n = np.concatenate((np.zeros(3), (x_n, y_n, z_n), np.zeros(6)))

    def current(self, ma: float | None) -> None:
        """The transmitters drive this current; None: the load's."""
        self.world.free_current(NAME) if ma is None else self.world.force_current(NAME, ma)

    def tear(self, torn: bool) -> None:
        self.world.break_sensor(NAME, torn)

    def mute(self, muted: bool) -> None:
        self.world.mute(MODULE, muted)

    async def close(self) -> None:
        for close in self.closing:
            result = close()
            if asyncio.iscoroutine(result):
                await result
