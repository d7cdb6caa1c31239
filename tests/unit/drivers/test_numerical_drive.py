"""A drive family without PLC by its map: bytes as its manual has them, moves on a serial line, what it refuses."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from docking.errors import BadArgument, EnableFailed, ReadBackMismatch
from drivers.modbus_rtu import RtuLine
from drivers.numerical_drive import NumericalDrive, load_numerical_map
from sim.plc.modbus_rtu import ModbusRtuLine
from sim.plc.numerical_drive import NumericalAxis
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial

BAUD = 38400


class Bench:
    """Drives 1 and 2 on one virtual line."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, BAUD, "line")
        self.axes = {number: NumericalAxis(self.loop.time) for number in (1, 2)}
        self.far = ModbusRtuLine(self.axes, self.wire.far, BAUD, self.loop)
        line = RtuLine(self.wire.near, "line", BAUD, 0.05)
        layout = load_numerical_map("iai_numerical")
        self.drives = [NumericalDrive(line.unit(f"platform {n}", n), layout) for n in (1, 2)]
        self.sent: list[bytes] = []
        send = self.wire.near.write

        def write(data: bytes) -> None:
            self.sent.append(data)
            send(data)

        self.wire.near.write = write  # type: ignore[method-assign]


def on_line(scenario: Callable[[Bench], Awaitable[None]]) -> None:
    async def main() -> None:
        bench = Bench()
        for drive in bench.drives:
            await drive.unit.connect()
        await scenario(bench)

    run_virtual(main)


def test_a_move_is_one_write_and_ends_at_the_target() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.drives[0].read()
        began_s = bench.loop.time()
        state = await bench.drives[0].move(-12.34, 50.0, 2.94, 2.0)
        assert state.position_mm == -12.34
        assert bench.axes[1].position_mm == -12.34
        assert bench.loop.time() - began_s == pytest.approx(12.34 / 50.0, abs=0.06)
        writes = [frame for frame in bench.sent if frame[1] == 16]
        # Target -1234, band 5, speed 5000, acceleration 30 (0.30 G), no push, absolute.
        assert [frame[:-2] for frame in writes] == [
            bytes.fromhex("01 10 9900 0009 12 FFFFFB2E 00000005 00001388 001E 0000 0000")
        ]
        assert bench.axes[2].moves == 0

    on_line(scenario)


def test_a_lost_reply_starts_nothing_twice() -> None:
    async def scenario(bench: Bench) -> None:
        bench.far.mangle = lambda frame: b"" if frame[1] == 16 else frame
        state = await bench.drives[1].move(5.0, 50.0, 2.0, 2.0)
        assert state.in_position
        assert bench.axes[2].moves == 1

    on_line(scenario)


def test_axes_have_no_common_start() -> None:
    """What the limits of this map are about: the second axis starts a whole exchange later."""

    async def scenario(bench: Bench) -> None:
        both = asyncio.gather(*(drive.move(100.0, 100.0, 2.0, 3.0) for drive in bench.drives))
        await asyncio.sleep(0.5)
        apart_mm = bench.axes[1].position_mm - bench.axes[2].position_mm
        assert 0.5 < abs(apart_mm) < 3.0, "at 100 mm/s: 5 to 30 ms"
        await both

    on_line(scenario)


def test_what_is_refused() -> None:
    async def scenario(bench: Bench) -> None:
        drive, axis = bench.drives[0], bench.axes[1]
        for target_mm, speed in ((10000.0, 5.0), (float("nan"), 5.0), (1.0, 0.0)):
            with pytest.raises(BadArgument):
                await drive.move(target_mm, speed, 2.0, 1.0)
        assert axis.moves == 0
        with pytest.raises(EnableFailed, match="alarm"):
            await drive.move(1.0, 5000.0, 2.0, 1.0)
        axis.alarm = 0
        with pytest.raises(ReadBackMismatch):
            await drive.move(50.0, 1.0, 2.0, 0.2)
        axis.servo = False
        with pytest.raises(EnableFailed, match="servo"):
            await drive.move(1.0, 5.0, 2.0, 1.0)

    on_line(scenario)
