"""P6 and P7: one Modbus write against a raw socket, and twelve writes at once against twelve in turn.

The far end is a process of its own. One address is a pymodbus server (P6); twelve are drives, which answer after 1 ms
and keep the time at which a request arrived: the spread of one round over the twelve is how far they start apart (P7).
"""

from __future__ import annotations

import asyncio
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from docking.assemble.real_time import run_real
from drivers.modbus_client import WRITE, ModbusUnit
from sim.plc.modbus_tcp import ModbusTcpConnection
from tests.bench.metric import Metric, Sizes

DRIVES = 12
WORDS = 24
BLOCKS_A_REPEAT, WRITES_A_BLOCK, ROUNDS_A_REPEAT = 10, 50, 20
TURNAROUND_S = 0.001
"""Between a request and the answer of a drive; real ones take milliseconds."""
TIMES_AT, LATEST = 0x100, 4
"""Where the far end shows its last arrival, in ns: four registers."""


def measure(sizes: Sizes) -> list[Metric]:
    with _far_end() as ports:
        figures = [run_real(lambda: _repeat(ports), lambda: None) for _ in range(sizes.repeats)]
    ours, raw, together, in_turn = (statistics.median(column) for column in zip(*figures, strict=True))
    return [
        Metric(
            "P6", f"Modbus write of {WORDS} registers", f"{ours * 1e6:.0f} us", f"raw socket {raw * 1e6:.0f} us",
            statistics.median(f[0] / f[1] for f in figures), 2.0, at_least=False,
        ),
        Metric(
            "P7", f"first to last of {DRIVES} drives written", f"{together * 1e6:.0f} us",
            f"one after another {in_turn * 1e6:.0f} us",
            statistics.median(f[2] / f[3] for f in figures), 0.15, at_least=False,
        ),
    ]  # fmt: skip


async def _repeat(ports: list[int]) -> tuple[float, float, float, float]:
    """Medians (s) of our write, of the raw socket's, of the spread of twelve at once and of twelve in turn."""
    quick, *units = [ModbusUnit(f"drive {i}", "127.0.0.1", port, 1, 1.0) for i, port in enumerate(ports)]
    for unit in (quick, *units):
        await unit.connect()
    data = bytes(2 * WORDS)
    ours: list[float] = []
    raw: list[float] = []
    for _ in range(BLOCKS_A_REPEAT):
        for _ in range(WRITES_A_BLOCK):
            began_s = time.perf_counter()
            await quick.write(0, data)
            ours.append(time.perf_counter() - began_s)
        raw += _raw_writes_s(ports[0], data)

    async def at_once() -> None:
        await asyncio.gather(*(unit.write(0, data) for unit in units))

    async def in_turn() -> None:
        for unit in units:
            await unit.write(0, data)

    spreads = [(await _spread(units, at_once), await _spread(units, in_turn)) for _ in range(ROUNDS_A_REPEAT)]
    for unit in (quick, *units):
        unit.close()
    together, sequential = (statistics.median(column) for column in zip(*spreads, strict=True))
    return statistics.median(ours), statistics.median(raw), together, sequential


async def _spread(units: list[ModbusUnit], write: Callable[[], Awaitable[None]]) -> float:
    """Time (s) between the first and the last arrival of one round."""
    await write()
    arrived = [struct.unpack(">q", await unit.read(TIMES_AT, LATEST))[0] for unit in units]
    return float(max(arrived) - min(arrived)) * 1e-9


def _raw_writes_s(port: int, data: bytes) -> list[float]:
    """Times (s) of the same request by a blocking socket that looks at nothing."""
    request = struct.pack(">HHHBBHHB", 1, 0, 7 + len(data), 1, 16, 0, len(data) // 2, len(data)) + data
    times: list[float] = []
    with socket.create_connection(("127.0.0.1", port)) as wire:
        wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for _ in range(WRITES_A_BLOCK):
            began_s = time.perf_counter()
            wire.sendall(request)
            wire.recv(260)
            times.append(time.perf_counter() - began_s)
    return times


class _Stamped:
    """Registers that take everything and tell when the last write came."""

    def __init__(self) -> None:
        self.arrived_ns = 0

    def read(self, address: int, count: int) -> bytes:
        return struct.pack(">q", self.arrived_ns)

    def write(self, address: int, data: bytes) -> None:
        """Take it."""


class _Drive(ModbusTcpConnection):
    """Notes when a write arrives and answers later."""

    def __init__(self, drive: _Stamped) -> None:
        super().__init__({1: drive}, set())
        self._drive = drive

    def data_received(self, data: bytes) -> None:
        if data[7] == WRITE:
            self._drive.arrived_ns = time.monotonic_ns()
        asyncio.get_running_loop().call_later(TURNAROUND_S, super().data_received, data)


@contextmanager
def _far_end() -> Iterator[list[int]]:
    process = subprocess.Popen([sys.executable, "-m", "tests.bench.modbus_wire"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield [int(word) for word in process.stdout.readline().split()]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


async def _serve() -> None:
    """The server written by others and twelve drives; their ports on one line."""
    loop = asyncio.get_running_loop()
    servers = []
    for _ in range(DRIVES):
        make = partial(_Drive, _Stamped())
        servers.append(await loop.create_server(make, "127.0.0.1", 0))
    block = SimData(0, values=WORDS * [0], datatype=DataType.REGISTERS)
    quick = ModbusTcpServer(SimDevice(1, [block]), address=("127.0.0.1", 0))
    await quick.serve_forever(background=True)
    listening = [*quick.transport.sockets, *(server.sockets[0] for server in servers)]  # type: ignore[attr-defined]
    print(*(each.getsockname()[1] for each in listening), flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_serve())
