"""One simulated I/O module with a contact and a temperature sensor, and the driver that reads it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from docking.config.inputs import CanModule, DigitalInput, InputsConfig, ModbusModule, TemperatureInput
from docking.config.load import load_cell
from docking.ports import CanLink
from drivers.canopen.io_module import CanIoModule
from drivers.canopen.shared import SharedCan
from drivers.inputs import WiredInputs
from drivers.modbus_inputs import ModbusIoModule
from sim.canopen.io_module import IoModule
from sim.input_world import InputWorld
from sim.plc.io_module import IoRegisters, IoServer

CELLS = Path(__file__).parents[2] / "sim" / "cells"
MODULE, CONTACT, SENSOR = "io1", "crane_free", "warm"
KINDS = ("cia401", "modbus-io")
NODE = 40
_MODULES = {
    "cia401": CanModule(kind="cia401", name=MODULE, node=NODE),
    "modbus-io": ModbusModule(kind="modbus-io", name=MODULE, host="127.0.0.1", port=15040),
}


class Bathtub:
    """A plant with one temperature."""

    celsius = 23.4

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        return dict.fromkeys(("component", "mate", "floor"), self.celsius)


class InputBench:
    """The module of one kind and what it is wired to."""

    def __init__(self, kind: str) -> None:
        self.loop = asyncio.get_running_loop()
        self.plant = Bathtub()
        self.config = InputsConfig(
            modules=(_MODULES[kind],),
            digital=(DigitalInput(name=CONTACT, module=MODULE, channel=9, debounce_s=0.02),),
            temperatures=(TemperatureInput(name=SENSOR, of="component", module=MODULE, channel=1, sigma_k=1e-6),),
        )
        cell = load_cell(CELLS / "lab-can.toml").model_copy(update={"inputs": self.config})
        self.world = InputWorld(cell, self.plant, self.loop, 1)
        self.closing: list[Callable[[], Any]] = []

    async def on_can(self, far: Any, near: CanLink) -> WiredInputs:
        """The module at the end `far` of a bus, the driver at `near`."""
        await far.open()
        device = IoModule(MODULE, NODE, self.world, far, self.loop)
        device.start()
        self.closing.insert(0, device.close)
        config = self.config.modules[0]
        assert isinstance(config, CanModule)
        end = SharedCan(near).end(CanIoModule.cobs(config))
        return WiredInputs(self.config, {MODULE: CanIoModule(config, end, lambda code: f"{code:08X}h")})

    async def on_tcp(self, port: int) -> WiredInputs:
        """The module behind a TCP port (0: a free one), and its driver."""
        config = self.config.modules[0]
        assert isinstance(config, ModbusModule)
        server = IoServer(IoRegisters(MODULE, self.world, self.loop.time), config.unit)
        address = await server.serve("127.0.0.1", port)
        self.closing.append(server.close)
        return WiredInputs(self.config, {MODULE: ModbusIoModule(config, address)})

    def hold(self, given: bool) -> None:
        self.world.hold(CONTACT, given)

    def warm(self, celsius: float) -> None:
        self.plant.celsius = celsius

    def break_sensor(self, broken: bool) -> None:
        self.world.break_sensor(SENSOR, broken)

    def mute(self, muted: bool) -> None:
        self.world.mute(MODULE, muted)

    async def close(self) -> None:
        for close in self.closing:
            result = close()
            if asyncio.iscoroutine(result):
                await result
