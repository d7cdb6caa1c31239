"""The ports of streaming sensors: the same checks on fakes, on simulated devices in virtual time, over ptys, and on
hardware."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.assemble.streams import camera_of, inertial_of
from docking.config.instruments import InertialConfig, NdiConfig
from docking.config.load import load_cell
from docking.ports import SpeedLink
from drivers.links.serial_port import SerialPort
from drivers.ndi_stream import NdiStream
from drivers.vectornav import VectorNav
from sim.tracker.ndi import NdiCamera
from sim.tracker.vectornav import VectorNavSensor
from sim.virtual_time import run_virtual
from sim.wires.pacing import SpeedEnd
from sim.wires.pty_serial import PtySerial
from sim.wires.virtual_serial import VirtualSerial
from tests.conformance.stream_checks import CHECKS, Stream
from tests.fakes.camera_scene import ROM_A, FakeScene
from tests.fakes.streams import FakeCamera, FakeInertial

Check = Callable[[Stream], Awaitable[None]]

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
kinds = pytest.mark.parametrize("kind", ["camera", "inertial"])
BAUD = {"camera": 9600, "inertial": 115200}


def _device(kind: str, wire: SpeedEnd, loop: asyncio.AbstractEventLoop) -> Any:
    if kind == "camera":
        return NdiCamera(FakeScene(), wire, loop, {ROM_A: "nose"})
    return VectorNavSensor(lambda t_s: (np.eye(3), np.zeros(3)), wire, loop)


def _driver(kind: str, link: SpeedLink) -> Any:
    if kind == "camera":
        return NdiStream(link, NdiConfig(port="x"), {"nose": ROM_A})
    return VectorNav(link, InertialConfig(port="x"))


@checks
@kinds
def test_the_fake(check: Check, kind: str) -> None:
    async def main() -> None:
        fake = FakeCamera() if kind == "camera" else FakeInertial()
        await check(Stream(fake))
        await fake.close()

    run_virtual(main)


@checks
@kinds
def test_the_simulated_device_in_virtual_time(check: Check, kind: str) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, BAUD[kind])
        device, sensor = _device(kind, wire.far, loop), _driver(kind, wire.near)
        await check(Stream(sensor))
        await sensor.close()
        if kind == "inertial":
            device.close()

    run_virtual(main)


def pty_cases() -> list[Any]:
    """All checks; those of the camera, which misses the break on a pty and is sought at every speed, in full only."""
    quick = [pytest.param(check, "inertial", id=f"inertial-{check.__name__}") for check in CHECKS]
    return quick + [
        pytest.param(check, "camera", id=f"camera-{check.__name__}", marks=[pytest.mark.full] if n else [])
        for n, check in enumerate(CHECKS)
    ]


@pytest.mark.parametrize(("check", "kind"), pty_cases())
@pytest.mark.wires
async def test_the_simulated_device_over_a_pty(check: Check, kind: str) -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, BAUD[kind])
    terminal.open()
    device = _device(kind, terminal, loop)
    sensor = _driver(kind, SerialPort(terminal.path, BAUD[kind], kind))
    await check(Stream(sensor))
    await sensor.close()
    if kind == "inertial":
        device.close()
    terminal.close()


@checks
@kinds
@pytest.mark.hardware
async def test_the_real_device(check: Check, kind: str, request: pytest.FixtureRequest) -> None:
    path = Path(request.config.getoption("--hardware"))
    cell = load_cell(path)
    sensor: Any = camera_of(cell, path.parent) if kind == "camera" else inertial_of(cell)
    await check(Stream(sensor))
    await sensor.close()
