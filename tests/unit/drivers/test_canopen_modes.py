"""Drives without cyclic synchronous position: they take the same set-points by interpolated position."""

from __future__ import annotations

import asyncio
import struct

import numpy as np
import pytest

from docking.errors import ReadBackMismatch, WrongIdentity
from docking.types import AxisState
from drivers.canopen.cia402 import DriveState, decode
from sim.canopen import DriveSettings
from sim.canopen.drives import Stage
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

IP_ONLY = 1 << 6
BOTH = 1 << 6 | 1 << 7
CYCLE_S = 0.01


def bench_with(modes: int) -> Bench:
    return Bench(can_cell(), DriveSettings(supported_modes=modes))


async def ramp(bench: Bench, start_mm: np.ndarray, cycles: int) -> list[np.ndarray]:
    """Axis k goes 1 um x (k + 1) further each cycle; returns what the drives were at."""
    seen = []
    step = 1e-3 * np.arange(1.0, len(start_mm) + 1.0)
    for cycle in range(1, cycles + 1):
        seen.append(exchange(bench.master, start_mm + cycle * step).position_mm)
        await asyncio.sleep(CYCLE_S)
    return seen


def words_of(bench: Bench, node: int) -> list[tuple[int, int]]:
    """Controlword and mode of each set-point frame of a node."""
    return [struct.unpack("<Hib", data)[::2] for cob, data in bench.trace if cob == 0x200 + node]


def test_interpolating_drives_follow_as_cyclic_ones_do() -> None:
    async def main() -> None:
        paths = []
        for modes in (1 << 7, IP_ONLY):
            bench = bench_with(modes)
            start = await bench.ready()
            paths.append(await ramp(bench, start, 30))
            await bench.master.close()
            assert bench.drives.drives.braked.all()
        np.testing.assert_array_equal(paths[0], paths[1])
        np.testing.assert_allclose(paths[1][-1][11] - paths[1][0][11], 28 * 0.012, atol=0.013)

    run_virtual(main)


def test_interpolation_is_enabled_after_the_drive_and_never_before() -> None:
    async def main() -> None:
        bench = bench_with(IP_ONLY)
        await bench.master.bring_up()
        bench.watch()
        await bench.master.enable()
        state = DriveState.SWITCH_ON_DISABLED
        seen: list[int] = []
        for cob, data in bench.trace:
            if cob == 0x183:
                state = decode(int.from_bytes(data[:2], "little"))
            if cob == 0x203:
                word, mode = struct.unpack("<Hib", data)[::2]
                seen.append(word)
                assert mode == 7
                assert not word & 0x10 or state is DriveState.OPERATION_ENABLED
        assert 0x0F in seen, "first enabled, then interpolating: an edge"
        assert seen[-1] == 0x1F
        await bench.master.close()

    run_virtual(main)


def test_cyclic_position_comes_first_and_each_axis_has_its_own() -> None:
    async def main() -> None:
        bench = bench_with(BOTH)
        bench.drives.faults.lie("B.X", 0x6502, IP_ONLY)
        start = await bench.ready()
        bench.watch()
        await ramp(bench, start, 20)
        last = exchange(bench.master, start + 0.02 * np.arange(1.0, 13.0))
        assert set(words_of(bench, 3)) == {(0x0F, 8)}
        assert set(words_of(bench, 4)) == {(0x1F, 7)}
        assert last.fault is None
        assert bench.drives.nodes[3].number_of(0x1600, 2) == 0x60C1_0120
        np.testing.assert_allclose(last.position_mm, start + 0.019 * np.arange(1.0, 13.0), atol=1e-4)
        await bench.master.close()

    run_virtual(main)


def test_a_quick_stop_takes_interpolation_away_and_enabling_gives_it_back() -> None:
    async def main() -> None:
        bench = bench_with(IP_ONLY)
        start = await bench.ready()
        await ramp(bench, start, 30)
        bench.watch()
        bench.master.quick_stop()
        for _ in range(20):
            bench.master.send(start)
            await asyncio.sleep(CYCLE_S)
        assert {word for word, _ in words_of(bench, 12)} == {0x02}
        assert bench.drives.drives.stages == [Stage.QUICK_STOP] * 12
        feedback = await bench.master.enable()
        assert feedback.states == (AxisState.ENABLED,) * 12
        moved = feedback.position_mm - start
        assert (moved > 0.0).all()
        await bench.master.close()

    run_virtual(main)


def test_a_drive_that_interpolates_no_more_holds_its_last_point() -> None:
    async def main() -> None:
        bench = bench_with(IP_ONLY)
        start = await bench.ready()
        await ramp(bench, start, 5)
        drives, loop = bench.drives.drives, asyncio.get_running_loop()
        drives.control(4, 0x0F, loop.time())
        held = drives.advance(loop.time(), 0.0, 0.0, bench.plant.encoder_mm)[4]
        assert not drives.following[4]
        assert not drives.statuswords[4] & 1 << 12
        drives.latch(np.array([4]), np.array([held + 1.0]))
        assert drives.advance(loop.time() + CYCLE_S, CYCLE_S, CYCLE_S, bench.plant.encoder_mm)[4] == held
        bench.drives.close()

    run_virtual(main)


def test_a_drive_that_buffers_its_points_is_refused() -> None:
    async def main() -> None:
        bench = bench_with(IP_ONLY)
        bench.drives.faults.lie("D.Z", 0x60C0, 1)
        with pytest.raises(ReadBackMismatch, match="60C0h") as caught:
            await bench.master.bring_up()
        assert caught.value.where == "D.Z"

    run_virtual(main)


@pytest.mark.parametrize("modes", [1 << 0, 1 << 9, 0])
def test_a_drive_with_neither_mode_is_refused(modes: int) -> None:
    """Profile position (bit 0) is no way: trapezoids that only begin together strain the part."""

    async def main() -> None:
        with pytest.raises(WrongIdentity, match="no cyclic synchronous position and no interpolated position"):
            await bench_with(modes).master.bring_up()

    run_virtual(main)
