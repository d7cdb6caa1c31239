"""D.Z of `follower-force-can` on the bus: proved, bounded, enabled without a step, ramped, stopped. Bytes read here."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from docking.errors import EnableFailed, ReadBackMismatch, WrongIdentity
from docking.types import AxisState
from sim.canopen.drives import Stage
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell

K, NODE = 11, 12
HELD_N, NEWTON = 13400.0, 20.0
SET_POINT = struct.Struct("<Hhb")


class ForceBench(Bench):
    """The follower cell; the load cell of D.Z reads what D.Z exerts, or what it carries while it holds its position."""

    def __init__(self, carried_n: float = 12000.0) -> None:
        super().__init__(can_cell("follower-force-can"))
        self.carried_n, self.pressed_n = carried_n, math.nan
        self.presses: list[tuple[float, float]] = []
        self.plant.press = self._press  # type: ignore[attr-defined]
        self.plant.force_n = self._force_n  # type: ignore[method-assign]

    def _press(self, force_n, v_max_mm_s) -> None:
        self.pressed_n, self.v_max = float(force_n[K]), float(v_max_mm_s[K])
        self.presses.append((asyncio.get_running_loop().time(), self.pressed_n))
        assert np.isnan(np.delete(force_n, K)).all()

    def _force_n(self):
        forces = 1000.0 + 10.0 * np.arange(12.0)
        forces[K] = self.carried_n if math.isnan(self.pressed_n) else self.pressed_n
        return forces

    def told(self) -> list[tuple[int, int, int]]:
        """(controlword, target, mode) of every frame that D.Z was sent."""
        return [SET_POINT.unpack(data) for cob, data in self.trace if cob == 0x200 + NODE]


def on_bench(scenario: Callable[[ForceBench], Awaitable[None]], carried_n: float = 12000.0) -> None:
    async def main() -> None:
        bench = ForceBench(carried_n)
        bench.watch()
        await scenario(bench)

    run_virtual(main)


def test_bring_up_proves_mode_unit_and_limits() -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.master.bring_up()
        node = bench.drives.nodes[K]
        assert (node.number_of(0x6060), node.number_of(0x6061)) == (10, 10)
        assert node.number_of(0x6072) == math.ceil(1.25 * HELD_N / NEWTON)
        assert node.number_of(0x6080) == 72, "1.2 times 10 mm/s with 10 mm a revolution"
        mapped = [node.number_of(0x1600, sub) for sub in range(1, node.number_of(0x1600) + 1)]
        assert mapped == [0x6040_0010, 0x6071_0010, 0x6060_0008]
        assert node.number_of(0x605A) == 6
        other = bench.drives.nodes[8]
        assert (other.number_of(0x6060), other.number_of(0x1600, 2)) == (8, 0x607A_0020)
        assert bench.drives.drives.stages[K] is Stage.SWITCH_ON_DISABLED

    on_bench(scenario)


@pytest.mark.parametrize(
    ("obj", "value", "error", "words"),
    [
        (0x6502, 1 << 7, WrongIdentity, "torque mode"),
        (0x6076, 31_000, WrongIdentity, "rated torque"),
        (0x6072, 900, ReadBackMismatch, "6072h"),
        (0x6080, 6000, ReadBackMismatch, "6080h"),
    ],
)
def test_what_the_drive_does_not_have_or_keep_stops_the_bring_up(obj, value, error, words) -> None:
    async def scenario(bench: ForceBench) -> None:
        live = bench.drives.live
        bench.drives.live = lambda i, o, s: value if (i, o) == (K, obj) else live(i, o, s)  # type: ignore[method-assign]
        with pytest.raises(error, match=r"D\.Z") as caught:
            await bench.master.bring_up()
        assert words in str(caught.value)

    on_bench(scenario)


@pytest.mark.parametrize("carried_n", [12000.0, 15000.0])
def test_it_takes_over_what_it_carries_and_comes_to_its_force_at_the_rate(carried_n: float) -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.master.bring_up()
        bench.trace.clear()
        feedback = await bench.master.enable()
        assert feedback.states[K] is AxisState.ENABLED
        await asyncio.sleep(0.03)  # the last count reaches the drive with the next SYNC
        first_s, first_n = bench.presses[0]
        assert first_n == pytest.approx(carried_n, abs=NEWTON)
        steps = np.diff([force for _, force in bench.presses])
        assert np.abs(steps).max() <= NEWTON, "one count at most: no step"
        assert (steps * (HELD_N - carried_n) > 0.0).all()
        last_s, last_n = bench.presses[-1]
        assert last_n == HELD_N
        assert last_s - first_s == pytest.approx(abs(HELD_N - carried_n) / 1000.0, abs=0.1)
        enabled = [frame for frame in bench.told() if frame[0] == 0x0F]
        assert enabled[0][1] == round(carried_n / NEWTON)
        assert {mode for _, _, mode in bench.told()} == {10}
        assert bench.v_max == pytest.approx(12.0)
        # All seven come on together, in one SYNC.
        words = [data[:2] for cob, data in bench.trace if 0x200 < cob < 0x280]
        assert len(set(words[-7:])) == 1

    on_bench(scenario, carried_n)


def test_it_does_not_press_where_nothing_lies_on_it() -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.master.bring_up()
        with pytest.raises(EnableFailed, match=r"D\.Z"):
            await bench.master.enable()
        assert bench.presses == []
        assert not bench.drives.drives.powered.any()

    on_bench(scenario, carried_n=1300.0)


def test_a_force_that_does_not_come_takes_all_axes_off_again() -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.master.bring_up()
        bench._force_n = lambda: np.full(12, 12000.0)  # type: ignore[method-assign]
        bench.plant.force_n = bench._force_n  # type: ignore[method-assign]
        with pytest.raises(EnableFailed, match=r"D\.Z") as caught:
            await bench.master.enable()
        assert "12000 N" in str(caught.value)
        assert not bench.drives.drives.powered.any()
        assert math.isnan(bench.pressed_n)

    on_bench(scenario)


def test_a_quick_stop_makes_it_hold_its_position_and_disabling_closes_its_brake_first() -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.ready()
        drives = bench.drives.drives
        assert drives.statuswords[K] & 1 << 12
        bench.master.quick_stop()
        await asyncio.sleep(0.05)
        assert bench.told()[-1][0] == 0x02
        assert drives.stages[K] is Stage.QUICK_STOP
        assert drives.powered[K]
        assert not drives.braked[K]
        assert math.isnan(bench.pressed_n), "it holds its position"
        assert not drives.statuswords[K] & 1 << 12
        bench.carried_n = 13000.0
        await bench.master.enable()
        await asyncio.sleep(0.03)
        assert bench.pressed_n == HELD_N
        await bench.master.close()
        assert drives.braked[K]
        assert not drives.powered[K]

    on_bench(scenario)


def test_a_drive_never_presses_harder_than_it_was_permitted() -> None:
    async def scenario(bench: ForceBench) -> None:
        await bench.ready()
        bench.drives.drives.forces.aim(K, 30_000.0)
        assert bench.drives.drives.forces.exerted_n()[K] == pytest.approx(1.25 * HELD_N, abs=NEWTON)

    on_bench(scenario)
