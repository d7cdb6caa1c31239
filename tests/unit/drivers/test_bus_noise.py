"""Whatever comes over a bus: no driver of CANopen or Modbus fails but by name, and none takes it for true."""

from __future__ import annotations

import asyncio
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.errors import LinkError
from docking.ports import CanFrame
from drivers.canopen.look import BusLook
from drivers.modbus_client import ModbusUnit
from drivers.modbus_requests import RegisterUnit
from drivers.modbus_rtu import RtuLine, crc16
from sim.plc.modbus_rtu import ModbusRtuLine
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.support.can_bench import Bench, can_cell

CHANNELS = (0x000, 0x080, 0x180, 0x200, 0x280, 0x580, 0x600, 0x700)
WORDS = bytes((0x12, 0x34, 0xAB, 0xCD))


def babble(rng: random.Random) -> list[CanFrame]:
    """Frames of any length, most of them under identifiers that somebody listens to."""
    return [
        (rng.choice((rng.randrange(0x800), rng.choice(CHANNELS) + rng.randrange(14))), rng.randbytes(rng.randrange(9)))
        for _ in range(rng.randrange(1, 14))
    ]


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full)])
def test_frames_of_any_kind_reach_controller_and_look_and_nothing_is_raised(seed: int) -> None:
    rng = random.Random(seed)

    async def main() -> None:
        bench = Bench(can_cell("lab-can"))
        await bench.ready()
        look = BusLook(bench.cell, bench.bus.end())
        for _ in range(3000):
            batch = babble(rng)
            bench.master._on_frames(batch)
            bench.master.latest()
            look._arrived(batch)
        look._arrived([(0x080, b"")] * 2)
        assert look.controlled
        assert len(await look.axes()) == 12
        bench.drives.close()

    run_virtual(main)


async def read(unit: RegisterUnit) -> LinkError | None:
    """Read two registers: the right ones, or the error by which that failed."""
    try:
        data = await unit.read(0x100, 2)
    except LinkError as error:
        return error
    assert data == WORDS
    return None


class Registers:
    """Two registers from 100h; everything else is refused by silence."""

    def read(self, address: int, count: int) -> bytes:
        return WORDS[: 2 * count]

    def write(self, address: int, data: bytes) -> None:
        """Nothing is written here."""


LIKE_AN_ANSWER = st.binary(min_size=6, max_size=6).map(lambda rest: b"\x01\x03\x04" + rest)
NOISE = st.lists(
    st.tuples(st.floats(0.0, 0.02), st.binary(min_size=1, max_size=40) | LIKE_AN_ANSWER), min_size=1, max_size=4
)
"""(after how long, bytes)."""


@settings(max_examples=60, deadline=None)
@given(NOISE)
def test_noise_on_a_serial_line_costs_an_answer_and_never_makes_one(noise: list[tuple[float, bytes]]) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = VirtualSerial(loop, 19200, "line")
        far = ModbusRtuLine({1: Registers()}, wire.far, 19200, loop)
        unit = RtuLine(wire.near, "line", 19200, 0.05).unit("drive 1", 1)
        await unit.connect()
        await asyncio.sleep(0.3)
        for after_s, data in noise:
            if crc16(data[:-2]) != int.from_bytes(data[-2:], "little"):
                loop.call_later(after_s, wire.far.write, data)
        await read(unit)
        await asyncio.sleep(0.3)
        assert await unit.read(0x100, 2) == WORDS, "behind the noise all is as before"
        unit.close()
        far.close()

    run_virtual(main)


class Babbler(asyncio.Protocol):
    """Answers a read with noise before and behind the right frame."""

    def __init__(self, before: bytes, behind: bytes, size: int) -> None:
        self._before, self._behind, self._size = before, behind, size

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        good = data[:2] + struct.pack(">HHBBB", 0, 7, 5, 3, 4) + WORDS
        said = self._before + good + self._behind
        for at in range(0, len(said), self._size):
            self._transport.write(said[at : at + self._size])  # type: ignore[attr-defined]


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=30), st.binary(max_size=30), st.integers(1, 40))
def test_noise_on_a_connection_is_refused_by_name(before: bytes, behind: bytes, size: int) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        far = Babbler(before, behind, size)
        await loop.create_server(lambda: far, "plc", 502)
        unit = ModbusUnit("positioner A", "plc", 502, 5, 0.05)
        await unit.connect()
        error = await read(unit)
        assert error is None or (before and error.where == "positioner A"), error
        unit.close()

    run_virtual(main)
