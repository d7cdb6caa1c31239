"""The CAN link over real wires: the AF_UNIX bus watched by the loop, python-can's virtual bus read by a thread."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path

import can
import can.interfaces.virtual
import numpy as np
import pytest

from docking.errors import LinkLost, PortMissing
from docking.ports import CanFrame
from docking.types import AxisState
from drivers.canopen.positioners import CanopenPositioners
from drivers.links.can_bus import CanBusLink
from drivers.links.unix_bus import UnixBus
from sim.canopen import DriveGroup, DriveSettings
from sim.wires.unix_can import UnixCanServer
from tests.support.can_bench import FakePlant, can_cell, exchange

pytestmark = pytest.mark.wires


async def until(condition: Callable[[], bool]) -> None:
    for _ in range(400):
        if condition():
            return
        await asyncio.sleep(0.005)
    pytest.fail("not within 2 s")


async def test_master_and_drives_over_the_unix_bus(tmp_path: Path) -> None:
    cell = can_cell("lab-can")
    plant = FakePlant(cell.axis_names, np.linspace(-1.0, 1.0, 12), np.array(cell.driven))
    server = UnixCanServer(tmp_path / "can0")
    await server.open()
    loop = asyncio.get_running_loop()
    group = DriveGroup(plant, cell, DriveSettings(), server, loop)
    group.start()
    master = CanopenPositioners(cell, CanBusLink("docking-unix", str(tmp_path / "can0"), 1_000_000))
    try:
        await master.bring_up()
        q = (await master.enable()).position_mm
        start = loop.time()
        for k in range(50):
            feedback = exchange(master, q + 0.01 * (k + 1))
            await asyncio.sleep(start + 0.01 * (k + 1) - loop.time())
        for _ in range(10):
            feedback = exchange(master, q + 0.5)
            await asyncio.sleep(0.01)
        assert feedback.states == (AxisState.ENABLED,) * 12
        assert feedback.fault is None
        np.testing.assert_allclose(feedback.position_mm, q + 0.5, atol=1e-4)
        await master.close()
        assert group.drives.braked.all()
    finally:
        group.close()
        server.close()


async def test_every_station_hears_every_other_and_order_is_kept(tmp_path: Path) -> None:
    server = UnixCanServer(tmp_path / "can0")
    await server.open()
    heard: list[CanFrame] = []
    server.on_frames = heard.extend
    first, second = (CanBusLink("docking-unix", str(tmp_path / "can0"), 1_000_000) for _ in range(2))
    received: list[CanFrame] = []
    second.on_frames = received.extend
    try:
        await first.open()
        await second.open()
        await until(lambda: server.stations == 2)
        batch = [(i, bytes([i % 256] * (i % 9))) for i in range(1, 200)]
        first.send(batch)
        await until(lambda: len(received) == len(batch))
        assert received == batch
        assert heard == batch
        server.send([(0x7FF, b"\x01\x02")])
        await until(lambda: len(received) == len(batch) + 1)
        assert received[-1] == (0x7FF, b"\x01\x02")
    finally:
        first.close()
        second.close()
        server.close()


async def test_a_bus_that_ends_is_reported_once(tmp_path: Path) -> None:
    server = UnixCanServer(tmp_path / "can0")
    await server.open()
    link = CanBusLink("docking-unix", str(tmp_path / "can0"), 1_000_000)
    lost: list[str] = []
    link.on_lost = lost.append
    await link.open()
    await until(lambda: server.stations == 1)
    server.close()
    await until(lambda: bool(lost))
    link.send([(1, b"")])
    await asyncio.sleep(0.05)
    assert len(lost) == 1
    link.close()


async def test_missing_bus_is_named(tmp_path: Path) -> None:
    for interface, channel in (("docking-unix", str(tmp_path / "nothing")), ("no-such-interface", "x")):
        link = CanBusLink(interface, channel, 1_000_000)
        with pytest.raises(PortMissing) as caught:
            await link.open()
        assert caught.value.value == channel


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (NameError("name 'canOpenChannel' is not defined"), "library of the adapter's maker"),
        (TypeError("missing 2 required positional arguments"), "2 required"),
        (OSError(errno.ENODEV, "No such device"), "ip link"),
        (OSError(errno.ENETDOWN, "Network is down"), "ip link set NAME up"),
        (can.CanInitializationError("cannot", errno.EACCES), "permission denied"),
        (can.CanInitializationError("no bit rate"), "no bit rate"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
async def test_whatever_way_an_interface_fails_it_is_named(
    error: Exception, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(PortMissing) as caught:
        await CanBusLink("kvaser", "0", 500_000).open()
    assert caught.value.where == "bus kvaser"
    assert told in caught.value.text()


@pytest.mark.parametrize("error", [can.CanOperationError("adapter gone"), OSError(5, "gone"), ValueError("gone")])
async def test_a_reading_thread_that_ends_tells_so(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    class Failing(can.interfaces.virtual.VirtualBus):
        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            raise error

    lost: list[str] = []
    link = CanBusLink("virtual", "failing", 500_000)
    link.on_lost = lost.append
    monkeypatch.setattr(can, "Bus", lambda channel, **_: Failing(channel))
    await link.open()
    await until(lambda: bool(lost))
    assert "gone" in lost[0]
    assert ("no frame" in lost[0]) is isinstance(error, ValueError)


async def test_losing_the_bus_while_it_is_brought_up(tmp_path: Path) -> None:
    server = UnixCanServer(tmp_path / "can0")
    await server.open()
    master = CanopenPositioners(can_cell("lab-can"), CanBusLink("docking-unix", str(server.path), 1_000_000))
    asyncio.get_running_loop().call_later(0.2, server.close)
    with pytest.raises(LinkLost, match=r"far end closed|cannot send"):
        await master.bring_up()
    await master.close()


async def test_a_bus_without_descriptor_is_read_by_a_thread() -> None:
    link = CanBusLink("virtual", "thread-test", 1_000_000)
    received: list[CanFrame] = []
    link.on_frames = received.extend
    await link.open()
    with can.Bus(interface="virtual", channel="thread-test") as other:
        for number in range(50):
            other.send(can.Message(arbitration_id=number, data=[number], is_extended_id=False))
        other.send(can.Message(arbitration_id=0x18FF0000, data=[1], is_extended_id=True))
        await until(lambda: len(received) == 50)
        assert received == [(number, bytes([number])) for number in range(50)], "extended frames are not ours"
        link.send([(0x123, b"ab")])
        message = other.recv(1.0)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x123, b"ab")
    link.close()


def test_python_can_finds_the_interface_by_class(tmp_path: Path) -> None:
    with pytest.raises(can.CanInitializationError, match="No such file"):
        UnixBus(str(tmp_path / "nothing"))
