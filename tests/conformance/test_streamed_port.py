"""The port of streamed axes: the same checks on the fake, on simulated drives in virtual time, over AF_UNIX CAN, and
(without power) on hardware."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from docking.assemble.wires import near_bus
from docking.config.load import load_cell
from drivers.canopen.positioners import CanopenPositioners
from drivers.links.can_bus import CanBusLink
from sim.canopen import DriveGroup, DriveSettings
from sim.virtual_time import run_virtual
from sim.wires.unix_can import UnixCanServer
from tests.conformance.streamed_checks import CHECKS, UNPOWERED, Streamed
from tests.fakes.positioners import FakeDrives
from tests.support.can_bench import Bench, FakePlant, can_cell

Check = Callable[[Streamed], Awaitable[None]]
CELL = "lab-can"
BITRATE = 1_000_000

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)


@checks
def test_the_fake(check: Check) -> None:
    async def main() -> None:
        cell = can_cell(CELL)
        fake = FakeDrives(cell.axis_names, np.zeros(len(cell.axis_names)), np.array(cell.driven))
        await check(Streamed(fake, fake.driven, fake.mute))
        await fake.close()

    run_virtual(main)


@checks
def test_the_simulated_drives_in_virtual_time(check: Check) -> None:
    async def main() -> None:
        bench = Bench(can_cell(CELL))
        await check(Streamed(bench.master, np.array(bench.cell.driven), bench.drives.mute))
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)


@checks
@pytest.mark.wires
async def test_the_simulated_drives_over_a_local_socket(check: Check, tmp_path: Path) -> None:
    cell, path = can_cell(CELL), tmp_path / "can0"
    plant = FakePlant(cell.axis_names, np.linspace(-1.0, 1.0, 12), np.array(cell.driven))
    server = UnixCanServer(path)
    await server.open()
    group = DriveGroup(plant, cell, DriveSettings(shared_cpu=True), server, asyncio.get_running_loop())
    group.start()
    axes = CanopenPositioners(cell, CanBusLink("docking-unix", str(path), BITRATE))
    try:
        await check(Streamed(axes, np.array(cell.driven), group.mute))
        await axes.close()
    finally:
        group.close()
        server.close()


@pytest.mark.parametrize("check", UNPOWERED, ids=lambda check: check.__name__)
@pytest.mark.hardware
async def test_the_real_drives(check: Check, request: pytest.FixtureRequest) -> None:
    """Nothing is enabled."""
    cell = load_cell(Path(request.config.getoption("--hardware")))
    link = near_bus(cell, {}).can
    if link is None:
        pytest.skip("the axes of this cell are not on CAN")
    axes = CanopenPositioners(cell, link)
    await check(Streamed(axes, np.array(cell.driven)))
    await axes.close()
