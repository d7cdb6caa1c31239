"""What every `docking.ports.LoadCells` keeps, whoever implements it: the checks of the conformance suite."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import numpy as np
import pytest

from docking.errors import DockingError, LoadCellBroken
from docking.ports import LoadCells

TOLD_S = 1.0
BOUNDED_S = 10.0
TOLERANCE_N = 0.05
"""Of one count of a 200 N range, and of the currents that simulated transmitters drive."""


@dataclass(frozen=True)
class Weighed:
    """Load cells that are not brought up yet: `axes` (3) of one of them, called `name`, and what may be done to it,
    where that can be done: `pull(x, y, z)` in N, `tear(torn)` its wires, `mute(muted)` its module."""

    port: LoadCells
    name: str
    axes: tuple[int, int, int]
    pull: Callable[[float, float, float], None] | None = None
    tear: Callable[[bool], None] | None = None
    mute: Callable[[bool], None] | None = None

    def shown(self) -> list[float]:
        return [float(self.port.latest()[index]) for index in self.axes]

    async def until(self, condition: Callable[[], bool]) -> None:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while not condition():
            assert loop.time() - begun_s <= TOLD_S, self.shown()
            await asyncio.sleep(0.005)


async def says_who_is_there_and_reads(cells: Weighed) -> None:
    identities = await cells.port.bring_up()
    assert all(one.where and one.product and one.serial for one in identities)
    assert np.isfinite(cells.shown()).all()


async def knows_nothing_while_it_is_not_up(cells: Weighed) -> None:
    assert np.isnan(cells.shown()).all()
    await cells.port.bring_up()
    await cells.port.close()
    assert np.isnan(cells.shown()).all()


async def closes_at_any_time_and_opens_again(cells: Weighed) -> None:
    await cells.port.close()
    await cells.port.bring_up()
    await cells.port.close()
    await cells.port.close()
    await cells.port.bring_up()
    assert np.isfinite(cells.shown()).all()


async def survives_a_bring_up_that_is_given_up(cells: Weighed) -> None:
    task = asyncio.ensure_future(cells.port.bring_up())
    await asyncio.sleep(0.003)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await cells.port.close()
    await cells.port.bring_up()
    assert np.isfinite(cells.shown()).all()


async def weighs_each_component_with_its_sign(cells: Weighed) -> None:
    if cells.pull is None:
        pytest.skip("nobody is there to pull")
    await cells.port.bring_up()
    for load in ((0.0, 0.0, 0.0), (50.0, -120.0, 480.0), (-50.0, 120.0, -7.0)):
        cells.pull(*load)
        await cells.until(lambda load=load: np.abs(np.subtract(cells.shown(), load)).max() <= TOLERANCE_N)  # type: ignore[misc]
    others = np.delete(cells.port.latest(), cells.axes)
    assert np.isnan(others).all(), "axes without a cell have no force"


async def shows_the_same_reading_once(cells: Weighed) -> None:
    """A reading that nobody has renewed is the same object: it counts once."""
    if cells.pull is None:
        pytest.skip("nobody is there to pull")
    await cells.port.bring_up()
    before = cells.port.latest()
    assert cells.port.latest() is before
    cells.pull(10.0, 20.0, 30.0)
    await cells.until(lambda: cells.port.latest() is not before)


async def tells_a_torn_wire_once_and_shows_no_force(cells: Weighed) -> None:
    if cells.tear is None:
        pytest.skip("nothing can be torn here")
    await cells.port.bring_up()
    told: list[DockingError] = []
    cells.port.on_fault = told.append
    cells.tear(True)
    await cells.until(lambda: bool(np.isnan(cells.shown()).all()))
    assert isinstance(told[0], LoadCellBroken)
    assert cells.name in told[0].where
    count = len(told)
    await asyncio.sleep(0.3)
    assert len(told) == count <= 3
    cells.tear(False)
    await cells.until(lambda: bool(np.isfinite(cells.shown()).all()))


async def refuses_to_begin_with_a_torn_wire(cells: Weighed) -> None:
    if cells.tear is None:
        pytest.skip("nothing can be torn here")
    cells.tear(True)
    with pytest.raises(LoadCellBroken) as refused:
        await cells.port.bring_up()
    assert cells.name in refused.value.where
    assert "mA" in str(refused.value)
    cells.tear(False)
    await cells.port.close()
    await cells.port.bring_up()


async def gives_nothing_that_is_old(cells: Weighed) -> None:
    if cells.mute is None:
        pytest.skip("nothing can be cut off here")
    await cells.port.bring_up()
    told: list[DockingError] = []
    cells.port.on_fault = told.append
    cells.mute(True)
    await cells.until(lambda: bool(np.isnan(cells.shown()).all()))
    assert told
    assert told[0].code
    cells.mute(False)


async def gives_up_in_time_and_names_who_is_silent(cells: Weighed) -> None:
    if cells.mute is None:
        pytest.skip("nothing can be cut off here")
    cells.mute(True)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with pytest.raises(DockingError) as refused:
        await cells.port.bring_up()
    assert refused.value.where
    assert loop.time() - begun_s <= BOUNDED_S
    cells.mute(False)


Check = Callable[[Weighed], Awaitable[None]]

CHECKS: tuple[Check, ...] = (
    says_who_is_there_and_reads,
    knows_nothing_while_it_is_not_up,
    closes_at_any_time_and_opens_again,
    survives_a_bring_up_that_is_given_up,
    weighs_each_component_with_its_sign,
    shows_the_same_reading_once,
    tells_a_torn_wire_once_and_shows_no_force,
    refuses_to_begin_with_a_torn_wire,
    gives_nothing_that_is_old,
    gives_up_in_time_and_names_who_is_silent,
)
