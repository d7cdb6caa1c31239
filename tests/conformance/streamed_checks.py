"""What every `docking.ports.StreamedPositioners` keeps, whoever implements it: the checks of the conformance suite."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import numpy as np
import pytest

from docking.errors import DockingError
from docking.ports import StreamedPositioners
from docking.types import Array, AxisState

STEP_MM = 0.02
TOLERANCE_MM = 0.01
BOUNDED_S = 15.0
"""No call may take longer, whatever the far end does."""


@dataclass(frozen=True)
class Streamed:
    """Axes that are not brought up yet; `driven` (m,). `mute(axis, muted)` cuts one off, where that can be done."""

    port: StreamedPositioners
    driven: Array
    mute: Callable[[str, bool], None] | None = None

    async def run(self, position_mm: Array, cycles: int, step_mm: float = 0.0) -> Array:
        """Send set-points for so many cycles, each farther by `step_mm`; returns the last."""
        for _ in range(cycles):
            position_mm = position_mm + step_mm * self.driven
            self.port.send(position_mm)
            await asyncio.sleep(self.port.cycle_s)
        return position_mm

    async def ready(self) -> Array:
        """Bring up and enable; returns where the axes stand."""
        await self.port.bring_up()
        return (await self.port.enable()).position_mm


async def says_who_is_there_and_enables_nothing(axes: Streamed) -> None:
    identities = await axes.port.bring_up()
    assert identities
    assert all(one.where and one.product and one.serial for one in identities)
    feedback = axes.port.latest()
    assert np.isfinite(feedback.position_mm).all()
    assert len(feedback.position_mm) == len(feedback.states) == len(axes.port.axes)
    assert AxisState.ENABLED not in feedback.states
    assert axes.port.cycle_s > 0.0
    assert (axes.port.a_quick_mm_s2 > 0.0).all()


async def refuses_what_needs_a_bring_up(axes: Streamed) -> None:
    count = len(axes.port.axes)
    with pytest.raises(DockingError) as refused:
        axes.port.send(np.zeros(count))
    assert refused.value.code
    assert refused.value.where
    with pytest.raises(DockingError):
        await axes.port.enable()
    with pytest.raises(DockingError):
        await axes.port.arm_stops(np.ones(count), 0.5)
    axes.port.quick_stop()


async def closes_at_any_time_and_opens_again(axes: Streamed) -> None:
    await axes.port.close()
    await axes.port.bring_up()
    await axes.port.close()
    await axes.port.close()
    with pytest.raises(DockingError):
        axes.port.send(np.zeros(len(axes.port.axes)))
    await axes.port.bring_up()
    assert np.isfinite(axes.port.latest().position_mm).all()


async def survives_a_bring_up_that_is_given_up(axes: Streamed) -> None:
    task = asyncio.ensure_future(axes.port.bring_up())
    await asyncio.sleep(0.005)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await axes.port.close()
    assert await axes.port.bring_up()


async def enables_the_axes_where_they_stand(axes: Streamed) -> None:
    await axes.port.bring_up()
    before_mm = axes.port.latest().position_mm
    feedback = await axes.port.enable()
    np.testing.assert_allclose(feedback.position_mm, before_mm, atol=TOLERANCE_MM)
    enabled = [state is AxisState.ENABLED for state in feedback.states]
    assert enabled == [bool(driven) for driven in axes.driven]


async def follows_set_points_with_fresh_read_backs(axes: Streamed) -> None:
    begun_mm = await axes.ready()
    goal_mm = await axes.run(begun_mm, 10, STEP_MM)
    await axes.run(goal_mm, 20)
    feedback = axes.port.latest()
    np.testing.assert_allclose(feedback.position_mm[axes.driven], goal_mm[axes.driven], atol=TOLERANCE_MM)
    assert np.abs(goal_mm - begun_mm).max() == pytest.approx(10 * STEP_MM)
    assert (feedback.age_cycles <= 1.0).all()
    assert feedback.fault is None


async def takes_no_set_point_that_is_no_number(axes: Streamed) -> None:
    begun_mm = await axes.ready()
    await axes.run(begun_mm, 5)
    for bad in (np.nan, np.inf):
        wrong = begun_mm.copy()
        wrong[int(np.flatnonzero(axes.driven)[0])] = bad
        with pytest.raises(DockingError) as refused:
            axes.port.send(wrong)
        assert refused.value.where in axes.port.axes
    await axes.run(begun_mm, 10)
    np.testing.assert_allclose(axes.port.latest().position_mm, begun_mm, atol=TOLERANCE_MM)
    with pytest.raises(DockingError):
        await axes.port.arm_stops(np.full(len(begun_mm), np.nan), 0.5)


async def stops_at_once_and_stays_so_until_it_is_enabled(axes: Streamed) -> None:
    begun_mm = await axes.ready()
    moving_mm = await axes.run(begun_mm, 10, STEP_MM)
    axes.port.quick_stop()
    axes.port.quick_stop()
    await axes.run(moving_mm, 30)
    stood_mm = axes.port.latest().position_mm
    await axes.run(moving_mm + 1.0 * axes.driven, 20)
    np.testing.assert_allclose(axes.port.latest().position_mm, stood_mm, atol=TOLERANCE_MM)


async def shows_the_age_of_what_it_does_not_hear(axes: Streamed) -> None:
    if axes.mute is None:
        pytest.skip("nothing can be cut off here")
    begun_mm = await axes.ready()
    await axes.run(begun_mm, 5)
    index = len(axes.port.axes) - 1
    axes.mute(axes.port.axes[index], True)
    ages = []
    for _ in range(4):
        await axes.run(begun_mm, 2)
        ages.append(axes.port.latest().age_cycles.copy())
    assert [age[index] for age in ages] == sorted({age[index] for age in ages}), "it grows"
    assert ages[-1][index] >= 5.0
    assert max(np.delete(age, index).max() for age in ages) <= 2.0
    assert np.isfinite(axes.port.latest().position_mm).all()
    axes.mute(axes.port.axes[index], False)


async def gives_up_in_time_and_names_who_is_silent(axes: Streamed) -> None:
    if axes.mute is None:
        pytest.skip("nothing can be cut off here")
    silent = axes.port.axes[1]
    axes.mute(silent, True)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with pytest.raises(DockingError) as refused:
        await axes.port.bring_up()
    assert silent in refused.value.where
    assert loop.time() - begun_s <= BOUNDED_S
    axes.mute(silent, False)


async def goes_silent_for_good(axes: Streamed) -> None:
    await axes.ready()
    axes.port.go_silent()
    axes.port.go_silent()
    with pytest.raises(DockingError):
        await axes.port.enable()


Check = Callable[[Streamed], Awaitable[None]]

UNPOWERED: tuple[Check, ...] = (
    says_who_is_there_and_enables_nothing,
    refuses_what_needs_a_bring_up,
    closes_at_any_time_and_opens_again,
    survives_a_bring_up_that_is_given_up,
)
"""Nothing is enabled: what may run on real axes with nobody at the enabling device."""

CHECKS: tuple[Check, ...] = (
    *UNPOWERED,
    enables_the_axes_where_they_stand,
    follows_set_points_with_fresh_read_backs,
    takes_no_set_point_that_is_no_number,
    stops_at_once_and_stays_so_until_it_is_enabled,
    shows_the_age_of_what_it_does_not_hear,
    gives_up_in_time_and_names_who_is_silent,
    goes_silent_for_good,
)
