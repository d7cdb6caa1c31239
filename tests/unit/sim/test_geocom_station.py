"""The simulated total station, spoken to in raw GeoCOM lines."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.tracker.crc import checksum
from sim.tracker.geocom import GeocomStation
from sim.virtual_time import run_virtual
from tests.fakes.tracker_optics import FakeOptics


class Wire:
    """The device's end without a line: bytes out are kept."""

    def __init__(self) -> None:
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self.sent: list[str] = []

    def write(self, data: bytes) -> None:
        assert data.endswith(b"\r\n")
        self.sent.append(data[:-2].decode("ascii"))


def talk(*items: str | bytes | float, optics: FakeOptics | None = None) -> list[str]:
    """Send request lines, wait seconds, in turn; return the replies."""

    async def main() -> list[str]:
        wire = Wire()
        GeocomStation(optics or FakeOptics(noise_mm=0.0), wire, asyncio.get_running_loop())
        for item in items:
            if isinstance(item, float):
                await asyncio.sleep(item)
            else:
                wire.on_bytes(item if isinstance(item, bytes) else item.encode("latin-1") + b"\r\n")
        await asyncio.sleep(0.1)
        return wire.sent

    return run_virtual(main)


def values(reply: str) -> list[float]:
    return [float(v) for v in reply.split(":")[1].split(",")]


AIM_N1 = "%R1Q,9027,3:1.78,1.51,0,0,0"  # N1 lies at Hz 1.7802, V 1.5115


def test_identity_and_transaction_numbers() -> None:
    assert talk("%R1Q,0,7:", b"\n%R1Q,5003:\r\n", "%R1Q,5004,9:") == [
        "%R1P,0,7:0",
        "%R1P,0,0:0,366001",
        '%R1P,0,9:0,"SIM TS60"',
    ]


def test_unknown_procedures_and_lines() -> None:
    assert talk("%R1Q,4711,1:", "hello", "%R1Q,9027,2:x,1,0,0,0", "%R1Q,107,3:99") == [
        "%R1P,3081,1:0",
        "%R1P,3080,0:0",
        "%R1P,0,2:2",
        "%R1P,0,3:2",
    ]


def test_precision_is_digits_after_the_point() -> None:
    replies = talk("%R1Q,107,1:4", "%R1Q,9027,2:0.123456789,1.5,0,0,0", "%R1Q,2107,3:1")
    assert replies[-1] == "%R1P,0,3:0,0.1235,1.5000"


def test_a_measurement_in_face_one() -> None:
    replies = talk(AIM_N1, "%R1Q,9037,4:0.02,0.02,0", "%R1Q,2008,5:1,1", "%R1Q,2108,6:5000,1", 3.0)
    assert replies[:3] == ["%R1P,0,3:0", "%R1P,0,4:0", "%R1P,0,5:0"]
    code, hz, v, slope_m = values(replies[3])
    assert code == 0
    x, y, z = 4.123456, -0.87605, 0.25
    assert slope_m == pytest.approx(math.sqrt(x * x + y * y + z * z), abs=1e-12)
    assert hz == pytest.approx(math.pi / 2 + math.atan(0.87605 / 4.123456), abs=1e-12)  # a little past east
    assert v == pytest.approx(math.pi / 2 - math.asin(z / slope_m), abs=1e-12)


def test_face_two_reads_half_a_turn_on() -> None:
    first = values(talk(AIM_N1, "%R1Q,9037,4:0.02,0.02,0", "%R1Q,2107,5:1")[-1])
    optics = FakeOptics(noise_mm=0.0)
    replies = talk(AIM_N1, "%R1Q,9028,4:0,1,0", "%R1Q,2107,5:1", "%R1Q,2026,6:", optics=optics)
    second = values(replies[2])
    assert second[1] == pytest.approx(first[1] + math.pi, abs=1e-12)
    assert second[2] == pytest.approx(2 * math.pi - first[2], abs=1e-12)
    assert replies[3] == "%R1P,0,6:0,1"
    assert optics.shots[-1][2] == 2


def test_no_distance_before_it_is_ready_and_none_after_clear() -> None:
    replies = talk(AIM_N1, "%R1Q,2108,4:100,1", 0.2, "%R1Q,2008,5:1,1", "%R1Q,2108,6:500,1", 1.0)
    assert values(replies[1])[0] == 1285
    assert values(replies[1])[3] == 0.0
    assert values(replies[3])[0] == 1285
    replies = talk(AIM_N1, "%R1Q,2008,5:1,1", 3.0, "%R1Q,2108,6:0,1", 0.1, "%R1Q,2008,7:3,1", "%R1Q,2108,8:0,1")
    assert values(replies[2])[0] == 0
    assert values(replies[4])[0] == 1285


def test_the_search_finds_only_what_is_near() -> None:
    assert talk("%R1Q,9027,1:3.0,1.5,0,0,0", "%R1Q,9037,2:0.02,0.02,0")[-1] == "%R1P,0,2:8710"
    assert talk("%R1Q,18005,1:0", AIM_N1, "%R1Q,9037,2:0.02,0.02,0")[-1] == "%R1P,0,2:8714"


def test_search_and_distance_share_one_draw() -> None:
    optics = FakeOptics()
    talk(AIM_N1, "%R1Q,9037,4:0.02,0.02,0", "%R1Q,2008,5:1,1", "%R1Q,2108,6:5000,1", 3.0, optics=optics)
    assert len(optics.shots) == 1
    # A second distance without a search is a draw of its own.
    again = ("%R1Q,2008,7:1,1", "%R1Q,2108,8:5000,1", 3.0)
    talk(AIM_N1, "%R1Q,9037,4:0.02,0.02,0", "%R1Q,2008,5:1,1", "%R1Q,2108,6:5000,1", 3.0, *again, optics=optics)
    assert len(optics.shots) == 3


def test_distance_and_angles_in_one_call() -> None:
    replies = talk(AIM_N1, "%R1Q,9037,4:0.02,0.02,0", "%R1Q,17017,5:2", 3.0, "%R1Q,17017,6:\xb2", "%R1Q,17017,7:")
    assert values(replies[2])[0] == 0
    assert values(replies[2])[3:] == [pytest.approx(math.hypot(4.123456, 0.87605, 0.25), abs=1e-9), 2.0]
    assert replies[3:] == ["%R1P,0,6:2", "%R1P,0,7:2"]


def test_checksum_form() -> None:
    good = checksum(b"%R1Q,5003,7:")
    reply = talk(f"%R1Q,5003,7,{good}:")[0]
    assert reply == f"%R1P,0,7,{checksum(b'%R1P,0,7:0,366001')}:0,366001"
    assert talk(f"%R1Q,5003,7,{good ^ 1}:")[0].startswith("%R1P,3101,7,")


@given(st.binary(max_size=300))
def test_no_bytes_upset_the_station(data: bytes) -> None:
    assert talk(data + b"\n%R1Q,0,9:\r\n")[-1] == "%R1P,0,9:0"
