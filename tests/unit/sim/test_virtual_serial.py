"""The virtual serial line: wire time, order, loss."""

from __future__ import annotations

import asyncio

import pytest

from docking.errors import LinkLost, PortMissing
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial


def test_bytes_take_ten_bits_each_and_queue_behind_each_other() -> None:
    arrivals: list[tuple[float, bytes]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, 9600)
        wire.far.on_bytes = lambda data: arrivals.append((loop.time(), data))
        await wire.near.open()
        wire.near.write(b"x" * 96)
        wire.near.write(b"y" * 48)
        await asyncio.sleep(1.0)
        wire.near.write(b"z")
        await asyncio.sleep(1.0)

    run_virtual(main)
    assert [data for _, data in arrivals] == [b"x" * 96, b"y" * 48, b"z"]
    assert [t for t, _ in arrivals] == pytest.approx([0.1, 0.15, 1.0 + 10 / 9600])


def test_the_directions_do_not_wait_for_each_other() -> None:
    arrivals: list[tuple[str, float]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, 1000)
        wire.far.on_bytes = lambda data: arrivals.append(("device", loop.time()))
        wire.near.on_bytes = lambda data: arrivals.append(("host", loop.time()))
        await wire.near.open()
        wire.near.write(b"12345")
        wire.far.write(b"1234567890")
        await asyncio.sleep(1.0)

    run_virtual(main)
    assert arrivals == [("device", pytest.approx(0.05)), ("host", pytest.approx(0.1))]


def test_unplugging_loses_what_is_under_way_and_says_so_once() -> None:
    heard: list[bytes] = []
    lost: list[str] = []

    async def main() -> None:
        wire = VirtualSerial(asyncio.get_running_loop(), 9600)
        wire.near.on_bytes, wire.near.on_lost = heard.append, lost.append
        await wire.near.open()
        wire.far.write(b"too late")
        wire.unplug("pulled")
        wire.unplug("pulled again")
        with pytest.raises(LinkLost):
            wire.near.write(b"x")
        with pytest.raises(PortMissing):
            await wire.near.open()
        await asyncio.sleep(1.0)
        wire.replug()
        await wire.near.open()
        wire.far.write(b"back")
        await asyncio.sleep(1.0)

    run_virtual(main)
    assert heard == [b"back"]
    assert lost == ["pulled"]


def test_a_closed_host_hears_nothing_and_no_loss() -> None:
    heard: list[object] = []

    async def main() -> None:
        wire = VirtualSerial(asyncio.get_running_loop(), 9600)
        wire.near.on_bytes = wire.near.on_lost = heard.append
        await wire.near.open()
        wire.far.write(b"x")
        wire.near.close()
        wire.unplug()
        await asyncio.sleep(1.0)

    run_virtual(main)
    assert heard == []
