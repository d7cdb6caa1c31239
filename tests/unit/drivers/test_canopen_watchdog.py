"""The drives' watchdogs are seen to act before anything is enabled: the heartbeat pauses, each drive must miss it."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import pytest

from docking.errors import EnableFailed, WatchdogUnproved
from docking.types import AxisState
from sim.canopen import DriveSettings
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange

TIMEOUT_S = 0.28
HOST_BEAT = 0x77F
LOST = 0x8130


def deaf_but_right(bench: Bench, axis: str) -> None:
    """1016h is accepted, reads as written, and nothing watches."""
    bench.drives.faults.ignore_write(axis, 0x1016, 1)
    bench.drives.faults.lie(axis, 0x1016, 127 << 16 | 280, 1)


def proved_at_start() -> Bench:
    return Bench(can_cell(prove_watchdog=True))


def test_the_heartbeat_pauses_until_all_drives_have_missed_it_and_sync_goes_on() -> None:
    async def main() -> None:
        bench, loop = proved_at_start(), asyncio.get_running_loop()
        times: dict[str, list[float]] = {"beat": [], "sync": [], "lost": [], "back": []}

        def keep(cob: int, data: bytes) -> bool:
            emergency = int.from_bytes(data[:2], "little") if 0x80 < cob < 0x100 else None
            kind = {HOST_BEAT: "beat", 0x80: "sync"}.get(cob, {LOST: "lost", 0: "back"}.get(emergency))
            if kind:
                times[kind].append(loop.time())
            return True

        bench.bus.keep = keep
        await bench.master.bring_up()
        pauses = [b - a for a, b in pairwise(times["beat"])]
        assert sum(pause > TIMEOUT_S for pause in pauses) == 1
        assert max(pauses) < 1.1 * TIMEOUT_S + 0.04
        assert len(times["lost"]) == len(times["back"]) == 12
        syncs = times["sync"]
        assert max(b - a for a, b in pairwise(syncs)) < 0.0105
        feedback = await bench.master.enable()
        assert feedback.states == (AxisState.ENABLED,) * 12
        assert exchange(bench.master, feedback.position_mm).fault is None
        await bench.master.close()

    run_virtual(main)


def test_a_watchdog_that_reads_right_and_does_nothing_is_found_only_by_the_pause() -> None:
    async def main() -> None:
        trusting = Bench(can_cell())
        deaf_but_right(trusting, "C.Y")
        await trusting.master.bring_up()
        await trusting.master.close()
        bench = proved_at_start()
        deaf_but_right(bench, "C.Y")
        with pytest.raises(WatchdogUnproved) as caught:
            await bench.master.bring_up()
        assert caught.value.where == "C.Y"
        assert "1016h" in caught.value.cause

    run_virtual(main)


def test_a_watchdog_that_acts_too_late_is_refused() -> None:
    async def main() -> None:
        late = Bench(can_cell(prove_watchdog=True), DriveSettings(watchdog_scatter_s=0.2))
        offsets = {
            n.number: DriveSettings(watchdog_scatter_s=0.2).watchdog_offset_s(n.number) for n in late.drives.nodes
        }
        with pytest.raises(WatchdogUnproved) as caught:
            await late.master.bring_up()
        first = next(n for n, by_s in offsets.items() if by_s > 0.1 * TIMEOUT_S + 0.02)
        assert caught.value.where == late.cell.axis_names[first - 1]

    run_virtual(main)


def test_it_can_be_asked_for_later_but_never_under_torque() -> None:
    async def main() -> None:
        bench = Bench(can_cell())
        await bench.master.bring_up()
        await bench.master.prove_watchdogs()
        await bench.master.enable()
        with pytest.raises(WatchdogUnproved, match="enabled"):
            await bench.master.prove_watchdogs()
        await asyncio.sleep(1.0)
        feedback = exchange(bench.master, bench.start_mm)
        assert feedback.states == (AxisState.ENABLED,) * 12
        assert feedback.fault is None
        await bench.master.close()

    run_virtual(main)


def test_drives_that_keep_the_loss_as_a_fault_stay_disabled_until_somebody_resets_them() -> None:
    async def main() -> None:
        bench = Bench(can_cell())
        await bench.master.bring_up()
        await bench.master.prove_watchdogs()
        bench.drives.trip("B.X", LOST)
        await asyncio.sleep(0.05)
        with pytest.raises(EnableFailed, match="heartbeat of the controller lost"):
            await bench.master.enable()
        await bench.master.reset_faults()
        assert (await bench.master.enable()).states == (AxisState.ENABLED,) * 12
        await bench.master.close()

    run_virtual(main)


def test_it_is_told_how_soon_every_drive_missed_the_controller() -> None:
    async def main() -> None:
        bench = Bench(can_cell(), DriveSettings(watchdog_scatter_s=0.02))
        await bench.master.bring_up()
        took = await bench.master.prove_watchdogs()
        assert list(took) == list(bench.master.axes)
        assert all(TIMEOUT_S - 0.03 <= s <= 1.1 * TIMEOUT_S + 0.02 for s in took.values())
        assert max(took.values()) - min(took.values()) > 0.01
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)


def test_it_is_not_tried_where_a_brake_is_open() -> None:
    async def main() -> None:
        bench = Bench(can_cell())
        await bench.master.bring_up()
        bench.drives.drives.braked[4] = False
        bench.drives.drives._report(4)
        await asyncio.sleep(0.05)
        with pytest.raises(WatchdogUnproved) as caught:
            await bench.master.prove_watchdogs()
        assert caught.value.where == "B.Y"
        assert "brake" in caught.value.text()
        await bench.master.close()
        bench.drives.close()

    run_virtual(main)
