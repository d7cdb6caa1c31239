"""The simulated line-protocol device, spoken to in raw bytes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.tracker.crc import checksum
from sim.tracker.line import LineTrackerDevice
from sim.virtual_time import run_virtual
from tests.fakes.tracker_optics import FakeOptics


class Wire:
    """The device's end without a line: bytes out are kept with their time."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.sent: list[tuple[float, str]] = []
        self._loop = loop

    def write(self, data: bytes) -> None:
        body, crc = data[1:-2].rsplit(b"*", 1)
        assert data[:1] == b"$"
        assert data[-2:] == b"\r\n"
        assert crc == b"%04X" % checksum(body)
        self.sent.append((round(self._loop.time(), 6), body.decode()))


def line(body: str) -> bytes:
    return b"$" + body.encode() + b"*%04X\r\n" % checksum(body.encode())


def talk(*items: bytes | float, optics: FakeOptics | None = None) -> list[tuple[float, str]]:
    """Send bytes, wait seconds, in turn; return what the device sent."""

    async def main() -> list[tuple[float, str]]:
        loop = asyncio.get_running_loop()
        wire = Wire(loop)
        device = LineTrackerDevice(optics or FakeOptics(noise_mm=0.0), wire, loop)
        for item in items:
            if isinstance(item, bytes):
                wire.on_bytes(item)
            else:
                await asyncio.sleep(item)
        device.close()
        return wire.sent

    return run_virtual(main)


def test_checksum_vector() -> None:
    assert checksum(b"123456789") == 0xBB3D


def test_a_measurement_with_heartbeats() -> None:
    sent = talk(1.0, line("MEA,5,N1,1"), 5.0)
    assert [t for t, body in sent if body.startswith("HBT")][:4] == [1.4, 1.8, 2.2, 2.6]
    assert sent[0][1] == "HBT,1,1400000,1"
    assert sent[-1] == (3.0, "PNT,5,3000000,N1,4123456,-876050,250000,1,1,1,1")


def test_averaging_takes_its_time() -> None:
    optics = FakeOptics(noise_mm=0.1)
    sent = talk(line("MEA,5,N1,4"), 10.0, optics=optics)
    assert sent[-1][0] == 8.0
    assert len(optics.shots) == 4
    x_mm = int(sent[-1][1].split(",")[4]) / 1000.0
    assert x_mm == pytest.approx(4123.456, abs=0.2)


def test_face_two_is_echoed() -> None:
    assert talk(line("MEA,5,N1,1,2"), 3.0)[-1][1].endswith(",17")


def test_a_later_request_takes_the_place_of_the_one_that_runs() -> None:
    sent = talk(line("MEA,5,N1,1"), 1.0, line("MEA,6,N2,1"), 5.0)
    points = [body for _, body in sent if body.startswith("PNT")]
    assert [body.split(",")[1] for body in points] == ["6"]


def test_stop_leaves_nothing_behind() -> None:
    sent = talk(line("MEA,5,N1,1"), 0.1, line("STP,6"), 5.0)
    assert [body for _, body in sent] == ["ACK,6"]


def test_recall_gives_the_time_of_the_measurement() -> None:
    sent = talk(line("GET,1,N1"), line("MEA,2,N1,1"), 10.0, line("GET,3,N1"), 1.0)
    assert sent[0][1] == "ERR,1,10,not measured since power-up"
    assert sent[-1][1].split(",")[:4] == ["PNT", "3", "2000000", "N1"]


@pytest.mark.parametrize(
    ("body", "code"),
    [("MEA,1,N1", 2), ("MEA,1,N 1,1", 2), ("MEA,1,N1,0", 2), ("MEA,1,N1,1,3", 2), ("STR,1,50", 1), ("ZZZ,1", 1)],
)
def test_bad_requests_are_refused_with_a_code(body: str, code: int) -> None:
    sent = talk(line(body), 1.0)
    assert sent[0][1].split(",")[:3] == ["ERR", "1", str(code)]


def test_unreadable_requests_get_no_answer() -> None:
    assert talk(line("VER,1").replace(b"*", b"*0"), b"garbage\r\n$VER,1*0000\r\n", 1.0) == []


@given(st.binary(max_size=300))
def test_no_bytes_upset_the_device(data: bytes) -> None:
    assert talk(data + b"\n" + line("VER,9"), 0.1)[-1][1].startswith("IDN,9,1,")
