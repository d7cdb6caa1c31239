"""Modbus RTU: bytes of the specification, the silences of a line, and four PLCs that play a plan over one line."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from docking.errors import BadArgument, BadReply, DeviceRefused, DeviceSilent, LinkLost, OutcomeUnknown
from drivers.modbus_positioners import ModbusPositioners
from drivers.modbus_rtu import RtuLine, crc16, exchange_s, gap_s
from sim.plc.group import PlcGroup
from sim.plc.modbus_rtu import ModbusRtuLine
from sim.virtual_time import run_virtual
from sim.wires.virtual_serial import VirtualSerial
from tests.support.modbus_cell import StiffPlant, cell, plan

BAUD = 19200
TIMEOUT_S = 0.05


def test_check_sums_of_published_frames() -> None:
    assert crc16(bytes.fromhex("01 04 02 FF FF")).to_bytes(2, "little") == bytes.fromhex("B8 80")
    assert crc16(bytes.fromhex("01 03 00 00 00 01")).to_bytes(2, "little") == bytes.fromhex("84 0A")


def test_gaps_and_wire_times() -> None:
    assert gap_s(9600) == pytest.approx(3.5 * 11 / 9600)
    assert gap_s(115200) == 0.00175
    assert exchange_s(115200, 8, 125, 0.0) == pytest.approx(0.0162, abs=1e-3), "60 registers: about 16 ms"


class Registers:
    """Ten registers; writes are counted."""

    def __init__(self, first: int) -> None:
        self.words = [first + i for i in range(10)]
        self.writes: list[tuple[int, bytes]] = []

    def read(self, address: int, count: int) -> bytes:
        return b"".join(word.to_bytes(2, "big") for word in self.words[address : address + count])

    def write(self, address: int, data: bytes) -> None:
        self.writes.append((address, data))


class Bench:
    """Units 1 and 2 on a virtual line, and the times at which frames begin on it."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.wire = VirtualSerial(self.loop, BAUD, "line")
        self.devices = {1: Registers(100), 2: Registers(200)}
        self.far = ModbusRtuLine(self.devices, self.wire.far, BAUD, self.loop)
        self.line = RtuLine(self.wire.near, "line", BAUD, TIMEOUT_S)
        self.one, self.two = self.line.unit("drive 1", 1), self.line.unit("drive 2", 2)
        self.sent: list[tuple[float, bytes]] = []
        send = self.wire.near.write

        def write(data: bytes) -> None:
            self.sent.append((self.loop.time(), data))
            send(data)

        self.wire.near.write = write  # type: ignore[method-assign]

    def answer(self, change: Callable[[bytes], bytes]) -> None:
        """Change answers from now on."""
        self.far.mangle = change


def on_line(scenario: Callable[[Bench], Awaitable[None]]) -> None:
    async def main() -> None:
        bench = Bench()
        await bench.one.connect()
        await bench.two.connect()
        await scenario(bench)
        bench.one.close()
        bench.two.close()

    run_virtual(main)


def sealed(body: str) -> bytes:
    data = bytes.fromhex(body)
    return data + crc16(data).to_bytes(2, "little")


def test_each_unit_answers_for_itself_and_frames_keep_their_distance() -> None:
    async def scenario(bench: Bench) -> None:
        got = await asyncio.gather(bench.one.read(0, 2), bench.two.read(0, 2), bench.two.write(4, b"\x12\x34"))
        assert got[:2] == [bytes((0, 100, 0, 101)), bytes((0, 200, 0, 201))]
        assert bench.devices[2].writes == [(4, b"\x12\x34")]
        assert bench.devices[1].writes == []
        assert [data for _, data in bench.sent] == [
            sealed("01 03 0000 0002"), sealed("02 03 0000 0002"), sealed("02 10 0004 0001 02 1234"),
        ]  # fmt: skip
        starts = [t for t, _ in bench.sent]
        # 8 bytes out, 3.5 characters, 1 ms turnaround, 9 bytes back, and the host's own gap.
        least_s = (8 + 9) * 10 / BAUD + 3.5 * 10 / BAUD + 0.001 + gap_s(BAUD)
        assert starts[1] - starts[0] == pytest.approx(least_s, abs=2e-4)

    on_line(scenario)


@pytest.mark.parametrize(
    ("reply", "error", "words"),
    [
        (lambda frame: b"", DeviceSilent, "did not answer"),
        (lambda frame: frame[:-1], DeviceSilent, "did not answer"),
        (lambda frame: frame[:-1] + bytes((frame[-1] ^ 1,)), DeviceSilent, "damaged"),
        (lambda frame: sealed("02 03 04 0000 0000"), BadReply, "unit 2 answered for unit 1"),
        (lambda frame: sealed("01 04 04 0000 0000"), BadReply, "function 4 answered"),
        (lambda frame: sealed("01 03 02 0000 0000"), BadReply, "4 bytes of data"),
        (lambda frame: sealed("01 83 06"), DeviceRefused, "busy"),
    ],
)
def test_a_reply_that_does_not_fit_is_named(
    reply: Callable[[bytes], bytes], error: type[Exception], words: str
) -> None:
    async def scenario(bench: Bench) -> None:
        bench.answer(reply)
        with pytest.raises(error, match=words):
            await bench.one.read(0, 2)
        bench.answer(lambda frame: frame)
        assert await bench.one.read(3, 1) == bytes((0, 103))

    on_line(scenario)


