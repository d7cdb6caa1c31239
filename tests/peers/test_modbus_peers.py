"""Modbus peers written by others: modbus-tk and mbpoll as clients of the simulated PLC, servers under our client."""

from __future__ import annotations

import asyncio
import re
import shutil
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from docking.errors import BadReply, DeviceRefused, DeviceSilent, PortMissing
from drivers.modbus_client import ModbusUnit
from drivers.modbus_positioners import ModbusPositioners
from tests.support.modbus_cell import START_MM, cell, plan
from tests.support.real_plcs import LINE_BAUD, simulated_line, simulated_plcs

SETTINGS = ("300", "500", "12", "25", "1500")
"""watchdog_ms, ramp_ms, min_fill, stuck_um, servo_lag_us."""

pytestmark = [pytest.mark.peer, pytest.mark.wires]


def _with_modbus_tk(port: int) -> dict[str, Any]:
    """What a user of modbus-tk does with unit 3: read, write, provoke an exception."""
    from modbus_tk import defines, modbus, modbus_tcp

    master = modbus_tcp.TcpMaster("127.0.0.1", port, timeout_in_sec=2.0)
    seen: dict[str, Any] = {}
    try:
        seen["identity"] = master.execute(3, defines.READ_HOLDING_REGISTERS, 0x200, 50)
        seen["input"] = master.execute(3, defines.READ_INPUT_REGISTERS, 0x200, 2)
        seen["write"] = master.execute(3, defines.WRITE_MULTIPLE_REGISTERS, 0x40, output_value=[250, 600, 9, 20, 2000])
        seen["settings"] = master.execute(3, defines.READ_HOLDING_REGISTERS, 0x40, 5)
        seen["single"] = master.execute(3, defines.WRITE_SINGLE_REGISTER, 0x0F, output_value=77)
        seen["status"] = master.execute(3, defines.READ_HOLDING_REGISTERS, 0x100, 30)
        for key, unit, function, address in (
            ("part of a command", 3, defines.WRITE_SINGLE_REGISTER, 0x01),
            ("no such unit", 9, defines.READ_HOLDING_REGISTERS, 0x100),
            ("coils", 3, defines.READ_COILS, 0),
        ):
            try:
                master.execute(unit, function, address, 1, 1)
            except modbus.ModbusError as error:
                seen[key] = error.get_exception_code()
    finally:
        master.close()
    return seen


async def test_modbus_tk_reads_and_writes_the_simulated_plc() -> None:
    pytest.importorskip("modbus_tk")
    async with simulated_plcs() as (_, addresses):
        seen = await asyncio.to_thread(_with_modbus_tk, addresses["C"][1])
    assert seen["identity"][:5] == (0x1234, 0x5678, 2, 3, 10)
    assert struct.pack(">16H", *seen["identity"][6:22]).rstrip(b"\0") == b"C"
    assert seen["input"] == (0x1234, 0x5678)
    assert seen["write"] == (0x40, 5)
    assert seen["settings"] == (250, 600, 9, 20, 2000)
    assert seen["single"] == (0x0F, 77)
    assert seen["status"][1:4] == (77, 1, 0)
    positions = [struct.unpack(">i", struct.pack(">HH", *seen["status"][15 + 5 * i : 17 + 5 * i]))[0] for i in range(3)]
    assert positions == [round(v * 1000) for v in START_MM[6:9]]
    assert seen["part of a command"] == 2
    assert seen["no such unit"] == 11
    assert seen["coils"] == 1


