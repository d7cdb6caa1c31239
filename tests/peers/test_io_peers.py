"""Programs written by others read the simulated I/O modules: mbpoll (libmodbus) and pymodbus over TCP, python-canopen
as master of the CiA 401 module; contacts, temperatures and the currents of a load cell."""

from __future__ import annotations

import asyncio
import re
import shutil
import struct
import time
from pathlib import Path
from typing import Any

import pytest

from drivers.links.unix_bus import UnixBus
from sim.wires.unix_can import UnixCanServer
from tests.peers.test_plc_clients import output_of
from tests.support.force_bench import NODE, ForceBench
from tests.support.input_bench import InputBench

pytestmark = [pytest.mark.peer, pytest.mark.wires]

LOADS_N = (0.0, 200.0, -500.0)
"""Nothing, the whole range of X and Y, and the whole range of Z downwards: 12, 20 and 4 mA."""
COUNTS = (16589, -32768, 27648, 5530)
"""Of the four inputs; X, Y and Z are on 0, 2 and 3, nothing on 1."""
WARM_C, WARM_COUNTS = 23.4, 234
CRANE_FREE = 9


async def module_at(bench: InputBench | ForceBench) -> tuple[str, int]:
    """The address of a module that listens."""
    await bench.on_tcp(0)
    server = bench.closing[-1].__self__  # type: ignore[attr-defined]
    host, port = server._server.sockets[0].getsockname()[:2]
    return str(host), int(port)


async def mbpoll(port: int, kind: str, first: int, count: int) -> list[int]:
    """What mbpoll reads: `kind` 1 discrete inputs, 3 input registers."""
    if shutil.which("mbpoll") is None:
        pytest.skip("mbpoll (Debian package) is not installed")
    text = await output_of(
        "mbpoll", "-m", "tcp", "-p", str(port), "-1", "-0", "-a", "1", "-r", str(first), "-c", str(count), "-t", kind,
        "127.0.0.1",
    )  # fmt: skip
    return [int(word) for word in re.findall(r"^\[\d+\]:\s+(\d+)", text, re.MULTILINE)]


async def test_mbpoll_reads_contacts_temperatures_and_currents() -> None:
    inputs, forces = InputBench("modbus-io"), ForceBench("modbus-io")
    forces.pull(*LOADS_N)
    try:
        _, port = await module_at(inputs)
        levels = await mbpoll(port, "1", 0, 16)
        assert levels == [int(channel == CRANE_FREE) for channel in range(16)]
        inputs.hold(False)
        assert await mbpoll(port, "1", 0, 16) == [0] * 16
        warm = await mbpoll(port, "3", 2, 1)
        assert warm == [WARM_COUNTS]
        _, port = await module_at(forces)
        words = await mbpoll(port, "3", 1, 4)
        assert struct.unpack(">4h", struct.pack(">4H", *words)) == COUNTS
    finally:
        await inputs.close()
        await forces.close()


async def test_pymodbus_reads_the_module_and_is_refused_beyond_it() -> None:
    client = pytest.importorskip("pymodbus.client")
    bench = ForceBench("modbus-io")
    bench.pull(*LOADS_N)
    host, port = await module_at(bench)
    master = client.AsyncModbusTcpClient(host, port=port, timeout=1.0, retries=0)
    try:
        assert await master.connect()
        identity = await master.read_input_registers(0x100, count=31, device_id=1)
        assert identity.registers[:3] == [0x494F, 0x3031, 1]
        text = struct.pack(">28H", *identity.registers[3:])
        assert [part.rstrip(b"\0") for part in (text[:16], text[16:32])] == [b"SimPositioner", b"IO-16-4"]
        analogue = await master.read_input_registers(1, count=4, device_id=1)
        assert struct.unpack(">4h", struct.pack(">4H", *analogue.registers)) == COUNTS
        beyond = await master.read_input_registers(4, count=2, device_id=1)
        assert (beyond.isError(), beyond.exception_code) == (True, 2)
        written = await master.write_register(1, 0, device_id=1)
        assert written.isError()
        alive = [(await master.read_input_registers(0, count=1, device_id=1)).registers[0]]
        await asyncio.sleep(0.05)
        alive.append((await master.read_input_registers(0, count=1, device_id=1)).registers[0])
        assert 3 <= alive[1] - alive[0] <= 60
    finally:
        master.close()
        await bench.close()


