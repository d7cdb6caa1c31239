"""Stops through the whole driver: ramps armed in the drives, silence, brakes, and what a fault is about."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from docking.errors import AxisLimitExceeded, EnableFailed, LinkLost, ReadBackMismatch
from docking.types import AxisState, FaultKind
from sim.canopen import DriveSettings
from sim.canopen.drives import Stage
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

CYCLE_S = 0.01


def run(scenario: Callable[[Bench], Awaitable[None]], settings: DriveSettings | None = None) -> None:
    async def main() -> None:
        await scenario(Bench(can_cell(), settings))

    run_virtual(main)


async def tick(bench: Bench, q: np.ndarray, count: int) -> None:
    for _ in range(count):
        exchange(bench.master, q)
        await asyncio.sleep(CYCLE_S)


def test_all_options_of_stopping_are_written() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.master.bring_up()
        for node in bench.drives.nodes:
            written = {index: node.number_of(index) for index in (0x605A, 0x605D, 0x605E, 0x6007, 0x6085)}
            assert written == {0x605A: 6, 0x605D: 2, 0x605E: 2, 0x6007: 3, 0x6085: 2_000_000}

    run(scenario)


def test_ramps_are_armed_side_by_side_read_back_and_restored() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        peak = np.linspace(0.0, 5.0, 12)
        bench.watch()
        arming = asyncio.get_running_loop().create_task(bench.master.arm_stops(peak, 0.025))
        await tick(bench, q, 20)
        await arming
        decel = bench.drives.drives.parameters.decel_mm_s2
        np.testing.assert_allclose(decel, np.maximum(peak / 0.025, 2.0), rtol=1e-6)
        assert (decel > 0.0).all(), "never 0"
        asked = [(cob, data) for cob, data in bench.trace if 0x600 < cob < 0x680]
        assert len(asked) == 24, "one write and one read for each node"
        assert [data[0] for cob, data in asked if cob == 0x605] == [0x23, 0x40]
        await bench.master.restore_stops()
        np.testing.assert_array_equal(bench.drives.drives.parameters.decel_mm_s2, 200.0)
        await bench.master.arm_stops(peak, 0.025)
        await bench.master.close()
        np.testing.assert_array_equal(bench.drives.drives.parameters.decel_mm_s2, 200.0)

    run(scenario)


@pytest.mark.parametrize(
    ("rounded", "accepted"), [(1.04, True), (0.96, True), (1.06, False), (0.94, False), (0.0, False)]
)
def test_a_drive_may_round_by_five_percent(rounded: float, accepted: bool) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.ready()
        dictionary = bench.drives.nodes[4].dictionary
        read = dictionary.read

        def rounding(index: int, sub: int) -> bytes:
            data = read(index, sub)
            return round(int.from_bytes(data, "little") * rounded).to_bytes(4, "little") if index == 0x6085 else data

        dictionary.read = rounding  # type: ignore[method-assign]
        if accepted:
            await bench.master.arm_stops(np.full(12, 2.0), 0.1)
            return
        with pytest.raises(ReadBackMismatch, match="6085h") as caught:
            await bench.master.arm_stops(np.full(12, 2.0), 0.1)
        assert caught.value.where == "B.Y"

    run(scenario)


@pytest.mark.parametrize(("peak", "t_stop_s"), [(5.0, 0.02), (np.nan, 0.1), (5.0, 0.0), (5.0, -1.0), (5.0, np.nan)])
def test_a_ramp_that_an_axis_does_not_have_is_refused(peak: float, t_stop_s: float) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.ready()
        with pytest.raises(AxisLimitExceeded):
            await bench.master.arm_stops(np.full(12, peak), t_stop_s)
        np.testing.assert_array_equal(bench.drives.drives.parameters.decel_mm_s2, 200.0)

    run(scenario)


def test_silence_ends_sync_and_heartbeat_for_good() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.watch()
        bench.master.go_silent()
        with pytest.raises(LinkLost, match="silent"):
            bench.master.send(q)
        bench.master.quick_stop()
        await asyncio.sleep(0.35)
        assert bench.drives.drives.stages == [Stage.QUICK_STOP] * 12, "the drives' own watchdogs act"
        with pytest.raises(EnableFailed):
            await bench.master.enable()
        await bench.master.close()
        await asyncio.sleep(0.5)
        ours = {cob for cob, _ in bench.trace} & {0x000, 0x080, 0x77F, *range(0x201, 0x20D)}
        assert not ours

    run(scenario)


def test_brakes_close_before_the_torque_goes_while_the_ticks_go_on() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.master.quick_stop()
        await tick(bench, q, 5)
        braking = asyncio.get_running_loop().create_task(bench.master.brake())
        powered_open = False
        while not braking.done():
            await tick(bench, q, 1)
            drives = bench.drives.drives
            powered_open |= bool((~drives.powered & ~drives.braked).any())
        await braking
        assert not powered_open, "no torque goes before the brake holds"
        assert drives.braked.all()
        assert not drives.powered.any()
        np.testing.assert_array_equal(bench.plant.position, bench.start_mm)

    run(scenario)


def test_a_brake_that_does_not_close_is_named() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        braking = asyncio.get_running_loop().create_task(bench.master.brake())
        while not braking.done():
            await tick(bench, q, 1)
        with pytest.raises(EnableFailed, match="brake"):
            await braking
        assert bench.drives.drives.powered.all()

    run(scenario, DriveSettings(brake_close_s=10.0))


@pytest.mark.parametrize(
    ("happening", "kind"),
    [
        (lambda drives: drives.emergency(3, 0x4210), FaultKind.DRIVE_WARNING),
        (lambda drives: drives.trip("B.X", 0x4210), FaultKind.DRIVE_FAULT),
        (lambda drives: drives.restart("B.X"), FaultKind.NODE_RESTARTED),
        (lambda drives: drives.mute("B.X"), FaultKind.HEARTBEAT_LOST),
    ],
)
def test_what_a_fault_is_about(happening: Callable[[object], None], kind: FaultKind) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        happening(bench.drives)
        await tick(bench, q, 40)
        feedback = bench.master.latest()
        assert feedback.fault is not None
        assert (feedback.fault[0], feedback.fault_kind) == ("B.X", kind)

    run(scenario)


@pytest.mark.parametrize(
    ("graver", "kind"),
    [
        (lambda drives: drives.restart("C.Z"), FaultKind.NODE_RESTARTED),
        (lambda drives: drives.mute("C.Z"), FaultKind.HEARTBEAT_LOST),
        (lambda drives: drives.faults.forge_set_point("C.Z", 0.0), FaultKind.FOREIGN_SENDER),
    ],
)
def test_a_complaint_hides_nothing_graver_and_nothing_graver_is_hidden(
    graver: Callable[[object], None], kind: FaultKind
) -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.drives.emergency(0, 0x4210)
        await tick(bench, q, 5)
        graver(bench.drives)
        await tick(bench, q, 40)
        bench.drives.emergency(1, 0x8700)
        await tick(bench, q, 2)
        feedback = bench.master.latest()
        assert feedback.fault is not None
        assert (feedback.fault[0], feedback.fault_kind) == ("C.Z", kind)

    run(scenario)


def test_a_lost_sync_has_a_name() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.drives.emergency(3, 0x8700)
        await tick(bench, q, 2)
        assert bench.master.latest().fault == ("B.X", 0x8700, "SYNC lost")

    run(scenario)


def test_a_drive_in_fault_comes_before_one_that_only_complains() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.drives.emergency(0, 0x4210)
        await tick(bench, q, 5)
        assert bench.master.latest().fault_kind is FaultKind.DRIVE_WARNING
        bench.drives.trip("C.Z", 0x2310)
        await tick(bench, q, 5)
        feedback = bench.master.latest()
        assert feedback.fault == ("C.Z", 0x2310, "overcurrent at the motor output")
        assert feedback.fault_kind is FaultKind.DRIVE_FAULT

    run(scenario)


def test_an_axis_at_its_limit_says_so() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        assert bench.master.latest().at_limit is None
        beyond = q.copy()
        beyond[7] = 75.2
        for k in range(200):
            exchange(bench.master, q + (beyond - q) * min(1.0, k / 100.0))
            await asyncio.sleep(CYCLE_S)
        at_limit = bench.master.latest().at_limit
        assert at_limit is not None
        assert at_limit.tolist() == [k == 7 for k in range(12)]

    run(scenario)


def test_a_drive_is_reset_on_order_and_not_before() -> None:
    async def scenario(bench: Bench) -> None:
        q = await bench.ready()
        await tick(bench, q, 5)
        bench.drives.trip("C.X", 0x2310)
        bench.master.quick_stop()
        await tick(bench, q, 100)
        assert bench.drives.drives.stages[6] is Stage.FAULT
        resetting = asyncio.get_running_loop().create_task(bench.master.reset_faults())
        await tick(bench, q, 20)
        await resetting
        assert bench.drives.drives.stages[6] is Stage.SWITCH_ON_DISABLED
        assert bench.master.latest().fault is None
        assert (await bench.master.enable()).states == (AxisState.ENABLED,) * 12

    run(scenario)
