"""Homing by group: all axes begin together, one that fails halts all of them, and nobody else."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import nullcontext

import numpy as np
import pytest

from docking.config.cell import CellFile, HomingConfig
from docking.errors import (
    AxisUnreferenced,
    DockingError,
    EnableFailed,
    HomingFailed,
    HomingRefused,
    ReadBackMismatch,
    WrongIdentity,
)
from drivers.canopen import codec
from sim.canopen import DriveSettings
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

SEARCH, STANDS = 17, 37
START, HALT = 1 << 4, 1 << 8
NEW = DriveSettings(homed=False, zero_off_mm=7.0)
A_AND_B = ("A.X", "A.Y", "A.Z", "B.X", "B.Y", "B.Z")
SPEED_MM_S = 5.0
CYCLE_S = 0.01


def homing_cell(method: int) -> CellFile:
    homing = HomingConfig(method=method, speed_mm_s=(SPEED_MM_S, 1.0), timeout_s=30.0)
    return can_cell().model_copy(update={"homing": homing})


class Words:
    """Controlwords by cycle: {axis: word} of each SYNC."""

    def __init__(self, bench: Bench) -> None:
        self.cycles: list[dict[str, int]] = []
        names = {node.node: node.name for node in bench.master._nodes}
        send = bench.near.send

        def tapped(frames) -> None:
            if codec.SYNC in frames:
                cut = {names[cob - 0x200]: data for cob, data in frames if 0x200 < cob < 0x280}
                self.cycles.append({name: int.from_bytes(data[:2], "little") for name, data in cut.items()})
            send(frames)

        bench.near.send = tapped  # type: ignore[method-assign]

    def first(self, bit: int) -> dict[str, int]:
        """The first cycle in which any axis has this bit."""
        return next(words for words in self.cycles if any(word & bit for word in words.values()))


def empty(bench: Bench) -> None:
    bench.plant.force_n = lambda: np.zeros(12)  # type: ignore[method-assign]


def run(
    story: Callable[[Bench], Awaitable[None]], method: int = SEARCH, drives: DriveSettings = NEW, *, deaf: bool = False
) -> None:
    async def main() -> None:
        bench = Bench(homing_cell(method), drives)
        empty(bench)
        await bench.master.bring_up()
        await story(bench)
        # An axis that is not heard any more cannot be confirmed as braked: closing says so.
        with pytest.raises(EnableFailed) if deaf else nullcontext():
            await bench.master.close()
        bench.drives.close()

    run_virtual(main)


async def failure_of(bench: Bench, axes: tuple[str, ...] = A_AND_B, **given) -> HomingFailed:
    with pytest.raises(HomingFailed) as caught:
        await bench.master.home(axes, **given)
    return caught.value


async def rests(bench: Bench, *, holding: int = 0) -> None:
    """Nothing moves any more, and no more than so many axes, which nobody can reach, hold themselves."""
    before = bench.plant.position.copy()
    await asyncio.sleep(1.0)
    assert (bench.plant.position == before).all()
    assert bench.drives.drives.powered.sum() == holding


def test_axes_that_do_not_know_their_zero_are_not_enabled_and_named() -> None:
    async def story(bench: Bench) -> None:
        assert bench.master.unhomed == set(bench.master.axes)
        with pytest.raises(AxisUnreferenced) as caught:
            await bench.master.enable()
        assert "A.X" in caught.value.where

    run(story)


def test_without_a_homing_table_nobody_is_asked() -> None:
    async def main() -> None:
        bench = Bench(can_cell(), NEW)
        await bench.ready()
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)


def test_a_group_finds_its_zeros_and_then_counts_from_them() -> None:
    async def story(bench: Bench) -> None:
        await bench.master.home(A_AND_B)
        # The switches are where the encoders read zero: there the axes stand, and that is what they count.
        assert bench.plant.position[:6] == pytest.approx(0.0, abs=1e-9)
        assert bench.master.latest().position_mm[:6] == pytest.approx(0.0, abs=1e-4)
        assert bench.plant.position[6:] == pytest.approx(bench.start_mm[6:])
        assert bench.master.unhomed == set(bench.master.axes[6:])
        await rests(bench)

    run(story)


def test_an_axis_is_homed_where_it_stands_and_set_points_mean_the_same_afterwards() -> None:
    async def story(bench: Bench) -> None:
        stood = bench.plant.position.copy()
        assert bench.master.latest().position_mm == pytest.approx(stood + 7.0, abs=1e-3)
        await bench.master.home(bench.master.axes)
        assert (bench.plant.position == stood).all(), "nothing moves"
        assert bench.master.latest().position_mm == pytest.approx(0.0, abs=1e-4)
        assert not bench.master.unhomed
        set_point = (await bench.master.enable()).position_mm
        for _ in range(50):
            set_point = set_point + 0.02
            exchange(bench.master, set_point)
            await asyncio.sleep(CYCLE_S)
        exchange(bench.master, set_point)
        await asyncio.sleep(2.0 * CYCLE_S)
        assert bench.plant.position == pytest.approx(stood + 1.0, abs=1e-3)

    run(story, STANDS)


def test_a_home_that_is_not_zero_and_a_method_of_one_axis() -> None:
    async def main() -> None:
        cell = homing_cell(SEARCH)
        first = cell.positioners[0]
        axes = (first.axes[0].model_copy(update={"home_mm": 12.5, "homing_method": STANDS}), *first.axes[1:])
        stations = (first.model_copy(update={"axes": axes}), *cell.positioners[1:])
        bench = Bench(cell.model_copy(update={"positioners": stations}), NEW)
        empty(bench)
        await bench.master.bring_up()
        await bench.master.home(("A.X", "A.Y"))
        assert bench.master.latest().position_mm[:2] == pytest.approx([12.5, 0.0], abs=1e-4)
        assert bench.plant.position[0] == bench.start_mm[0]
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)


def test_all_axes_of_a_group_begin_in_one_cycle_and_go_together() -> None:
    async def story(bench: Bench) -> None:
        words = Words(bench)
        bench.drives.drives.homing.switch_mm[:6] = bench.plant.position[:6] + 10.0
        calls = len(bench.plant.calls)
        await bench.master.home(A_AND_B)
        begun = words.first(START)
        assert {axis for axis, word in begun.items() if word & START} == set(A_AND_B)
        # One bridge carried by several axes must not be racked: in every step all have gone as far as each other.
        gone = np.array([position[:6] - bench.start_mm[:6] for _, position in bench.plant.calls[calls:]])
        assert np.ptp(gone, axis=1).max() < 1e-9
        assert gone.max() == pytest.approx(10.0)

    run(story)


CAUSES: dict[str, tuple[Callable[[Bench], object], str]] = {
    "no switch": (lambda b: b.drives.drives.homing.blind.add(3), "homing error"),
    "drive fault": (lambda b: b.drives.trip("B.X", 0x7121), "motor"),
    "torque lost": (lambda b: b.drives.trip("B.X", 0x3220, torque_lost=True), "undervoltage"),
    "silent": (lambda b: b.drives.mute("B.X"), ""),
    "restarted": (lambda b: b.drives.restart("B.X"), "restarted"),
    "no read-backs": (lambda b: b.drives.faults.lose_read_back("B.X"), "read-back"),
    "disabled by itself": (lambda b: b.drives.faults.disable_voltage("B.X"), "switch on disabled"),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_whatever_makes_one_axis_fail_all_axes_halt_and_none_is_homed(cause: str) -> None:
    fault, told = CAUSES[cause]

    async def story(bench: Bench) -> None:
        loop = asyncio.get_running_loop()
        # Far switches, so that all are on their way when it happens; A.X has found its zero by then.
        bench.drives.drives.homing.switch_mm[:6] = 60.0
        bench.drives.drives.homing.switch_mm[0] = bench.plant.position[0] + 1.0
        loop.call_later(1.0, fault, bench)
        error = await failure_of(bench)
        assert error.where == "B.X"
        assert told in error.text()
        assert bench.master.unhomed == set(bench.master.axes)
        await asyncio.sleep(0.5)
        await rests(bench, holding=cause == "silent")

    run(story, deaf=cause in ("silent", "restarted", "no read-backs"))


@pytest.mark.parametrize("failing", [0, 2, 5])
def test_the_halt_goes_to_every_axis_of_the_group_at_once_and_to_no_other(failing: int) -> None:
    async def story(bench: Bench) -> None:
        words = Words(bench)
        homing = bench.drives.drives.homing
        homing.switch_mm[:6] = 90.0
        homing.blind.add(failing)
        error = await failure_of(bench)
        assert error.where == A_AND_B[failing]
        halted = words.first(HALT)
        assert {axis for axis, word in halted.items() if word & HALT} == set(A_AND_B)
        assert not any(word & START for axis, word in halted.items())
        others = set(bench.master.axes) - set(A_AND_B)
        assert all(cycle[axis] == 0 for cycle in words.cycles for axis in others if axis in cycle)
        after = words.cycles[words.cycles.index(halted) :]
        assert not any(word & START for cycle in after for word in cycle.values()), "the halt is not taken back"
        await rests(bench)

    run(story)


def test_an_axis_that_was_homed_and_does_not_begin_is_not_taken_for_homed() -> None:
    async def story(bench: Bench) -> None:
        bench.drives.drives.homing.deaf.add(1)
        assert not bench.master.unhomed
        error = await failure_of(bench)
        assert error.where == "A.Y"
        assert "has not begun" in error.text()
        assert bench.master.unhomed == set(A_AND_B)
        with pytest.raises(AxisUnreferenced):
            await bench.master.enable()

    run(story, drives=DriveSettings())


def test_a_zero_that_is_wrong_is_noticed() -> None:
    async def story(bench: Bench) -> None:
        bench.drives.drives.homing.slips.add(4)
        error = await failure_of(bench)
        assert error.where == "B.Y"
        assert "1.000 mm" in error.text()

    run(story, STANDS)


def test_a_drive_that_does_not_take_the_mode_is_never_sent_the_starting_bit() -> None:
    async def story(bench: Bench) -> None:
        words = Words(bench)
        select = bench.drives.drives.select
        bench.drives.drives.select = lambda i, mode: select(i, 8 if i == 2 else mode)  # type: ignore[method-assign]
        error = await failure_of(bench)
        assert error.where == "A.Z"
        assert "6061h" in error.text()
        assert not any(word & (START | 8) for cycle in words.cycles for word in cycle.values())

    run(story)


def test_a_group_halts_when_somebody_asks_for_it() -> None:
    async def story(bench: Bench) -> None:
        loop = asyncio.get_running_loop()
        bench.drives.drives.homing.switch_mm[:] = 60.0
        end_s = loop.time() + 1.5
        error = await failure_of(bench, asked_to_stop=lambda: "The gate was opened." if loop.time() > end_s else None)
        assert "gate" in error.text()
        assert loop.time() < end_s + 0.5
        await rests(bench)

    run(story)


def test_a_second_homing_is_refused_and_the_first_goes_on() -> None:
    async def story(bench: Bench) -> None:
        first = asyncio.ensure_future(bench.master.home(A_AND_B))
        await asyncio.sleep(0.5)
        with pytest.raises(HomingRefused):
            await bench.master.home(("C.X",))
        await first
        assert bench.master.unhomed == set(bench.master.axes[6:])

    run(story)


def test_axes_that_carry_something_are_refused_before_anything_is_written() -> None:
    async def story(bench: Bench) -> None:
        bench.plant.force_n = lambda: np.where(np.arange(12) == 5, 300.0, 0.0)  # type: ignore[method-assign]
        await asyncio.sleep(0.3)
        words = Words(bench)
        with pytest.raises(HomingRefused) as caught:
            await bench.master.home(A_AND_B)
        assert caught.value.where == "B.Z"
        assert "300 N" in caught.value.text()
        assert not any(word for cycle in words.cycles for word in cycle.values())
        assert bench.drives.nodes[0].number_of(0x6098) == 0
        # The other two positioners are free.
        await bench.master.home(("C.X", "C.Y", "C.Z"))

    run(story)


@pytest.mark.parametrize("reading_n", [300.0, -300.0, float("nan")])
def test_a_load_cell_that_shows_something_on_the_way_halts_the_group(reading_n: float) -> None:
    """Somebody set a part down, or the axis ran against something."""

    async def story(bench: Bench) -> None:
        loop = asyncio.get_running_loop()
        bench.drives.drives.homing.switch_mm[:6] = 60.0
        reading = np.where(np.arange(12) == 4, reading_n, 0.0)
        loop.call_later(1.0, setattr, bench.plant, "force_n", lambda: reading)
        began_s = loop.time()
        error = await failure_of(bench)
        assert error.where == "B.Y"
        assert "load cell" in error.text()
        assert loop.time() - began_s < 2.0
        assert bench.master.unhomed == set(bench.master.axes)
        await rests(bench)

    run(story)


def test_enabled_axes_are_refused() -> None:
    async def story(bench: Bench) -> None:
        await bench.master.enable()
        with pytest.raises(HomingRefused):
            await bench.master.home(A_AND_B)

    run(story, drives=DriveSettings())


@pytest.mark.parametrize("entry", [(0x6098, 0), (0x6099, 1), (0x6099, 2), (0x609A, 0), (0x607C, 0)])
def test_every_setting_of_homing_is_read_back(entry: tuple[int, int]) -> None:
    async def story(bench: Bench) -> None:
        bench.drives.nodes[3].dictionary.lies[entry] = 99
        with pytest.raises(ReadBackMismatch) as caught:
            await bench.master.home(A_AND_B)
        assert caught.value.where == "B.X"
        await rests(bench)

    run(story)


def test_a_drive_without_homing_is_named() -> None:
    async def main() -> None:
        bench = Bench(can_cell(), DriveSettings(supported_modes=1 << 7))
        empty(bench)
        await bench.master.bring_up()
        bench.master._homing = HomingConfig()
        with pytest.raises(WrongIdentity) as caught:
            await bench.master.home(("A.X",))
        assert "homing" in caught.value.text()
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)


def test_a_lost_bus_ends_it_with_the_cause() -> None:
    async def main() -> None:
        bench = Bench(homing_cell(SEARCH), NEW)
        empty(bench)
        await bench.master.bring_up()
        bench.drives.drives.homing.switch_mm[:] = 60.0
        asyncio.get_running_loop().call_later(1.0, bench.bus.cut, "cable out")
        with pytest.raises(DockingError) as caught:
            await bench.master.home(A_AND_B)
        assert "cable out" in caught.value.text()
        await asyncio.sleep(1.0)
        await rests(bench, holding=6)
        bench.drives.close()

    run_virtual(main)
