"""The Modbus TCP server of the simulated PLC, byte by byte."""

from __future__ import annotations

import asyncio
import struct

from sim.plc.modbus_tcp import ILLEGAL_ADDRESS, ModbusRefusal, ModbusTcpConnection, answer
from sim.virtual_time import run_virtual


class Table:
    """16 registers from address 0."""

    def __init__(self) -> None:
        self.words = bytearray(32)
        self.writes: list[tuple[int, bytes]] = []

    def read(self, address: int, count: int) -> bytes:
        if address + count > 16:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return bytes(self.words[2 * address : 2 * (address + count)])

    def write(self, address: int, data: bytes) -> None:
        if 2 * address + len(data) > 32:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        self.writes.append((address, data))
        self.words[2 * address : 2 * address + len(data)] = data


class Collector(asyncio.Protocol):
    def __init__(self) -> None:
        self.data = b""
        self.closed = False

    def data_received(self, data: bytes) -> None:
        self.data += data

    def connection_lost(self, exc: Exception | None) -> None:
        self.closed = True


def talk(*pieces: bytes, table: Table | None = None) -> Collector:
    """Send the pieces to unit 7 on one connection and collect the replies."""

    async def main() -> Collector:
        loop = asyncio.get_running_loop()
        units = {7: table or Table()}
        await loop.create_server(lambda: ModbusTcpConnection(units, set()), "plc", 502)
        transport, collector = await loop.create_connection(Collector, "plc", 502)
        for piece in pieces:
            transport.write(piece)
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.01)
        return collector

    return run_virtual(main)


def frame(transaction: int, pdu: bytes, unit: int = 7, protocol: int = 0) -> bytes:
    return struct.pack(">HHHB", transaction, protocol, len(pdu) + 1, unit) + pdu


WRITE_2_AT_3 = bytes.fromhex("10 0003 0002 04 1234 abcd")


def test_write_then_read_byte_for_byte() -> None:
    reply = talk(frame(1, WRITE_2_AT_3), frame(2, bytes.fromhex("03 0003 0002")))
    assert reply.data == bytes.fromhex("0001 0000 0006 07 10 0003 0002  0002 0000 0007 07 03 04 1234 abcd")


def test_function_23_writes_before_it_reads() -> None:
    reply = talk(frame(9, bytes.fromhex("17 0004 0001 0004 0001 02 beef")))
    assert reply.data == bytes.fromhex("0009 0000 0005 07 17 02 beef")


def test_function_6_echoes() -> None:
    table = Table()
    assert talk(frame(1, bytes.fromhex("06 0002 00ff")), table=table).data[7:] == bytes.fromhex("06 0002 00ff")
    assert table.writes == [(2, b"\x00\xff")]


def test_pipelined_requests_in_one_segment_are_all_answered_in_order() -> None:
    reply = talk(b"".join(frame(n, bytes.fromhex("03 0000 0001")) for n in range(1, 6)))
    assert [reply.data[11 * i : 11 * i + 2] for i in range(5)] == [n.to_bytes(2, "big") for n in range(1, 6)]


def test_a_request_cut_at_every_byte_is_answered_once() -> None:
    whole = frame(5, WRITE_2_AT_3)
    for cut in range(1, len(whole)):
        table = Table()
        assert len(talk(whole[:cut], whole[cut:], table=table).data) == 12
        assert table.writes == [(3, b"\x12\x34\xab\xcd")]


def test_exceptions() -> None:
    units = {7: Table()}
    cases = {
        "05 0000 ff00": (1, 7),  # function that a positioner PLC does not have
        "03 0000 0000": (3, 7),  # no register
        "03 0000 007e": (3, 7),  # 126 registers
        "03 000f 0002": (2, 7),  # beyond the table
        "10 0000 0002 02 1234": (3, 7),  # byte count contradicts the count
        "10 0000 0002 04 1234": (3, 7),  # shorter than it says
        "03 0000": (3, 7),  # cut off
        "03 0000 0001": (11, 8),  # nobody has this unit
    }
    for text, (code, unit) in cases.items():
        pdu = bytes.fromhex(text)
        assert answer(units, unit, pdu[0], pdu[1:]) == bytes((pdu[0] | 0x80, code)), text


def test_a_frame_of_another_protocol_closes_the_connection() -> None:
    assert talk(frame(1, bytes.fromhex("03 0000 0001"), protocol=5)).closed
