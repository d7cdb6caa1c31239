"""What every `docking.ports.QueuedPositioners` keeps, whoever implements it: the checks of the conformance suite."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from docking.errors import BadArgument, DockingError
from docking.ports import QueuedPositioners
from docking.types import Array, AxisState, Correction, Feedback, Plan

POLL_S = 0.05
TOLERANCE_MM = 0.01
BOUNDED_S = 15.0
"""No call may take longer, whatever the far end does."""
DURATION_S, TRAVEL_MM = 1.0, 0.25


@dataclass(frozen=True)
class Queued:
    """Axes that are not brought up yet. `mute(positioner, muted)` lets one controller fall silent, `cut(positioner)`
    breaks its connection, where that can be done."""

    port: QueuedPositioners
    mute: Callable[[str, bool], None] | None = None
    cut: Callable[[str], None] | None = None

    async def ready(self) -> Array:
        """Bring up and enable; returns where the axes stand."""
        await self.port.bring_up()
        return (await self.port.enable()).position_mm

    async def poll_for(self, seconds: float) -> Feedback:
        """Poll so long; returns the last read-back."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + seconds
        feedback = await self.port.poll()
        while loop.time() < end_s:
            await asyncio.sleep(POLL_S)
            feedback = await self.port.poll()
        return feedback

    async def played(self, plan: Plan) -> Feedback:
        """Poll until the plan has been played; returns the read-back a little later."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + BOUNDED_S
        while not (await self.port.poll()).path_time_s >= plan.duration_s - 1e-6:
            assert loop.time() < end_s
            await asyncio.sleep(POLL_S)
        return await self.poll_for(POLL_S)

    def plan(self, start_mm: Array, duration_s: float = DURATION_S) -> Plan:
        """A small move of all axes that begins and ends at rest."""
        t_s = self.port.segment_s * np.arange(round(duration_s / self.port.segment_s) + 1)
        x = t_s / t_s[-1]
        s = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        q_mm = start_mm + TRAVEL_MM * s[:, None]
        nowhere = Correction(np.zeros(3), np.zeros(3), np.zeros(3))
        axes, period_s = self.port.axes, self.port.segment_s
        return Plan(7, "0" * 8, "S1", "approach", axes, period_s, t_s, s, q_mm, nowhere, 0.0, 2.0, "")


async def says_who_is_there_and_enables_nothing(axes: Queued) -> None:
    identities = await axes.port.bring_up()
    assert identities
    assert all(one.where and one.product and one.serial for one in identities)
    feedback = await axes.port.poll()
    assert np.isfinite(feedback.position_mm).all()
    assert len(feedback.position_mm) == len(feedback.states) == len(axes.port.axes)
    assert AxisState.ENABLED not in feedback.states
    assert axes.port.segment_s > 0.0
    assert axes.port.ramp_s > 0.0


async def refuses_what_needs_a_bring_up(axes: Queued) -> None:
    for call in (
        axes.port.poll,
        axes.port.enable,
        lambda: axes.port.command("hold"),
        lambda: axes.port.override(0.5),
        lambda: axes.port.load(axes.plan(np.zeros(len(axes.port.axes)))),
    ):
        with pytest.raises(DockingError) as refused:
            await call()
        assert refused.value.code
        assert refused.value.where


async def closes_at_any_time_and_opens_again(axes: Queued) -> None:
    await axes.port.close()
    await axes.port.bring_up()
    await axes.port.close()
    await axes.port.close()
    with pytest.raises(DockingError):
        await axes.port.poll()
    await axes.port.bring_up()
    assert np.isfinite((await axes.port.poll()).position_mm).all()


async def survives_calls_that_are_given_up(axes: Queued) -> None:
    task = asyncio.ensure_future(axes.port.bring_up())
    await asyncio.sleep(0.005)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await axes.port.close()
    assert await axes.port.bring_up()
    for _ in range(3):
        polling = asyncio.ensure_future(axes.port.poll())
        await asyncio.sleep(0.0)
        polling.cancel()
        await asyncio.gather(polling, return_exceptions=True)
    feedback = await axes.poll_for(4 * POLL_S)
    assert (feedback.age_cycles == 0.0).all()


async def enables_the_axes_where_they_stand(axes: Queued) -> None:
    await axes.port.bring_up()
    before_mm = (await axes.port.poll()).position_mm
    feedback = await axes.port.enable()
    np.testing.assert_allclose(feedback.position_mm, before_mm, atol=TOLERANCE_MM)
    assert AxisState.ENABLED in feedback.states
    assert not axes.port.braked


async def takes_no_plan_that_is_no_path_from_here(axes: Queued) -> None:
    start_mm = await axes.ready()
    plan = axes.plan(start_mm)
    hole = plan.q_mm.copy()
    hole[5, 1] = np.nan
    for wrong in (
        replace(plan, q_mm=hole),
        replace(plan, q_mm=plan.q_mm + 1.0),
    ):
        with pytest.raises(DockingError) as refused:
            await axes.port.load(wrong)
        assert refused.value.code
    np.testing.assert_allclose((await axes.poll_for(0.3)).position_mm, start_mm, atol=TOLERANCE_MM)


async def takes_no_word_that_it_does_not_know(axes: Queued) -> None:
    await axes.ready()
    with pytest.raises(BadArgument):
        await axes.port.command("jump")
    for rate in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(BadArgument):
            await axes.port.override(rate)


async def plays_a_plan_to_its_end(axes: Queued) -> None:
    start_mm = await axes.ready()
    plan = axes.plan(start_mm)
    await axes.port.load(plan)
    np.testing.assert_allclose((await axes.port.poll()).position_mm, start_mm, atol=TOLERANCE_MM)
    await axes.port.command("run")
    feedback = await axes.played(plan)
    np.testing.assert_allclose(feedback.position_mm, plan.q_mm[-1], atol=TOLERANCE_MM)
    assert feedback.path_time_s == pytest.approx(plan.duration_s, abs=1e-6)
    assert feedback.fault is None


async def holds_on_the_path_and_goes_on(axes: Queued) -> None:
    start_mm = await axes.ready()
    plan = axes.plan(start_mm, 2.0 * DURATION_S)
    await axes.port.load(plan)
    await axes.port.command("run")
    await axes.poll_for(0.2)
    await axes.port.command("hold")
    held = await axes.poll_for(axes.port.ramp_s + 0.1)
    share = (held.position_mm - start_mm) / TRAVEL_MM
    assert 0.02 < share.min() <= share.max() < 0.98
    assert np.ptp(share) * TRAVEL_MM <= TOLERANCE_MM, "all at one place of the path"
    still = await axes.poll_for(0.1)
    np.testing.assert_allclose(still.position_mm, held.position_mm, atol=TOLERANCE_MM)
    await axes.port.command("resume")
    feedback = await axes.played(plan)
    np.testing.assert_allclose(feedback.position_mm, plan.q_mm[-1], atol=TOLERANCE_MM)


async def shows_the_age_of_what_it_does_not_hear(axes: Queued) -> None:
    if axes.mute is None:
        pytest.skip("nothing can be cut off here")
    await axes.ready()
    positioner = axes.port.axes[-1].partition(".")[0]
    axes.mute(positioner, True)
    ages = [(await axes.port.poll(surviving=True)).age_cycles for _ in range(3)]
    assert [age[-1] for age in ages] == sorted({age[-1] for age in ages}), "it grows"
    assert all(age[0] == 0.0 for age in ages)
    begun_s = asyncio.get_running_loop().time()
    with pytest.raises(DockingError) as silent:
        await axes.poll_for(1.0)
    assert positioner in silent.value.where
    assert asyncio.get_running_loop().time() - begun_s <= 1.0
    axes.mute(positioner, False)


async def gives_up_in_time_and_names_who_is_silent(axes: Queued) -> None:
    if axes.mute is None:
        pytest.skip("nothing can be cut off here")
    positioner = axes.port.axes[-1].partition(".")[0]
    axes.mute(positioner, True)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    with pytest.raises(DockingError) as refused:
        await axes.port.bring_up()
    assert positioner in refused.value.where
    assert loop.time() - begun_s <= BOUNDED_S
    axes.mute(positioner, False)


async def tells_a_broken_connection_at_once(axes: Queued) -> None:
    if axes.cut is None:
        pytest.skip("nothing can be cut off here")
    await axes.ready()
    lost: list[float] = []
    loop = asyncio.get_running_loop()
    axes.port.on_lost = lambda: lost.append(loop.time())
    begun_s = loop.time()
    axes.cut(axes.port.axes[0].partition(".")[0])
    await asyncio.sleep(0.02)
    assert lost
    assert lost[0] - begun_s <= 0.02


async def goes_silent_for_good(axes: Queued) -> None:
    await axes.ready()
    axes.port.go_silent()
    axes.port.go_silent()
    with pytest.raises(DockingError):
        await axes.port.poll()


Check = Callable[[Queued], Awaitable[None]]

UNPOWERED: tuple[Check, ...] = (
    says_who_is_there_and_enables_nothing,
    refuses_what_needs_a_bring_up,
    closes_at_any_time_and_opens_again,
    survives_calls_that_are_given_up,
)
"""Nothing is enabled: what may run on real axes with nobody at the enabling device."""

CHECKS: tuple[Check, ...] = (
    *UNPOWERED,
    enables_the_axes_where_they_stand,
    takes_no_plan_that_is_no_path_from_here,
    takes_no_word_that_it_does_not_know,
    plays_a_plan_to_its_end,
    holds_on_the_path_and_goes_on,
    shows_the_age_of_what_it_does_not_hear,
    gives_up_in_time_and_names_who_is_silent,
    tells_a_broken_connection_at_once,
    goes_silent_for_good,
)
