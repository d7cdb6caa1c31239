"""The strict wrapper against a far end that answers wrongly on purpose (virtual loop, real pymodbus)."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkLost, OutcomeUnknown, PortMissing
from drivers.modbus_client import ModbusUnit
from sim.virtual_time import run_virtual

Script = Callable[[int, bytes], list[tuple[float, bytes]]]
"""(transaction, unit + pdu) -> frames with the delay after which each leaves."""


class FarEnd(asyncio.Protocol):
    """Answers each request frame as the script says."""

    def __init__(self, script: Script) -> None:
        self.script = script
        self.requests: list[bytes] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.requests.append(data)
        loop = asyncio.get_running_loop()
        for delay_s, frame in self.script(int.from_bytes(data[:2], "big"), data[6:]):
            loop.call_later(delay_s, self.transport.write, frame)  # type: ignore[attr-defined]


def frame(transaction: int, pdu: bytes, unit: int = 5, protocol: int = 0) -> bytes:
    return struct.pack(">HHHB", transaction, protocol, len(pdu) + 1, unit) + pdu


def good(transaction: int, _request: bytes) -> list[tuple[float, bytes]]:
    return [(0.0, frame(transaction, bytes.fromhex("03 04 1234 abcd")))]


def ask(script: Script, request: Callable[[ModbusUnit], Coroutine[Any, Any, Any]]) -> tuple[Any, FarEnd, ModbusUnit]:
    """Run one request of unit 5 with a time-out of 50 ms."""

    async def main() -> tuple[Any, FarEnd, ModbusUnit]:
        loop = asyncio.get_running_loop()
        far = FarEnd(script)
        await loop.create_server(lambda: far, "plc", 502)
        unit = ModbusUnit("positioner A", "plc", 502, 5, 0.05)
        await unit.connect()
        try:
            return await request(unit), far, unit
        finally:
            unit.close()

    return run_virtual(main)


def read2(unit: ModbusUnit) -> Coroutine[Any, Any, bytes]:
    return unit.read(0x100, 2)


def test_requests_leave_as_the_specification_has_them() -> None:
    data, far, _ = ask(good, read2)
    assert data == bytes.fromhex("1234 abcd")
    assert far.requests == [bytes.fromhex("0001 0000 0006 05 03 0100 0002")]

    def echo(transaction: int, request: bytes) -> list[tuple[float, bytes]]:
        return [(0.0, frame(transaction, request[1:6]))]

    _, far, _ = ask(echo, lambda u: u.write(0x40, bytes.fromhex("00c8 01f4 0004")))
    assert far.requests == [bytes.fromhex("0001 0000 000d 05 10 0040 0003 06 00c8 01f4 0004")]

    def both(transaction: int, request: bytes) -> list[tuple[float, bytes]]:
        return [(0.0, frame(transaction, bytes.fromhex("17 02 0007")))]

    data, far, _ = ask(both, lambda u: u.exchange(0x0F, b"\x00\x09", 0x100, 1))
    assert data == b"\x00\x07"
    assert far.requests == [bytes.fromhex("0001 0000 000d 05 17 0100 0001 000f 0001 02 0009")]


@pytest.mark.parametrize(
    ("pdu", "says"),
    [
        ("03 02 1234", "2 bytes of data instead of 4"),
        ("03 06 1234 5678 9abc", "6 bytes of data instead of 4"),
        ("03 06 1234 5678", "4 bytes of data instead of 4"),
        ("10 0100 0002", "function 16 answered for function 3"),
        ("17 04 1234 abcd", "function 23 answered for function 3"),
        ("90 02", "function 144 answered for function 3"),
        ("03", "0 bytes"),
    ],
)
def test_a_reply_of_the_wrong_shape_is_refused_at_once(pdu: str, says: str) -> None:
    async def request(unit: ModbusUnit) -> float:
        before = asyncio.get_running_loop().time()
        with pytest.raises(BadReply) as caught:
            await unit.read(0x100, 2)
        assert caught.value.value is not None
        assert "positioner A" in str(caught.value)
        if len(pdu) > 2:
            assert says in str(caught.value)
        return asyncio.get_running_loop().time() - before

    if pdu == "03":
        with pytest.raises(DeviceSilent):
            ask(lambda t, r: [], read2)
        return
    took_s, _, _ = ask(lambda t, r: [(0.0, frame(t, bytes.fromhex(pdu)))], request)
    assert took_s < 0.002


def test_another_unit_is_refused() -> None:
    with pytest.raises(BadReply, match="unit 6 answered for unit 5"):
        ask(lambda t, r: [(0.0, frame(t, bytes.fromhex("03 04 1234 abcd"), unit=6))], read2)


def test_noise_that_is_no_modbus_frame_is_refused() -> None:
    with pytest.raises(BadReply, match="no Modbus TCP frame"):
        ask(lambda t, r: [(0.0, b"HTTP/1.1 400 Bad Request\r\n")], read2)


@pytest.mark.parametrize("transaction", [0, 77])
def test_a_stale_answer_is_never_taken_for_this_one(transaction: int) -> None:
    stale = frame(transaction, bytes.fromhex("03 04 dead dead"))
    with pytest.raises(DeviceSilent):
        ask(lambda t, r: [(0.0, stale)], read2)
    data, _, unit = ask(lambda t, r: [(0.0, stale + good(t, r)[0][1])], read2)
    assert data == bytes.fromhex("1234 abcd")
    assert unit.stale_replies == 1


def test_a_late_answer_is_not_taken_for_the_next_request() -> None:
    def slow_first(transaction: int, request: bytes) -> list[tuple[float, bytes]]:
        value = bytes((3, 4, 0, transaction, 0, transaction))
        return [(0.07 if transaction == 1 else 0.03, frame(transaction, value))]

    async def request(unit: ModbusUnit) -> bytes:
        with pytest.raises(DeviceSilent):
            await unit.read(0x100, 2)
        return await unit.read(0x100, 2)

    data, far, unit = ask(slow_first, request)
    assert data == bytes((0, 2, 0, 2))
    assert unit.stale_replies == 1
    assert len(far.requests) == 2, "nothing is sent twice"


def test_a_reply_cut_at_every_byte_is_understood() -> None:
    whole = len(good(1, b"")[0][1])
    for cut in range(1, whole):

        def sliced(t: int, r: bytes, cut: int = cut) -> list[tuple[float, bytes]]:
            data = good(t, r)[0][1]
            return [(0.0, data[:cut]), (0.01, data[cut:])]

        assert ask(sliced, read2)[0] == bytes.fromhex("1234 abcd")


def test_device_exceptions_come_in_words() -> None:
    with pytest.raises(DeviceRefused, match="code 2: illegal register address") as caught:
        ask(lambda t, r: [(0.0, frame(t, b"\x83\x02"))], read2)
    assert caught.value.value == 2
    with pytest.raises(DeviceRefused, match="device busy"):
        ask(lambda t, r: [(0.0, frame(t, b"\x90\x06"))], lambda u: u.write(0, b"\0\1"))


def test_silence_takes_exactly_the_deadline_and_nothing_is_repeated() -> None:
    async def request(unit: ModbusUnit) -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        t0 = loop.time()
        with pytest.raises(DeviceSilent) as silent:
            await unit.read(0x100, 2)
        assert silent.value.limit == 0.05
        t1 = loop.time()
        with pytest.raises(OutcomeUnknown):
            await unit.write(0, b"\0\1")
        t2 = loop.time()
        with pytest.raises(OutcomeUnknown):
            await unit.exchange(0, b"\0\1", 0x100, 2)
        for _ in range(10):
            with pytest.raises(DeviceSilent):
                await unit.read(0x100, 2)
        assert unit.connected, "pymodbus does not hang up by itself"
        return t1 - t0, t2 - t1

    took_s, far, _ = ask(lambda t, r: [], request)
    assert took_s == pytest.approx((0.05, 0.05), abs=1e-9)
    assert len(far.requests) == 13


def test_a_write_echo_of_another_span_is_refused() -> None:
    with pytest.raises(BadReply, match="another span"):
        ask(lambda t, r: [(0.0, frame(t, bytes.fromhex("10 0041 0001")))], lambda u: u.write(0x40, b"\0\1"))


def test_a_lost_connection_ends_the_request_at_once() -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        far = FarEnd(lambda t, r: [])
        await loop.create_server(lambda: far, "plc", 502)
        unit = ModbusUnit("positioner A", "plc", 502, 5, 0.05)
        await unit.connect()
        t0 = loop.time()
        loop.call_later(0.01, far.transport.close)  # type: ignore[attr-defined]
        with pytest.raises(LinkLost):
            await unit.read(0x100, 2)
        took_s = loop.time() - t0
        with pytest.raises(LinkLost, match="not connected"):
            await unit.read(0x100, 2)
        return took_s

    assert run_virtual(main) < 0.012


def test_nobody_listens() -> None:
    async def main() -> None:
        await ModbusUnit("positioner A", "plc", 502, 5, 0.05).connect()

    with pytest.raises(PortMissing, match="plc:502"):
        run_virtual(main)


@pytest.mark.parametrize("count", [0, 126])
def test_a_span_that_no_request_carries_is_a_mistake_of_the_caller(count: int) -> None:
    with pytest.raises(ValueError, match="outside"):
        ask(good, lambda u: u.read(0, count))
