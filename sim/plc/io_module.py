"""A simulated Modbus I/O module: discrete inputs and input registers, written down apart from the controller's map."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable

from sim.input_world import InputWorld
from sim.plc.modbus_tcp import ILLEGAL_ADDRESS, ModbusRefusal, ModbusTcpConnection
from sim.plc.reply_faults import ReplyFaults

CONTACTS = 16
ANALOGUE = 4
_IDENTITY_AT = 0x100
_IDENTITY = struct.pack(">IH16s16s16s8s", 0x494F3031, 1, b"SimPositioner", b"IO-16-4", b"IO-0001", b"2.1")
COUNT_S = 0.01
"""The module counts up so often."""


class IoRegisters:
    """Input registers: 0 counts up, 1..4 analogue inputs, 100h.. identity. Discrete inputs from 0."""

    def __init__(self, name: str, world: InputWorld, clock: Callable[[], float]) -> None:
        self.name, self._world, self._clock = name, world, clock
        self.stuck = False
        self._alive = 0

    @property
    def answers(self) -> bool:
        """False while the module is cut off."""
        return self.name not in self._world.silent

    def bits(self, address: int, count: int) -> bytes:
        """`count` discrete inputs from `address`, eight a byte."""
        if not address + count <= CONTACTS:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        levels = int.from_bytes(self._world.contacts(self.name, CONTACTS), "little") >> address
        return (levels & (1 << count) - 1).to_bytes((count + 7) // 8, "little")

    def read(self, address: int, count: int) -> bytes:
        """`count` input registers from `address`."""
        if address >= _IDENTITY_AT:
            block, start = _IDENTITY, 2 * (address - _IDENTITY_AT)
        else:
            if not self.stuck:
                self._alive = int(self._clock() / COUNT_S) & 0xFFFF
            counts = self._world.counts(self.name, ANALOGUE)
            block, start = struct.pack(f">H{ANALOGUE}h", self._alive, *counts), 2 * address
        data = block[start : start + 2 * count]
        if len(data) != 2 * count:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return data

    def write(self, address: int, data: bytes) -> None:
        """Inputs cannot be written."""
        raise ModbusRefusal(ILLEGAL_ADDRESS)


class IoServer:
    """One I/O module at a Modbus TCP address."""

    def __init__(self, registers: IoRegisters, unit: int) -> None:
        self.registers, self._unit = registers, unit
        self._connections: set[ModbusTcpConnection] = set()
        self._server: asyncio.AbstractServer | None = None
        self.tap: Callable[[str, bool, bytes], None] | None = None
        self.faults = ReplyFaults()

    async def serve(self, host: str, port: int) -> tuple[str, int]:
        """Listen; return the address. Port 0 asks for a free one."""
        units, faults = {self._unit: self.registers}, {self._unit: self.faults}

        def connection() -> ModbusTcpConnection:
            return ModbusTcpConnection(units, self._connections, self._hear, faults)

        server = await asyncio.get_running_loop().create_server(connection, host, port)
        self._server = server
        if not server.sockets:
            return host, port
        bound = server.sockets[0].getsockname()
        return str(bound[0]), int(bound[1])

    def _hear(self, sent: bool, data: bytes) -> None:
        if self.tap is not None:
            self.tap(self.registers.name, sent, data)

    def drop_connections(self) -> None:
        """Cut every connection."""
        for connection in tuple(self._connections):
            connection.close()

    async def close(self) -> None:
        self.drop_connections()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
