"""Simulated positioner PLCs on real wires in real time: loopback TCP, and one serial line that is a pseudo-terminal."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from sim.plc.group import PlcGroup
from sim.wires.pty_serial import PtySerial
from tests.support.modbus_cell import StiffPlant, cell

LINE_BAUD = 115200


@asynccontextmanager
async def simulated_plcs() -> AsyncIterator[tuple[StiffPlant, dict[str, tuple[str, int]]]]:
    """Four PLCs A..D (units 1..4) on free loopback ports."""
    plant = StiffPlant()
    group = PlcGroup(plant, cell(), (0.0,) * 4, asyncio.get_running_loop())
    addresses = await group.serve(dict.fromkeys("ABCD", ("127.0.0.1", 0)))
    try:
        yield plant, addresses
    finally:
        await group.close()


@asynccontextmanager
async def simulated_line() -> AsyncIterator[tuple[StiffPlant, str]]:
    """The same four as units 1..4 of one RTU line; the path of the terminal to open."""
    plant = StiffPlant()
    loop = asyncio.get_running_loop()
    group = PlcGroup(plant, cell(), (0.0,) * 4, loop)
    end = PtySerial(loop, LINE_BAUD)
    end.open()
    line = group.serve_line(end, LINE_BAUD)
    try:
        yield plant, end.path
    finally:
        line.close()
        end.close()
        await group.close()