def dictionary(canopen: Any) -> Any:
    """The objects of a CiA 401 module that a master uses."""
    from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes

    od = ObjectDictionary()

    def record(name: str, index: int, kinds: tuple[int, ...]) -> None:
        entry = ODRecord(name, index)
        for sub, kind in enumerate(kinds):
            variable = ODVariable(f"{name} {sub}", index, sub)
            variable.data_type = kind
            entry.add_member(variable)
        od.add_object(entry)

    for name, index, kind in (
        ("Device type", 0x1000, datatypes.UNSIGNED32),
        ("Interrupts", 0x6005, datatypes.UNSIGNED8),
        ("Analogue interrupts", 0x6423, datatypes.UNSIGNED8),
    ):
        variable = ODVariable(name, index, 0)
        variable.data_type = kind
        od.add_object(variable)
    u8, u16, u32, i16 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32, datatypes.INTEGER16
    record("Identity", 0x1018, (u8, u32, u32, u32, u32))
    record("Contacts", 0x6000, (u8, u8, u8))
    record("Analogue", 0x6401, (u8, i16, i16, i16, i16))
    for number in range(2):
        record(f"TPDO {number + 1}", 0x1800 + number, (u8, u32, u8, u16, u8, u16))
        record(f"Mapping {number + 1}", 0x1A00 + number, (u8, *(u32,) * 8))
    return od


def read_module(path: Path) -> dict[str, Any]:
    """What a user of python-canopen does, in a thread of its own."""
    canopen = pytest.importorskip("canopen")
    seen: dict[str, Any] = {}
    network = canopen.Network(bus=UnixBus(str(path)))
    network.connect()
    try:
        node = network.add_node(canopen.RemoteNode(NODE, dictionary(canopen)))
        seen["profile"] = node.sdo[0x1000].raw & 0xFFFF
        seen["serial"] = node.sdo[0x1018][4].raw
        seen["analogue"] = tuple(node.sdo[0x6401][sub].raw for sub in (1, 2, 3, 4))
        try:
            node.sdo[0x6401][1].raw = 5
        except canopen.SdoAbortedError as abort:
            seen["abort"] = abort.code
        node.sdo[0x6423].raw = 1
        tpdo = node.tpdo[2]
        tpdo.read()
        tpdo.clear()
        for sub in (1, 2, 3, 4):
            tpdo.add_variable(0x6401, sub)
        tpdo.cob_id, tpdo.trans_type, tpdo.event_timer, tpdo.enabled = 0x280 + NODE, 255, 50, True
        tpdo.save()
        arrived: list[tuple[float, tuple[int, ...]]] = []
        tpdo.add_callback(lambda pdo: arrived.append((time.monotonic(), tuple(entry.raw for entry in pdo))))
        node.nmt.state = "OPERATIONAL"
        time.sleep(0.4)
        seen["arrived"] = arrived
    finally:
        network.disconnect()
    return seen


async def test_python_canopen_is_master_of_the_module(tmp_path: Path) -> None:
    bench = ForceBench("cia401")
    bench.pull(*LOADS_N)
    server = UnixCanServer(tmp_path / "can0")
    bench.closing.append(server.close)
    unused = UnixCanServer(tmp_path / "unused")
    await bench.on_can(server, unused)
    try:
        seen = await asyncio.to_thread(read_module, tmp_path / "can0")
    finally:
        await bench.close()
    assert seen["profile"] == 401
    assert seen["serial"] == 401_000 + NODE
    assert seen["analogue"] == COUNTS
    assert seen["abort"] == 0x0601_0002
    assert {counts for _, counts in seen["arrived"]} == {COUNTS}
    assert 5 <= len(seen["arrived"]) <= 12, "every 50 ms"
