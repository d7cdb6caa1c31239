"""The port of queued axes: the same checks on the fake, on simulated PLCs in virtual time (TCP and one serial line),
over loopback TCP and a pty, and (without power) on hardware."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.config.cell import CellFile
from docking.config.load import load_cell
from drivers.links.serial_port import SerialPort
from drivers.modbus_positioners import ModbusPositioners
from sim.plc.group import PlcGroup
from sim.virtual_time import run_virtual
from sim.wires.pty_serial import PtySerial
from sim.wires.virtual_serial import VirtualSerial
from tests.conformance.queued_checks import CHECKS, UNPOWERED, Queued
from tests.fakes.positioners import FakeControllers
from tests.support.modbus_cell import StiffPlant, cell

Check = Callable[[Queued], Awaitable[None]]
BAUD = 115200
LINE = {
    "kind": "modbus-rtu",
    "line": "/dev/line",
    "baud": BAUD,
    "poll_s": 0.1,
    "segment_s": 0.1,
    "watchdog_s": 0.5,
}
IN_REAL_TIME = {"timeout_s": 0.3, "watchdog_s": 1.0}
"""Devices and driver share a computer with other work: either may be kept from it for a while."""
UNCUT = {"tells_a_broken_connection_at_once"}
"""A line has no connections."""

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
kinds = pytest.mark.parametrize("kind", ["tcp", "rtu"])


def _group(cell_file: CellFile) -> PlcGroup:
    return PlcGroup(StiffPlant(), cell_file, (0.0,) * 4, asyncio.get_running_loop())


def _subject(axes: ModbusPositioners, group: PlcGroup, *, line: bool) -> Queued:
    def mute(positioner: str, muted: bool) -> None:
        faults = group.faults[positioner]
        faults.lose_requests() if muted else faults.heal("lose_requests")

    return Queued(axes, mute, None if line else group.drop_connections)


@checks
def test_the_fake(check: Check) -> None:
    async def main() -> None:
        fake = FakeControllers(cell().axis_names, np.zeros(12))
        await check(Queued(fake, fake.mute, fake.cut))
        await fake.close()

    run_virtual(main)


@checks
@kinds
def test_the_simulated_controllers_in_virtual_time(check: Check, kind: str) -> None:
    if kind == "rtu" and check.__name__ in UNCUT:
        pytest.skip("a serial line has no connections to break")

    async def main() -> None:
        cell_file = cell(**LINE) if kind == "rtu" else cell()
        group = _group(cell_file)
        if kind == "rtu":
            wire = VirtualSerial(asyncio.get_running_loop(), BAUD)
            group.serve_line(wire.far, BAUD)
            axes = ModbusPositioners(cell_file, link=wire.near)
        else:
            axes = ModbusPositioners(cell_file, await group.serve())
        await check(_subject(axes, group, line=kind == "rtu"))
        await axes.close()
        await group.close()

    run_virtual(main)


QUICK_ON_A_LINE = {
    "says_who_is_there_and_enables_nothing",
    "survives_calls_that_are_given_up",
    "plays_a_plan_to_its_end",
}


def wired_cases() -> list[Any]:
    """All checks on both wires; on the slow one in real time a few, the others in full only."""
    return [
        pytest.param(
            check,
            kind,
            id=f"{kind}-{check.__name__}",
            marks=[pytest.mark.full] if kind == "rtu" and check.__name__ not in QUICK_ON_A_LINE else [],
        )
        for kind in ("tcp", "rtu")
        for check in CHECKS
        if not (kind == "rtu" and check.__name__ in UNCUT)
    ]


@pytest.mark.parametrize(("check", "kind"), wired_cases())
@pytest.mark.wires
async def test_the_simulated_controllers_over_real_wires(check: Check, kind: str) -> None:
    cell_file = cell(**(LINE | IN_REAL_TIME)) if kind == "rtu" else cell(**IN_REAL_TIME)
    group = _group(cell_file)
    terminal = PtySerial(asyncio.get_running_loop(), BAUD)
    try:
        if kind == "rtu":
            terminal.open()
            group.serve_line(terminal, BAUD)
            axes = ModbusPositioners(cell_file, link=SerialPort(terminal.path, BAUD, "Modbus line"))
        else:
            axes = ModbusPositioners(cell_file, await group.serve(dict.fromkeys("ABCD", ("127.0.0.1", 0))))
        await check(_subject(axes, group, line=kind == "rtu"))
        await axes.close()
    finally:
        terminal.close()
        await group.close()


@pytest.mark.parametrize("check", UNPOWERED, ids=lambda check: check.__name__)
@pytest.mark.hardware
async def test_the_real_controllers(check: Check, request: pytest.FixtureRequest) -> None:
    """Nothing is enabled."""
    cell_file = load_cell(Path(request.config.getoption("--hardware")))
    if cell_file.bus.kind == "canopen":
        pytest.skip("the axes of this cell are not on Modbus")
    axes = ModbusPositioners(cell_file)
    await check(Queued(axes))
    await axes.close()
