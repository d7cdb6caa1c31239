"""A second controller on a bus sends nothing, and what the first one carries goes on."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from docking.errors import LinkLost
from docking.ports import CanFrame
from docking.types import FaultKind
from drivers.canopen.positioners import CanopenPositioners
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange


def listened(bench: Bench) -> tuple[CanopenPositioners, list[CanFrame]]:
    """A second controller of the same cell, and what it sends."""
    end = bench.bus.end()
    sent: list[CanFrame] = []
    put = end.send
    end.send = lambda frames: (sent.extend(frames), put(frames))[1]  # type: ignore[method-assign]
    return CanopenPositioners(bench.cell, end), sent


def test_a_second_controller_is_refused_and_the_move_of_the_first_goes_on() -> None:
    async def main() -> None:
        bench = Bench(can_cell("lab-can"))
        await bench.ready()
        second, sent = listened(bench)
        q_mm = bench.master.latest().position_mm
        refused = asyncio.ensure_future(second.bring_up())
        for step in range(100):
            feedback = exchange(bench.master, q_mm + 0.02 * (step + 1))
            await asyncio.sleep(bench.master.cycle_s)
        with pytest.raises(LinkLost, match="Another controller"):
            await refused
        await second.close()
        assert sent == []
        assert feedback.fault is None
        assert feedback.fault_kind is FaultKind.DRIVE_FAULT, "the default: nothing was noticed"
        np.testing.assert_allclose(feedback.position_mm, q_mm + 2.0, atol=0.2)
        await bench.master.close()
        # Where nobody leads the axes any more it may, once the last frames of the first are through.
        await asyncio.sleep(0.1)
        await second.bring_up()
        await second.close()
        bench.drives.close()

    run_virtual(main)


@pytest.mark.parametrize(
    ("frame", "alone"),
    [
        ((0x000, b"\x80\x00"), False),
        ((0x77F, b"\x05"), False),
        ((0x201, b"\x06\x00\x00\x00\x00\x00\x08"), False),
        ((0x30C, b"\x06\x00"), False),
        ((0x080, b""), True),
        ((0x701, b"\x7f"), True),
        ((0x181, b"\x40\x02\x00\x00\x00\x00\x00\x00"), True),
        ((0x601, b"\x40\x41\x60\x00\x00\x00\x00\x00"), True),
        ((0x220, b"\x00"), True),
    ],
    ids=["network command", "heartbeat of a host", "set-point", "set-point 2", "SYNC", "heartbeat of a drive",
         "read-back", "SDO of a monitor", "set-point to another node"],
)  # fmt: skip
def test_what_another_controller_is_known_by(frame: CanFrame, alone: bool) -> None:
    async def main() -> None:
        bench = Bench(can_cell("lab-can"))
        stranger = bench.bus.end()
        await stranger.open()
        asyncio.get_running_loop().call_later(0.9 * bench.cell.bus.heartbeat_s, stranger.send, [frame])  # type: ignore[union-attr]
        second, sent = listened(bench)
        if alone:
            await second.bring_up()
            assert sent
        else:
            with pytest.raises(LinkLost, match="Another controller"):
                await second.bring_up()
            assert sent == []
        await second.close()
        bench.drives.close()

    run_virtual(main)
