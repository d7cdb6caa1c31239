"""What every `docking.ports.Inputs` keeps, whoever implements it: the checks of the conformance suite."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import pytest

from docking.errors import DockingError
from docking.ports import Inputs

TOLD_S = 0.4
"""Within this a change, a silence or a return is told: poll or refresh time, three of them for silence, debouncing."""
WARM_S = 1.2
"""Analogue inputs are repeated ten times more seldom."""
BOUNDED_S = 10.0


@dataclass(frozen=True)
class Wired:
    """Inputs that are not brought up yet: a contact and a sensor of component temperature behind the module `module`,
    and what may be done to them, where that can be done: `hold(given)`, `warm(celsius)`, `break_sensor(broken)`,
    `mute(muted)`."""

    port: Inputs
    module: str
    contact: str
    sensor: str
    hold: Callable[[bool], None] | None = None
    warm: Callable[[float], None] | None = None
    break_sensor: Callable[[bool], None] | None = None
    mute: Callable[[bool], None] | None = None

    async def until(self, condition: Callable[[], bool], within_s: float = TOLD_S) -> float:
        """Wait for `condition`; returns how long it took."""
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while not condition():
            assert loop.time() - begun_s <= within_s, self.port.latest()
            await asyncio.sleep(0.005)
        return loop.time() - begun_s


async def says_who_is_there_and_knows_all_inputs(inputs: Wired) -> None:
    identities = await inputs.port.bring_up()
    assert all(one.where and one.product and one.serial for one in identities)
    assert any(inputs.module in one.where for one in identities)
    state = inputs.port.latest()
    assert state.given[inputs.contact] in (True, False)
    assert math.isfinite(state.temperature_c[inputs.sensor])
    assert state.silent == ()


async def knows_nothing_before_it_has_heard(inputs: Wired) -> None:
    state = inputs.port.latest()
    assert not any(state.given.values())
    assert not any(math.isfinite(value) for value in state.temperature_c.values())


async def closes_at_any_time_and_opens_again(inputs: Wired) -> None:
    await inputs.port.close()
    await inputs.port.bring_up()
    await inputs.port.close()
    await inputs.port.close()
    await inputs.port.bring_up()
    assert inputs.port.latest().silent == ()


async def survives_a_bring_up_that_is_given_up(inputs: Wired) -> None:
    task = asyncio.ensure_future(inputs.port.bring_up())
    await asyncio.sleep(0.003)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await inputs.port.close()
    await inputs.port.bring_up()
    assert inputs.port.latest().silent == ()


async def tells_a_change_at_both_edges(inputs: Wired) -> None:
    if inputs.hold is None:
        pytest.skip("nobody is there to press it")
    await inputs.port.bring_up()
    told: list[bool | None] = []
    inputs.port.on_change = lambda: told.append(inputs.port.latest().given[inputs.contact])
    before = inputs.port.latest().given[inputs.contact]
    for given in (not before, bool(before)):
        inputs.hold(given)
        await inputs.until(lambda given=given: inputs.port.latest().given[inputs.contact] is given)  # type: ignore[misc]
    assert told[0] is (not before)
    assert told[-1] is before


async def measures_temperatures_and_says_when_it_cannot(inputs: Wired) -> None:
    if inputs.warm is None or inputs.break_sensor is None:
        pytest.skip("nothing can be warmed here")
    await inputs.port.bring_up()

    def shown() -> float:
        return inputs.port.latest().temperature_c[inputs.sensor]

    inputs.warm(31.5)
    await inputs.until(lambda: abs(shown() - 31.5) <= 0.1, WARM_S)
    inputs.break_sensor(True)
    await inputs.until(lambda: math.isnan(shown()), WARM_S)
    assert inputs.port.latest().silent == (), "the module is there, the sensor is not"
    inputs.break_sensor(False)
    await inputs.until(lambda: abs(shown() - 31.5) <= 0.1, WARM_S)


async def gives_nothing_that_is_old(inputs: Wired) -> None:
    if inputs.mute is None:
        pytest.skip("nothing can be cut off here")
    await inputs.port.bring_up()
    told: list[tuple[str, ...]] = []
    inputs.port.on_change = lambda: told.append(inputs.port.latest().silent)
    inputs.mute(True)
    await inputs.until(lambda: inputs.module in inputs.port.latest().silent)
    state = inputs.port.latest()
    assert state.given[inputs.contact] is None
    assert math.isnan(state.temperature_c[inputs.sensor])
    assert told[-1] == (inputs.module,)
    inputs.mute(False)
    await inputs.until(lambda: inputs.port.latest().silent == (), 2.0)
    assert inputs.port.latest().given[inputs.contact] in (True, False)


async def gives_up_in_time_and_names_who_is_silent(inputs: Wired) -> None:
    if inputs.mute is None:
        pytest.skip("nothing can be cut off here")
    inputs.mute(True)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with pytest.raises(DockingError) as refused:
        await inputs.port.bring_up()
    assert refused.value.code
    assert inputs.module in refused.value.where
    assert loop.time() - begun_s <= BOUNDED_S
    inputs.mute(False)


Check = Callable[[Wired], Awaitable[None]]

CHECKS: tuple[Check, ...] = (
    says_who_is_there_and_knows_all_inputs,
    knows_nothing_before_it_has_heard,
    closes_at_any_time_and_opens_again,
    survives_a_bring_up_that_is_given_up,
    tells_a_change_at_both_edges,
    measures_temperatures_and_says_when_it_cannot,
    gives_nothing_that_is_old,
    gives_up_in_time_and_names_who_is_silent,
)
