"""An slcan adapter on a pseudo-terminal: python-can is the peer that speaks the text, the product's master drives."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace

import can
import numpy as np
import pytest

from docking.ports import CanFrame
from docking.types import AxisState
from drivers.canopen.positioners import CanopenPositioners
from drivers.links.can_bus import CanBusLink
from sim.canopen import DriveGroup, DriveSettings
from sim.wires.pty_serial import PtySerial
from sim.wires.slcan import SlcanAdapter, parse_frame
from tests.support.can_bench import FakePlant, can_cell, exchange

pytestmark = pytest.mark.wires

USB_BAUD = 3_000_000
"""A USB adapter's own speed: the text of 12 axes at 100 Hz is 60 kB/s."""


@pytest.fixture
async def terminal(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[PtySerial]:
    # python-can gives boards that restart when their port is opened two seconds; this one does not restart.
    impatient = SimpleNamespace(sleep=lambda _: None, time=time.time)
    monkeypatch.setattr("can.interfaces.slcan.time", impatient)
    line = PtySerial(asyncio.get_running_loop(), USB_BAUD)
    line.open()
    yield line
    line.close()


async def until(condition: Callable[[], object]) -> None:
    for _ in range(400):
        if condition():
            return
        await asyncio.sleep(0.005)
    pytest.fail("not within 2 s")


async def test_twelve_drives_are_brought_up_and_follow_through_an_adapter(terminal: PtySerial) -> None:
    cell = can_cell("lab-can")
    adapter = SlcanAdapter(terminal)
    plant = FakePlant(cell.axis_names, np.linspace(-1.0, 1.0, 12), np.array(cell.driven))
    loop = asyncio.get_running_loop()
    group = DriveGroup(plant, cell, DriveSettings(), adapter, loop)
    master = CanopenPositioners(cell, CanBusLink("slcan", terminal.path, 1_000_000))
    group.start()
    try:
        identities = await master.bring_up()
        assert [identity.serial for identity in identities] == [str(402_001 + k) for k in range(12)]
        q = (await master.enable()).position_mm
        start = loop.time()
        for k in range(60):
            feedback = exchange(master, q + min(0.01 * (k + 1), 0.5))
            await asyncio.sleep(start + 0.01 * (k + 1) - loop.time())
        assert feedback.states == (AxisState.ENABLED,) * 12
        assert feedback.fault is None
        np.testing.assert_allclose(feedback.position_mm, q + 0.5, atol=1e-4)
        await master.close()
        assert group.drives.braked.all()
        assert adapter.bit_rate == 1_000_000
        await until(lambda: not adapter.is_open)
    finally:
        group.close()


async def test_every_frame_passes_whole_and_in_order_both_ways(terminal: PtySerial) -> None:
    adapter = SlcanAdapter(terminal)
    to_devices: list[CanFrame] = []
    to_master: list[CanFrame] = []
    adapter.on_frames = to_devices.extend
    link = CanBusLink("slcan", terminal.path, 500_000)
    link.on_frames = to_master.extend
    frames = [(cob, bytes((cob + n) & 0xFF for n in range(cob % 9))) for cob in range(0, 0x800, 29)]
    await link.open()
    await until(lambda: adapter.is_open)
    link.send(frames)
    await until(lambda: len(to_devices) == len(frames))
    adapter.send(frames)
    await until(lambda: len(to_master) == len(frames))
    link.close()
    assert to_devices == to_master == frames
    assert adapter.bit_rate == 500_000


@pytest.mark.parametrize("garbage", [b"throughput 9600\r", b"t18", b"t1\r", b"\xff\xfet\r"])
async def test_an_adapter_that_sends_no_frames_is_lost_in_words(terminal: PtySerial, garbage: bytes) -> None:
    adapter = SlcanAdapter(terminal)
    lost: list[str] = []
    heard: list[CanFrame] = []
    link = CanBusLink("slcan", terminal.path, 1_000_000)
    link.on_lost, link.on_frames = lost.append, heard.extend
    await link.open()
    await until(lambda: adapter.is_open)
    terminal.write(garbage)
    adapter.send([(0x181, b"\x01")])
    await until(lambda: lost)
    assert "no frame" in lost[0] or "read" in lost[0]
    assert heard == []


async def test_a_pulled_adapter_is_lost(terminal: PtySerial) -> None:
    adapter = SlcanAdapter(terminal)
    lost: list[str] = []
    link = CanBusLink("slcan", terminal.path, 1_000_000)
    link.on_lost = lost.append
    await link.open()
    await until(lambda: adapter.is_open)
    terminal.close()
    await until(lambda: lost)


async def test_reading_an_empty_line_does_not_hold_the_loop(terminal: PtySerial) -> None:
    """python-can by itself waits a millisecond at the end of every batch."""
    SlcanAdapter(terminal)
    link = CanBusLink("slcan", terminal.path, 1_000_000)
    await link.open()
    bus = link._bus
    assert isinstance(bus, can.BusABC)
    begun = time.perf_counter()
    for _ in range(200):
        assert bus.recv(0) is None
    assert time.perf_counter() - begun < 0.1
    link.close()


@pytest.mark.parametrize(
    "text", [b"", b"18", b"1812", b"181201", b"1819" + b"00" * 9, b"8000", b"1812zz00", b"18120100FF"]
)
def test_what_is_no_frame_is_refused(text: bytes) -> None:
    assert parse_frame(text) is None


def test_a_frame_line() -> None:
    assert parse_frame(b"7FF2a0B1") == (0x7FF, b"\xa0\xb1")
    assert parse_frame(b"0000") == (0, b"")