async def _mbpoll(port: int, *arguments: str) -> str:
    process = await asyncio.create_subprocess_exec(
        "mbpoll", "-m", "tcp", "-p", str(port), "-1", "-0", *arguments,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    output, _ = await process.communicate()
    return output.decode()


@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll (Debian package) is not installed")
async def test_mbpoll_reads_int32_positions_high_word_first() -> None:
    async with simulated_plcs() as (plant, addresses):
        plant.position_mm[4] = -312.3456
        port = addresses["B"][1]
        text = await _mbpoll(port, "-a", "2", "-r", str(0x10F + 5), "-c", "1", "-t", "4:int", "-B", "127.0.0.1")
        assert re.search(r"\[276\]:\s+-312346\b", text), text
        written = await _mbpoll(port, "-a", "2", "-r", str(0x40), "-t", "4", "127.0.0.1", *SETTINGS)
        assert "Written 5 references" in written, written
        text = await _mbpoll(port, "-a", "2", "-r", str(0x40), "-c", "5", "-t", "4", "127.0.0.1")
        assert re.findall(r"\[\d+\]:\s+(\d+)", text) == list(SETTINGS)
        motion = await _mbpoll(port, "-a", "2", "-r", str(0x50), "-t", "4", "127.0.0.1", "40", "350")
        assert "Written 2 references" in motion, motion
        text = await _mbpoll(port, "-a", "2", "-r", str(0x50), "-t", "4", "127.0.0.1", "501", "350")
        assert "Illegal data value" in text, "a quick ramp slower than the ordinary one"
        text = await _mbpoll(port, "-a", "2", "-r", "900", "-c", "1", "-t", "4", "127.0.0.1")
        assert "Illegal data address" in text


async def play_to_the_end(driver: ModbusPositioners, table: Any, plant: Any) -> None:
    """Run the plan, close the driver; the axes stand where the plan ends, braked."""
    await driver.load(table)
    await driver.command("run")
    async with asyncio.timeout(20.0):
        feedback = await driver.poll()
        while not feedback.path_time_s >= table.duration_s:
            await asyncio.sleep(0.05)
            feedback = await driver.poll()
    assert plant.position_mm == pytest.approx(table.q_mm[-1], abs=0.0006)
    await driver.close()
    assert plant.braked.all()


async def test_the_driver_moves_the_plcs_over_loopback_in_real_time() -> None:
    async with simulated_plcs() as (plant, addresses):
        config = cell(timeout_s=0.5, watchdog_s=1.0)
        driver = ModbusPositioners(config, addresses)
        identities = await driver.bring_up()
        assert [identity.serial for identity in identities] == ["SP-A", "SP-B", "SP-C", "SP-D"]
        await driver.enable()
        table = plan(config, 1.5)
        await play_to_the_end(driver, table, plant)


async def test_the_driver_moves_the_plcs_over_one_serial_line_in_real_time() -> None:
    async with simulated_line() as (plant, path):
        line = {"kind": "modbus-rtu", "line": path, "baud": LINE_BAUD, "poll_s": 0.2, "segment_s": 0.2}
        config = cell(**line, timeout_s=0.5, watchdog_s=1.5)
        driver = ModbusPositioners(config)
        await driver.bring_up()
        await driver.enable()
        table = plan(config, 1.6)
        await play_to_the_end(driver, table, plant)


@asynccontextmanager
async def pymodbus_server() -> AsyncIterator[tuple[int, dict[str, Any]]]:
    """A pymodbus server with ten registers from 0 on unit 1; `act` holds what it does wrong."""
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    act: dict[str, Any] = {"delay_s": 0.0}

    async def action(*_arguments: Any) -> None:
        await asyncio.sleep(act["delay_s"])

    def trace_pdu(sending: bool, pdu: Any) -> Any:
        return act["change"](pdu) if sending and "change" in act else pdu

    block = SimData(0, values=[100 + i for i in range(10)], datatype=DataType.REGISTERS)
    server = ModbusTcpServer(SimDevice(1, [block], action=action), address=("127.0.0.1", 0), trace_pdu=trace_pdu)
    await server.serve_forever(background=True)
    try:
        yield server.transport.sockets[0].getsockname()[1], act  # type: ignore[attr-defined]
    finally:
        await server.shutdown()


async def test_our_client_against_a_pymodbus_server() -> None:
    async with pymodbus_server() as (port, act):
        unit = ModbusUnit("peer", "127.0.0.1", port, 1, 0.3)
        await unit.connect()
        assert await unit.read(2, 3) == bytes((0, 102, 0, 103, 0, 104))
        await unit.write(4, bytes.fromhex("abcd 0001"))
        assert await unit.exchange(0, bytes.fromhex("1234"), 0, 1) == bytes.fromhex("1234")
        assert await unit.read(4, 2) == bytes.fromhex("abcd 0001")
        with pytest.raises(DeviceRefused, match="illegal register address"):
            await unit.read(40, 2)
        act["change"] = _shorten
        with pytest.raises(BadReply, match="4 bytes of data instead of 6"):
            await unit.read(2, 3)
        act["change"] = _forget_transaction
        with pytest.raises(DeviceSilent):
            await unit.read(2, 3)
        del act["change"]
        act["delay_s"] = 0.5
        with pytest.raises(DeviceSilent):
            await unit.read(2, 1)
        act["delay_s"] = 0.0
        await asyncio.sleep(0.4)
        assert await unit.read(3, 1) == bytes((0, 103)), "the late answer of the read before is not taken"
        unit.close()


def _shorten(pdu: Any) -> Any:
    pdu.registers = pdu.registers[:-1]
    return pdu


def _forget_transaction(pdu: Any) -> Any:
    pdu.transaction_id = 0
    return pdu


async def _connected(port: int) -> ModbusUnit:
    """The server's thread needs a moment until it listens."""
    unit = ModbusUnit("peer", "127.0.0.1", port, 1, 2.0)
    for _ in range(100):
        try:
            await unit.connect()
        except PortMissing:
            await asyncio.sleep(0.05)
        else:
            return unit
    raise AssertionError("the peer never listened")


# modbus-tk calls Event.isSet, which Python 3.11 deprecates.
@pytest.mark.filterwarnings("ignore:isSet:DeprecationWarning")
async def test_our_client_against_a_modbus_tk_server() -> None:
    modbus_tcp = pytest.importorskip("modbus_tk.modbus_tcp")
    from modbus_tk import defines

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = modbus_tcp.TcpServer(port=port, address="127.0.0.1")
    slave = server.add_slave(1)
    slave.add_block("registers", defines.HOLDING_REGISTERS, 0, 10)
    slave.set_values("registers", 0, [7, 8, 9])
    server.start()
    try:
        unit = await _connected(port)
        assert await unit.read(0, 3) == bytes((0, 7, 0, 8, 0, 9))
        await unit.write(1, bytes.fromhex("fffe"))
        assert slave.get_values("registers", 1, 1) == (0xFFFE,)
        # This peer reads before it writes, against the specification; the driver takes such an answer for "not yet".
        assert await unit.exchange(5, bytes.fromhex("0102"), 5, 1) == bytes(2)
        assert await unit.read(5, 1) == bytes.fromhex("0102")
        with pytest.raises(DeviceRefused, match="illegal register address"):
            await unit.read(50, 1)
        unit.close()
    finally:
        await asyncio.to_thread(server.stop)
