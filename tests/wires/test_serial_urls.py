"""Any pyserial URL: the tracker drivers over a raw socket and over a telnet port server (RFC 2217), in real time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
import serial.rfc2217

from docking.config.instruments import InertialConfig, NdiConfig
from docking.errors import LinkLost
from docking.sightings import InertialSample, PointFrame
from drivers.geocom_tracker import GeocomTracker
from drivers.line_tracker import LineTracker
from drivers.links.serial_port import SerialPort
from drivers.ndi_stream import NdiStream
from drivers.vectornav import VectorNav
from sim.tracker.geocom import GeocomStation
from sim.tracker.line import LineTrackerDevice
from sim.tracker.ndi import NdiCamera
from sim.tracker.vectornav import VectorNavSensor
from sim.wires.pty_serial import PtySerial
from tests.fakes.camera_scene import ROM_A, FakeScene
from tests.fakes.tracker_optics import POINTS, FakeOptics
from tests.wires.test_serial_wires import BAUD, config, covariance

pytestmark = [
    pytest.mark.wires,
    # pyserial's RFC 2217 client still names its thread by setName and setDaemon.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:serial.rfc2217"),
]


class Port:
    """What a port server holds: a serial port with settings and modem lines."""

    bytesize, parity, stopbits = 8, "N", 1
    baudrate = 9600
    rtscts = xonxoff = dsrdtr = break_condition = False
    cts = dsr = cd = dtr = rts = True
    ri = False

    def reset_input_buffer(self) -> None: ...

    def reset_output_buffer(self) -> None: ...


class Wire(asyncio.Protocol):
    """The device's end of one connection: raw, or behind pyserial's own server of RFC 2217."""

    def __init__(self, make: Callable[[Wire], Any], port: Port | None) -> None:
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.on_break: Callable[[], None] = lambda: None
        self._make, self._port = make, port

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if self._port is not None:
            self._manager = serial.rfc2217.PortManager(self._port, transport)
        self.device = self._make(self)

    def data_received(self, data: bytes) -> None:
        self.on_bytes(data if self._port is None else b"".join(self._manager.filter(data)))

    def write(self, data: bytes) -> None:
        self._transport.write(data if self._port is None else b"".join(self._manager.escape(data)))

    def set_baud(self, baud: int) -> None: ...


@asynccontextmanager
async def served(make: Callable[[Wire], Any], scheme: str) -> AsyncIterator[tuple[str, Port]]:
    """A device behind a loopback port; its URL and the settings that the client has made."""
    port = Port()
    loop = asyncio.get_running_loop()
    wires: list[Wire] = []

    def wire() -> Wire:
        wires.append(Wire(make, port if scheme == "rfc2217" else None))
        return wires[-1]

    server = await loop.create_server(wire, "127.0.0.1", 0)
    yield f"{scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}", port
    for made in wires:
        made._transport.close()
        if hasattr(made.device, "close"):
            made.device.close()
    server.close()
    await server.wait_closed()


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
async def test_the_trackers_measure_over_the_network(scheme: str) -> None:
    loop, optics = asyncio.get_running_loop(), FakeOptics(measure_s=0.05, noise_mm=0.0)
    async with served(lambda wire: GeocomStation(optics, wire, loop), scheme) as (url, port):
        station = GeocomTracker(SerialPort(url, BAUD), config("geocom"), covariance)
        assert (await station.connect()).serial == "366001"
        reading = await station.measure("N1", np.array(POINTS["N1"]) + 5.0)
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N1"], atol=1e-6)
        await station.close()
        assert port.baudrate == (BAUD if scheme == "rfc2217" else 9600)
    async with served(lambda wire: LineTrackerDevice(optics, wire, loop), scheme) as (url, _):
        tracker = LineTracker(SerialPort(url, BAUD), config("line"), covariance)
        assert (await tracker.connect()).serial == "LT-0001"
        reading = await tracker.measure("N2", np.zeros(3))
        np.testing.assert_allclose(reading.p_T_mm, POINTS["N2"], atol=0.0005)
        await tracker.close()


async def test_the_camera_changes_the_speed_of_a_port_server() -> None:
    loop, frames = asyncio.get_running_loop(), list[PointFrame]()
    async with served(lambda wire: NdiCamera(FakeScene(), wire, loop, {ROM_A: "nose"}), "rfc2217") as (url, port):
        stream = NdiStream(SerialPort(url, 9600, "camera"), NdiConfig(port=url), {"nose": ROM_A})
        stream.on_frame = frames.append
        assert (await stream.connect()).vendor == "NDI"
        await stream.start()
        await asyncio.sleep(0.3)
        await stream.close()
        assert port.baudrate == 115200
        assert len(frames) > 5


async def test_the_inertial_sensor_streams_over_a_socket() -> None:
    loop, samples = asyncio.get_running_loop(), list[InertialSample]()
    pose = np.eye(3), np.zeros(3)
    async with served(lambda wire: VectorNavSensor(lambda t_s: pose, wire, loop), "socket") as (url, _):
        sensor = VectorNav(SerialPort(url, BAUD, "inertial sensor"), InertialConfig(port=url))
        sensor.on_sample = samples.append
        assert (await sensor.connect()).serial == "0100012345"
        await sensor.start()
        await asyncio.sleep(0.3)
        await sensor.close()
        assert len(samples) > 5


async def test_a_connection_that_the_far_end_closes_is_lost_by_the_devices_name() -> None:
    loop, lost = asyncio.get_running_loop(), asyncio.Event()
    sensors: list[VectorNavSensor] = []

    def make(wire: Wire) -> VectorNavSensor:
        loop.call_later(0.6, wire._transport.close)
        sensors.append(VectorNavSensor(lambda t_s: (np.eye(3), np.zeros(3)), wire, loop))
        return sensors[-1]

    async with served(make, "socket") as (url, _):
        sensor = VectorNav(SerialPort(url, BAUD, "inertial sensor"), InertialConfig(port=url))
        errors: list[Exception] = []
        sensor.on_lost = lambda error: (errors.append(error), lost.set())[0]
        await sensor.connect()
        await sensor.start()
        async with asyncio.timeout(3.0):
            await lost.wait()
        assert isinstance(errors[0], LinkLost)
        assert errors[0].where == "inertial sensor"
        await sensor.close()


async def test_the_camera_runs_over_a_pty_where_no_break_passes() -> None:
    loop = asyncio.get_running_loop()
    terminal = PtySerial(loop, 9600)
    terminal.open()
    camera = NdiCamera(FakeScene(), terminal, loop, {ROM_A: "nose"})
    stream, frames = NdiStream(SerialPort(terminal.path, 9600, "camera"), NdiConfig(port="x"), {"nose": ROM_A}), []
    stream.on_frame = frames.append
    await stream.connect()
    await stream.start()
    await asyncio.sleep(0.6)
    await stream.stop()
    await stream.close()
    terminal.close()
    # A pty has no speed: the first one asked is answered, and the camera stays at its own.
    assert camera._baud == 9600
    assert len(frames) >= 1
