"""tshark reads the bytes of our simulated wires: every frame decoded, nothing malformed, and it names what we meant."""

from __future__ import annotations

import asyncio
import shutil
import struct
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from drivers.modbus_positioners import ModbusPositioners
from sim.plc.group import PlcGroup
from sim.plc.modbus_tcp import ModbusTcpConnection
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell, exchange
from tests.support.modbus_cell import PORT, StiffPlant, cell, plan

CAN_LINK, RAW_IP = 227, 101
CLIENT, SERVER = bytes((10, 0, 0, 1)), bytes((10, 0, 0, 2))
Packet = tuple[float, bytes]
TcpPiece = tuple[float, int, bool, bytes]
"""(time s, number of the connection, towards the server, bytes)."""

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark (Debian package) is not installed"),
]


def write_pcap(path: Path, link: int, packets: list[Packet]) -> None:
    """A capture file with microseconds."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link))
        for t_s, data in packets:
            seconds, micros = divmod(round(t_s * 1e6), 1_000_000)
            file.write(struct.pack("<4I", seconds, micros, len(data), len(data)) + data)


def tshark(path: Path, *arguments: str) -> list[str]:
    """The lines that tshark prints of a capture."""
    done = subprocess.run(
        ["tshark", "-n", "-r", str(path), *arguments], capture_output=True, text=True, check=False, timeout=60.0
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


# CAN -----------------------------------------------------------------------------------------------------------------
def can_traffic() -> list[Packet]:
    """Bring-up, enabling, motion, a stuck axis with its EMCY, and the end: every frame on the bus with its time."""

    async def main() -> list[Packet]:
        bench, packets = Bench(can_cell("lab-can")), []
        loop = asyncio.get_running_loop()

        def keep(cob: int, data: bytes) -> bool:
            packets.append((loop.time(), struct.pack(">IB3x", cob, len(data)) + data))
            return True

        bench.bus.keep = keep
        at_mm = await bench.ready()
        for step in range(40):
            exchange(bench.master, at_mm + 0.01 * step)
            await asyncio.sleep(0.01)
        bench.plant.jammed[1] = True
        for step in range(40, 100):
            exchange(bench.master, at_mm + 0.05 * step)
            await asyncio.sleep(0.01)
        bench.master.quick_stop()
        await asyncio.sleep(0.5)
        await bench.master.close()
        return packets

    return run_virtual(main)


def test_every_can_frame_is_canopen_to_tshark(tmp_path: Path) -> None:
    packets = can_traffic()
    capture = tmp_path / "can.pcap"
    write_pcap(capture, CAN_LINK, packets)
    as_canopen = ("-d", "can.subdissector,canopen")
    rows = tshark(capture, *as_canopen, "-Y", "canopen", "-T", "fields", "-e", "can.id", "-e", "_ws.col.Info")
    assert len(rows) == len(packets) > 1000
    assert tshark(capture, *as_canopen, "-Y", "_ws.malformed || _ws.expert") == []
    kinds = Counter(_kind(int(row.split("\t")[0])) for row in rows)
    words = {kind: "\n".join(row for row in rows if _kind(int(row.split("\t")[0])) == kind) for kind in kinds}
    for kind, word in (("NMT", "NMT"), ("SYNC", "SYNC"), ("EMCY", "EMCY"), ("SDO", "SDO"), ("PDO", "PDO")):
        assert kinds[kind] > 0, f"the traffic holds no {kind}"
        assert word in words[kind]
    assert "Heartbeat" in words["heartbeat"] or "Boot" in words["heartbeat"]


def _kind(cob: int) -> str:
    """What an identifier is for in the default connection set; tshark is asked whether it agrees."""
    if cob in (0x000, 0x080):
        return "NMT" if cob == 0 else "SYNC"
    groups = {0x080: "EMCY", 0x580: "SDO", 0x600: "SDO", 0x700: "heartbeat"}
    return groups.get(cob & 0x780, "PDO" if 0x180 <= cob < 0x580 else "other")


# Modbus --------------------------------------------------------------------------------------------------------------
def modbus_traffic(monkeypatch: pytest.MonkeyPatch) -> list[TcpPiece]:
    """Four PLCs brought up, enabled, loaded and run: what passes over their TCP connections."""
    pieces: list[TcpPiece] = []
    numbers: dict[ModbusTcpConnection, int] = {}
    hear = ModbusTcpConnection.data_received

    def data_received(self: ModbusTcpConnection, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        number = numbers.setdefault(self, len(numbers))
        pieces.append((loop.time(), number, True, data))
        transport = self._transport
        write = transport.write

        def keep(reply: bytes) -> None:
            pieces.append((loop.time(), number, False, reply))
            write(reply)

        transport.write = keep  # type: ignore[method-assign,assignment]
        try:
            hear(self, data)
        finally:
            del transport.write

    monkeypatch.setattr(ModbusTcpConnection, "data_received", data_received)

    async def main() -> list[TcpPiece]:
        config = cell()
        group = PlcGroup(StiffPlant(), config, (0.0,) * 4, asyncio.get_running_loop())
        await group.serve()
        driver = ModbusPositioners(config)
        await driver.bring_up()
        await driver.enable()
        await driver.load(plan(config, 1.5))
        await driver.command("run")
        for _ in range(40):
            await driver.poll()
            await asyncio.sleep(0.05)
        await driver.close()
        await group.close()
        return pieces

    return run_virtual(main)


def _sum16(data: bytes) -> int:
    """The Internet checksum."""
    total = sum(struct.unpack(f">{len(data) // 2}H", data)) if len(data) % 2 == 0 else _sum16(data + b"\0") ^ 0xFFFF
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF


def _segment(number: int, to_server: bool, seq: int, ack: int, flags: int, data: bytes) -> bytes:
    """One IPv4 packet with its TCP segment and both checksums; each connection has a server port of its own."""
    source, target = (CLIENT, SERVER) if to_server else (SERVER, CLIENT)
    ports = (40000 + number, PORT + number) if to_server else (PORT + number, 40000 + number)
    tcp = struct.pack(">HHIIBBHHH", *ports, seq, ack, 5 << 4, flags, 65535, 0, 0) + data
    pseudo = source + target + struct.pack(">BBH", 0, 6, len(tcp))
    tcp = tcp[:16] + struct.pack(">H", _sum16(pseudo + tcp)) + tcp[18:]
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0x4000, 64, 6, 0, source, target)
    return ip[:10] + struct.pack(">H", _sum16(ip)) + ip[12:] + tcp


def as_packets(pieces: list[TcpPiece]) -> list[Packet]:
    """The pieces with a handshake before the first one of each connection."""
    packets: list[Packet] = []
    sent: dict[int, list[int]] = {}
    for t_s, number, to_server, data in pieces:
        if number not in sent:
            sent[number] = [1001, 5001]
            for up, seq, ack, flags in ((True, 1000, 0, 0x02), (False, 5000, 1001, 0x12), (True, 1001, 5001, 0x10)):
                packets.append((t_s, _segment(number, up, seq, ack, flags, b"")))
        at = sent[number]
        mine, other = (0, 1) if to_server else (1, 0)
        packets.append((t_s, _segment(number, to_server, at[mine], at[other], 0x18, data)))
        at[mine] += len(data)
    return packets


def test_every_modbus_frame_is_modbus_to_tshark(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pieces = modbus_traffic(monkeypatch)
    capture = tmp_path / "modbus.pcap"
    write_pcap(capture, RAW_IP, as_packets(pieces))
    ports = ",".join(str(PORT + i) for i in range(4))
    as_modbus = ("-o", f"mbtcp.tcp.port:{ports}", "-o", "tcp.check_checksum:TRUE", "-o", "ip.check_checksum:TRUE")
    for i in range(4):
        as_modbus += ("-d", f"tcp.port=={PORT + i},mbtcp")
    fields = ("mbtcp.trans_id", "mbtcp.unit_id", "modbus.func_code", "modbus.exception_code", "tcp.len")
    rows = tshark(
        capture, *as_modbus, "-Y", "modbus", "-T", "fields", *(word for field in fields for word in ("-e", field))
    )
    assert len(rows) == len(pieces) > 300, "each piece is one whole frame"
    assert tshark(capture, *as_modbus, "-Y", "_ws.malformed || _ws.expert.severity >= warning") == []
    seen = [row.split("\t") for row in rows]
    assert [int(row[4]) for row in seen] == [len(data) for *_, data in pieces]
    assert {int(row[1]) for row in seen} == {1, 2, 3, 4}
    assert {int(row[2]) for row in seen} == {3, 16, 23}
    assert {row[3] for row in seen} == {""}, "no refusal in an ordinary move"
    answered = tshark(capture, *as_modbus, "-Y", "modbus.response_time", "-T", "fields", "-e", "modbus.response_time")
    assert len(answered) == len(pieces) // 2, "tshark finds the request of every answer"
    assert _identity(capture, as_modbus)[:5] == [0x1234, 0x5678, 2, 3, 10]


def _identity(capture: Path, as_modbus: tuple[str, ...]) -> list[int]:
    """The first registers that PLC A answered with, as tshark shows them."""
    query = f"modbus.func_code == 3 && tcp.srcport == {PORT}"
    shown = tshark(capture, *as_modbus, "-Y", query, "-T", "fields", "-e", "modbus.regval_uint16", "-c", "60")
    return [int(word) for word in shown[0].split(",")]
