"""The port of load cells beside the axes: the same checks on the fake, on simulated modules in virtual time, over
AF_UNIX CAN and loopback TCP, and on hardware; and what a current means."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from docking.assemble.motion_side import input_modules
from docking.assemble.wires import near_bus
from docking.config.load import load_cell
from docking.errors import LoadCellBroken
from drivers.canopen.shared import SharedCan
from drivers.load_cells import AnalogueLoadCells
from sim.virtual_time import run_virtual
from tests.conformance.load_cells_checks import CHECKS, Weighed
from tests.fakes.load_cells import FakeLoadCells
from tests.support.force_bench import NAME, ForceBench
from tests.support.module_bench import KINDS

Check = Callable[[Weighed], Awaitable[None]]
UNDER_B = (3, 4, 5)

checks = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
kinds = pytest.mark.parametrize("kind", KINDS)


@checks
def test_the_fake(check: Check) -> None:
    async def main() -> None:
        fake = FakeLoadCells()
        await check(Weighed(fake, fake.name, UNDER_B, fake.pull, fake.tear, fake.mute))
        await fake.close()

    run_virtual(main)


def _subject(bench: ForceBench, cells: AnalogueLoadCells) -> Weighed:
    return Weighed(cells, NAME, UNDER_B, bench.pull, bench.tear, bench.mute)


@checks
@kinds
def test_the_simulated_module_in_virtual_time(check: Check, kind: str) -> None:
    async def main() -> None:
        bench = ForceBench(kind)
        cells = await bench.in_virtual_time()
        await check(_subject(bench, cells))
        await cells.close()
        await bench.close()

    run_virtual(main)


@checks
@kinds
@pytest.mark.wires
async def test_the_simulated_module_over_real_wires(check: Check, kind: str, tmp_path: Path) -> None:
    bench = ForceBench(kind)
    cells = await bench.on_real_wires(tmp_path)
    try:
        await check(_subject(bench, cells))
        await cells.close()
    finally:
        await bench.close()


@checks
@pytest.mark.hardware
async def test_the_real_load_cells(check: Check, request: pytest.FixtureRequest) -> None:
    cell = load_cell(Path(request.config.getoption("--hardware")))
    if cell.inputs is None or not cell.inputs.forces:
        pytest.skip("this cell has no load cells on modules")
    link = near_bus(cell, {}).can
    modules = input_modules(cell.inputs, SharedCan(link) if link is not None else None, None)
    cells = AnalogueLoadCells(cell, {name: modules[name] for name in cell.inputs.weighing})
    force = cell.inputs.forces[0]
    first = cell.axis_names.index(f"{force.positioner}.X")
    await check(Weighed(cells, force.name, (first, first + 1, first + 2)))
    await cells.close()


@kinds
@pytest.mark.parametrize(
    ("ma", "force_n"),
    [(12.0, 0.0), (20.0, 200.0), (4.0, -200.0), (16.0, 100.0), (3.85, -203.75), (20.45, 211.25)],
)
def test_what_a_current_means(kind: str, ma: float, force_n: float) -> None:
    """12 mA is no force, 8 mA more the whole range of 200 N along X, whatever the counts of the module are."""

    async def main(counts: tuple[int, int]) -> float:
        bench = ForceBench(kind, counts)
        cells = await bench.in_virtual_time()
        bench.current(ma)
        await cells.bring_up()
        found = float(cells.latest()[3])
        await cells.close()
        await bench.close()
        return found

    for counts in ((5530, 27648), (0, 16000), (6400, 32000)):
        assert run_virtual(lambda counts=counts: main(counts)) == pytest.approx(force_n, abs=0.02)  # type: ignore[misc]


@kinds
@pytest.mark.parametrize(("ma", "said"), [(0.0, "broken"), (3.7, "Beyond"), (20.7, "Beyond"), (21.2, "Short circuit")])
def test_a_current_outside_means_none(kind: str, ma: float, said: str) -> None:
    async def main() -> None:
        bench = ForceBench(kind)
        cells = await bench.in_virtual_time()
        bench.current(ma)
        with pytest.raises(LoadCellBroken) as refused:
            await cells.bring_up()
        assert said in str(refused.value)
        assert f"{ma:.2f} mA" in str(refused.value)
        await cells.close()
        await bench.close()

    run_virtual(main)
