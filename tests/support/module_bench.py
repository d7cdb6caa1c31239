"""A simulated I/O module of one kind on a bus or behind a TCP port, and the driver that reads it."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

from docking.config.inputs import CanModule, InputsConfig, ModbusModule
from docking.config.load import load_cell
from docking.ports import CanLink
from drivers.canopen.io_module import CanIoModule
from drivers.canopen.shared import SharedCan
from drivers.inputs import InputModule
from drivers.links.can_bus import CanBusLink
from drivers.modbus_inputs import ModbusIoModule
from sim.canopen.io_module import IoModule
from sim.input_world import InputWorld
from sim.plc.io_module import IoRegisters, IoServer
from sim.wires.unix_can import UnixCanServer
from sim.wires.virtual_can import VirtualCan

Driver = TypeVar("Driver")

CELL = Path(__file__).parents[2] / "sim" / "cells" / "lab-can.toml"
KINDS = ("cia401", "modbus-io")


class ModuleBench(ABC, Generic[Driver]):
    """The one module of `inputs`, in the world of `plant`; a subclass says which driver stands above it."""

    def __init__(self, inputs: InputsConfig, plant: Any) -> None:
        self.loop = asyncio.get_running_loop()
        self.inputs, self.plant = inputs, plant
        self.module = inputs.modules[0]
        self.cell = load_cell(CELL).model_copy(update={"inputs": inputs})
        self.world = InputWorld(self.cell, plant, self.loop, 1)
        self.closing: list[Callable[[], Any]] = []

    @abstractmethod
    def driver(self, module: InputModule) -> Driver:
        """What the tests talk to, above the driver of the module itself."""

    async def in_virtual_time(self) -> Driver:
        if isinstance(self.module, ModbusModule):
            return await self.on_tcp(self.module.port)
        bus = VirtualCan(self.loop, 1_000_000)
        return await self.on_can(bus.end(), bus.end())

    async def on_real_wires(self, folder: Path) -> Driver:
        """A bus of AF_UNIX sockets in `folder`, or a free TCP port."""
        if isinstance(self.module, ModbusModule):
            return await self.on_tcp(0)
        server = UnixCanServer(folder / "can0")
        self.closing.append(server.close)
        return await self.on_can(server, CanBusLink("docking-unix", str(folder / "can0"), 1_000_000))

    async def on_can(self, far: Any, near: CanLink) -> Driver:
        """The module at the end `far` of a bus, the driver at `near`."""
        assert isinstance(self.module, CanModule)
        await far.open()
        device = IoModule(self.module.name, self.module.node, self.world, far, self.loop)
        device.start()
        self.closing.insert(0, device.close)
        end = SharedCan(near).end(CanIoModule.cobs(self.module))
        return self.driver(CanIoModule(self.module, end, lambda code: f"{code:08X}h"))

    async def on_tcp(self, port: int) -> Driver:
        """The module behind a TCP port (0: a free one), and its driver."""
        assert isinstance(self.module, ModbusModule)
        server = IoServer(IoRegisters(self.module.name, self.world, self.loop.time), self.module.unit)
        address = await server.serve("127.0.0.1", port)
        self.closing.append(server.close)
        return self.driver(ModbusIoModule(self.module, address))

    def mute(self, muted: bool) -> None:
        self.world.mute(self.module.name, muted)

    async def close(self) -> None:
        for close in self.closing:
            result = close()
            if asyncio.iscoroutine(result):
                await result