def test_a_write_without_a_good_reply_has_an_unknown_outcome_and_is_not_repeated() -> None:
    async def scenario(bench: Bench) -> None:
        bench.answer(lambda frame: b"")
        with pytest.raises(OutcomeUnknown):
            await bench.one.write(0, b"\x00\x07")
        await asyncio.sleep(1.0)
        assert bench.devices[1].writes == [(0, b"\x00\x07")]
        assert len(bench.sent) == 1

    on_line(scenario)


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    """The trap of frames without numbers: the answer to "read 0" arrives when "read 5" would be asked."""

    async def scenario(bench: Bench) -> None:
        bench.far.turnaround_s = 0.09
        with pytest.raises(DeviceSilent):
            await bench.one.read(0, 1)
        failed_s = bench.loop.time()
        bench.far.turnaround_s = 0.001
        assert await bench.one.read(5, 1) == bytes((0, 105))
        assert bench.sent[1][0] - failed_s >= TIMEOUT_S, "silence for as long as a unit may still answer"
        assert bench.line.flushed_bytes == 7, "unit, function, count, two bytes of data, check sum"

    on_line(scenario)


STRAY = sealed("01 03 02 0064")
"""What unit 1 answers to "read 0"; it must not pass for the answer to "read 5"."""


def test_after_an_answer_of_another_unit_the_right_one_may_still_come() -> None:
    async def scenario(bench: Bench) -> None:
        def overtaken(frame: bytes) -> bytes:
            bench.loop.call_later(0.006, bench.wire.far.write, STRAY)
            return sealed("02 03 02 00C8")

        bench.answer(overtaken)
        with pytest.raises(BadReply, match="unit 2 answered for unit 1"):
            await bench.one.read(0, 1)
        bench.answer(lambda frame: frame)
        assert await bench.one.read(5, 1) == bytes((0, 105))
        assert bench.line.flushed_bytes == len(STRAY)

    on_line(scenario)


def test_an_answer_to_who_used_the_line_before_is_let_through_first() -> None:
    async def scenario(bench: Bench) -> None:
        bench.loop.call_later(0.003, bench.wire.far.write, STRAY)
        assert await bench.one.read(5, 1) == bytes((0, 105))
        assert bench.line.flushed_bytes == len(STRAY)

    on_line(scenario)


def test_a_pulled_cable_is_told_at_once_to_every_unit() -> None:
    async def scenario(bench: Bench) -> None:
        told: list[str] = []
        bench.one.on_lost = lambda: told.append("one")
        bench.two.on_lost = lambda: told.append("two")
        await bench.one.read(0, 1)
        begun_s = bench.loop.time()
        bench.loop.call_later(0.004, bench.wire.unplug)
        with pytest.raises(LinkLost):
            await bench.one.read(0, 1)
        assert told == ["one", "two"]
        assert bench.loop.time() - begun_s < 0.01
        with pytest.raises(LinkLost):
            await bench.two.read(0, 1)

    on_line(scenario)


@given(st.binary(min_size=7, max_size=7), st.integers(0, 55))
def test_a_flipped_bit_is_always_seen(noise: bytes, bit: int) -> None:
    good = sealed((bytes.fromhex("01 03 02") + noise[:2]).hex())
    bad = (int.from_bytes(good, "big") ^ 1 << bit).to_bytes(7, "big")
    assert crc16(bad[:-2]) != int.from_bytes(bad[-2:], "little")


# four PLCs on one line -----------------------------------------------------------------------------------------------
def rtu_cell(**bus: Any) -> Any:
    settings = {"kind": "modbus-rtu", "line": "virtual", "baud": 115200, "poll_s": 0.1, "segment_s": 0.1}
    return cell(**(settings | {"timeout_s": 0.02, "watchdog_s": 0.3} | bus))


def test_a_plan_is_played_over_one_line() -> None:
    async def main() -> None:
        config = rtu_cell()
        loop = asyncio.get_running_loop()
        plant = StiffPlant()
        group = PlcGroup(plant, config, (0.0,) * 4, loop)
        wire = VirtualSerial(loop, 115200, "line")
        far = group.serve_line(wire.far, 115200)
        driver = ModbusPositioners(config, link=wire.near)
        identities = await driver.bring_up()
        assert [identity.serial for identity in identities] == ["SP-A", "SP-B", "SP-C", "SP-D"]
        await driver.enable()
        table = plan(config, 4.0)
        await driver.load(table)
        await driver.command("run")
        polls: list[float] = []
        feedback = await driver.poll()
        while not feedback.path_time_s >= table.duration_s:
            began_s = loop.time()
            feedback = await driver.poll()
            polls.append(loop.time() - began_s)
            assert feedback.fault is None
            assert feedback.path_skew_s <= 0.001
            await asyncio.sleep(max(0.0, 0.1 - polls[-1]))
        assert plant.position_mm == pytest.approx(table.q_mm[-1], abs=0.0006)
        assert max(polls) <= config.bus.poll_s
        await driver.close()
        assert plant.braked.all()
        far.close()
        await group.close()

    run_virtual(main)


@pytest.mark.parametrize(("change", "key"), [({"baud": 9600}, "poll_s"), ({"watchdog_s": 0.15}, "watchdog_s")])
def test_a_line_too_slow_for_its_units_is_refused(change: dict[str, Any], key: str) -> None:
    with pytest.raises(BadArgument, match=rf"bus\.{key}|too short"):
        ModbusPositioners(rtu_cell(**change))


def test_a_line_belongs_to_its_kind() -> None:
    for wrong in ({"kind": "modbus-rtu"}, {"line": "/dev/ttyS0"}):
        with pytest.raises(ValueError, match="'line'"):
            cell(**wrong)
