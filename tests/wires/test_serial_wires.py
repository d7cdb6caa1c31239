"""SerialPort and PtySerial on a real pseudo-terminal and a real socket, in real time."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from docking.config.cell import ErsPoint, TrackerConfig
from docking.errors import LinkLost, PortMissing
from docking.ports import SerialLink
from docking.types import Array
from drivers.geocom_tracker import GeocomTracker
from drivers.line_tracker import LineTracker
from drivers.links.serial_port import INBOX_LIMIT, SerialPort
from sim.tracker.geocom import GeocomStation
from sim.tracker.line import LineTrackerDevice
from sim.wires.pty_serial import PtySerial
from tests.fakes.tracker_optics import POINTS, FakeOptics

pytestmark = pytest.mark.wires
BAUD = 115200


async def until(condition: Callable[[], object], limit_s: float = 5.0) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


def config(protocol: str) -> TrackerConfig:
    ers = tuple(ErsPoint(name=f"E{i}", xyz_mm=(float(i), 0.0, 0.0), sigma_mm=0.01) for i in range(4))
    return TrackerConfig(
        protocol=protocol,  # type: ignore[arg-type]
        port="x",
        device_class="laser-tracker",
        station_pose=(0.0,) * 6,
        ers=ers,
        two_face=True,
    )


def covariance(p_T_mm: Array) -> Array:
    return 0.0025 * np.eye(3)


def reader_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("serial ")]


async def test_bytes_both_ways_and_a_client_that_comes_again(tmp_path: Path) -> None:
    terminal = PtySerial(asyncio.get_running_loop(), BAUD, tmp_path / "port")
    terminal.open()
    at_device, at_host = bytearray(), bytearray()
    terminal.on_bytes = at_device.extend
    for turn in range(3):
        port = SerialPort(str(tmp_path / "port"), BAUD)
        port.on_bytes = at_host.extend
        await port.open()
        port.write(b"\x00\x03\x04\x11\x13\n\r\xff%d" % turn)  # no terminal processing on the way
        await until(lambda: at_device.endswith(b"%d" % turn))  # noqa: B023
        terminal.write(b"\x00\x03\x04\x11\x13\n\r\xff")
        await until(lambda: len(at_host) == 8 * (turn + 1))  # noqa: B023
        port.close()
        with pytest.raises(LinkLost):
            port.write(b"x")
    terminal.close()
    assert bytes(at_device[:9]) == b"\x00\x03\x04\x11\x13\n\r\xff0"
    assert bytes(at_host[:8]) == b"\x00\x03\x04\x11\x13\n\r\xff"
    assert not (tmp_path / "port").exists()
    assert reader_threads() == []


async def test_the_pty_is_paced() -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, 9600)
    terminal.open()
    port, at_host = SerialPort(terminal.path, 9600), bytearray()
    port.on_bytes = at_host.extend
    await port.open()
    start_s = loop.time()
    terminal.write(b"x" * 192)
    await until(lambda: len(at_host) == 192)
    assert 0.2 <= loop.time() - start_s < 1.0
    port.close()
    terminal.close()


async def test_a_vanished_device_is_reported_once_in_words() -> None:
    terminal = PtySerial(asyncio.get_running_loop(), BAUD)
    terminal.open()
    port, lost = SerialPort(terminal.path, BAUD), list[str]()
    port.on_lost = lost.append
    await port.open()
    terminal.close()
    await until(lambda: lost)
    await asyncio.sleep(0.3)
    assert len(lost) == 1
    assert "unplugged" in lost[0]
    with pytest.raises(LinkLost):
        port.write(b"x")
    port.close()
    await until(lambda: not reader_threads())


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/no-such-port", "no such device"),
        ("/etc/hostname", "not a serial port"),
        ("socket://127.0.0.1:1", "refused"),
        ("nonsense://x", "nonsense"),
    ],
)
async def test_a_port_that_cannot_be_opened_says_why(url: str, words: str) -> None:
    with pytest.raises(PortMissing) as caught:
        await SerialPort(url, BAUD).open()
    assert words in caught.value.cause
    assert caught.value.value == url


async def test_a_port_is_not_shared() -> None:
    terminal = PtySerial(asyncio.get_running_loop(), BAUD)
    terminal.open()
    first = SerialPort(terminal.path, BAUD)
    await first.open()
    with pytest.raises(PortMissing, match="another program"):
        await SerialPort(terminal.path, BAUD).open()
    first.close()
    terminal.close()


async def test_a_stalled_loop_keeps_the_newest_bytes() -> None:
    terminal = PtySerial(asyncio.get_running_loop(), BAUD)
    terminal.open()
    port, at_host = SerialPort(terminal.path, BAUD), bytearray()
    port.on_bytes = at_host.extend
    await port.open()
    port._keep(b"old" + bytes(INBOX_LIMIT))
    port._keep(b"newest")
    await until(lambda: at_host)
    assert len(at_host) == INBOX_LIMIT
    assert at_host.endswith(b"newest")
    assert port.dropped_bytes == 9
    port.close()
    terminal.close()


async def test_the_line_tracker_measures_over_a_pty() -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, BAUD)
    terminal.open()
    LineTrackerDevice(FakeOptics(measure_s=0.5, noise_mm=0.0), terminal, loop)
    link: SerialLink = SerialPort(terminal.path, BAUD)
    tracker = LineTracker(link, config("line"), covariance)
    assert (await tracker.connect()).serial == "LT-0001"
    reading = await tracker.measure("N2", np.zeros(3))
    np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=0.0005)
    task = asyncio.ensure_future(tracker.measure("N1", np.zeros(3)))
    await asyncio.sleep(0.1)
    terminal.close()
    with pytest.raises(LinkLost):
        await task
    await tracker.close()


async def test_the_geocom_tracker_measures_over_a_socket() -> None:
    loop = asyncio.get_running_loop()

    class Wire(asyncio.Protocol):
        on_bytes: Callable[[bytes], None]

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            assert isinstance(transport, asyncio.Transport)
            self.write = transport.write
            GeocomStation(FakeOptics(measure_s=0.05, noise_mm=0.0), self, loop)

        def data_received(self, data: bytes) -> None:
            self.on_bytes(data)

    server = await loop.create_server(Wire, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    tracker = GeocomTracker(SerialPort(f"socket://127.0.0.1:{port}", BAUD), config("geocom"), covariance)
    await tracker.connect()
    for face in (1, 2):
        reading = await tracker.measure("N1", np.array(POINTS["N1"]) + 5.0, face)
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N1"], atol=1e-6)
    await tracker.close()
    server.close()
    await server.wait_closed()


async def test_what_a_sleeping_client_cannot_take_is_lost_not_blocking() -> None:
    terminal = PtySerial(asyncio.get_running_loop(), 1_000_000)
    terminal.open()
    client = os.open(terminal.path, os.O_RDWR | os.O_NOCTTY)
    for _ in range(64):
        terminal.write(bytes(1024))
    await until(lambda: terminal.lost_bytes > 0)
    os.close(client)
    terminal.close()
    terminal.write(b"a device may still speak when its wire is gone")
    await asyncio.sleep(0.01)
