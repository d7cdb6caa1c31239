"""The port of wired inputs (contacts, temperatures): the same checks on the fake, on simulated modules in virtual time,
over AF_UNIX CAN and loopback TCP, and on hardware."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from docking.assemble.motion_side import input_modules
from docking.assemble.wires import near_bus
from docking.config.load import load_cell
from drivers.canopen.shared import SharedCan
from drivers.inputs import WiredInputs
from sim.virtual_time import run_virtual
from tests.conformance.inputs_checks import CHECKS, Wired
from tests.fakes.inputs import FakeInputs
from tests.support.input_bench import CONTACT, MODULE, SENSOR, InputBench
from tests.support.module_bench import KINDS

Check = Callable[[Wired], Awaitable[None]]

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
kinds = pytest.mark.parametrize("kind", KINDS)


@checks
def test_the_fake(check: Check) -> None:
    async def main() -> None:
        fake = FakeInputs()
        moved = fake.hold, fake.warm, fake.break_sensor, fake.mute
        await check(Wired(fake, fake.module, fake.contact, fake.sensor, *moved))
        await fake.close()

    run_virtual(main)


def _subject(bench: InputBench, inputs: WiredInputs) -> Wired:
    return Wired(inputs, MODULE, CONTACT, SENSOR, bench.hold, bench.warm, bench.break_sensor, bench.mute)


@checks
@kinds
def test_the_simulated_module_in_virtual_time(check: Check, kind: str) -> None:
    async def main() -> None:
        bench = InputBench(kind)
        inputs = await bench.in_virtual_time()
        await check(_subject(bench, inputs))
        await inputs.close()
        await bench.close()

    run_virtual(main)


@checks
@kinds
@pytest.mark.wires
async def test_the_simulated_module_over_real_wires(check: Check, kind: str, tmp_path: Path) -> None:
    bench = InputBench(kind)
    inputs = await bench.on_real_wires(tmp_path)
    try:
        await check(_subject(bench, inputs))
        await inputs.close()
    finally:
        await bench.close()


@checks
@pytest.mark.hardware
async def test_the_real_modules(check: Check, request: pytest.FixtureRequest) -> None:
    cell = load_cell(Path(request.config.getoption("--hardware")))
    if cell.inputs is None or not cell.inputs.digital or not cell.inputs.temperatures:
        pytest.skip("this cell has no wired contact and sensor")
    link = near_bus(cell, {}).can
    contact, sensor = cell.inputs.digital[0], cell.inputs.temperatures[0]
    shared = SharedCan(link) if link is not None else None
    inputs = WiredInputs(cell.inputs, input_modules(cell.inputs, shared, None))
    await check(Wired(inputs, contact.module, contact.name, sensor.name))
    await inputs.close()
    await asyncio.sleep(0.0)
