"""A Modbus TCP I/O module: contacts and analogue inputs, polled."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable

from docking.config.inputs import ModbusModule
from docking.errors import BadReply, DockingError, WrongIdentity
from docking.types import Identity
from drivers.inputs import SILENT_AFTER
from drivers.maps.io_modules import load_modbus_io
from drivers.modbus_client import ModbusUnit, Tap, tapped

AGAIN_S = 1.0
"""Longest wait before a lost connection is tried again."""


class ModbusIoModule:
    """`drivers.inputs.InputModule` over discrete inputs and input registers. Construct it inside the running loop.

    A module that answers with the counter of the poll before is not fresh. A lost connection is tried again.
    """

    def __init__(self, config: ModbusModule, address: tuple[str, int] | None = None, tap: Tap | None = None) -> None:
        self.name, self._config = config.name, config
        self.on_change: Callable[[], None] = lambda: None
        self._map = load_modbus_io(config.map)
        self.where = f"input module {config.name}"
        host, port = address or (config.host, config.port)
        self.unit = ModbusUnit(self.where, host, port, config.unit, config.timeout_s)
        self.unit.tap = tapped(tap, config.name)
        self._levels = b""
        self._counts: tuple[int, ...] = ()
        self._alive: int | None = None
        self._fresh_s = float("-inf")
        self._silent = True
        self._keeper: asyncio.Task[None] | None = None

    @property
    def silent(self) -> bool:
        return self._silent

    @property
    def channels(self) -> tuple[int, int]:
        return self._map.digital_inputs, self._map.analogue_inputs

    def level(self, channel: int) -> bool:
        return bool(self._levels[channel // 8] >> channel % 8 & 1)

    def counts(self, channel: int) -> int | None:
        value = self._counts[channel]
        return None if value == self._map.broken else value

    async def bring_up(self) -> Identity:
        """Connect, prove word order and map, read all inputs twice: they must be alive.

        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply, WrongIdentity.
        """
        await self.unit.connect()
        identity = await self._prove()
        await self._read()
        await asyncio.sleep(self._config.poll_s)
        await self._read()
        if self._silent:
            raise BadReply(self.where, "Its counter stands still: what it says is old.", value=self._alive)
        self._keeper = asyncio.get_running_loop().create_task(self._keep())
        return identity

    async def close(self) -> None:
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)
            self._keeper = None
        self.unit.close()

    async def _prove(self) -> Identity:
        block = self._map.identity
        head, _ = block.unpack(await self.unit.read_inputs(block.address, block.count))
        if head["magic"] != self._map.magic:
            raise BadReply(self.where, "The word order differs.", value=f"{head['magic']:#x} for {self._map.magic:#x}")
        if head["map_version"] != self._map.version:
            raise WrongIdentity(
                self.where, "Compared: map version.", value=head["map_version"], limit=self._map.version
            )
        return Identity(self.where, head["vendor"], head["product"], head["serial"], head["firmware"])

    async def _read(self) -> None:
        """One poll: contacts, counter and analogue inputs."""
        layout = self._map
        levels = await self.unit.read_bits(layout.discrete_at, layout.digital_inputs)
        first = min(layout.alive_at, layout.analogue_at)
        count = max(layout.alive_at, layout.analogue_at + layout.analogue_inputs - 1) + 1 - first
        words = struct.unpack(f">{count}h", await self.unit.read_inputs(first, count))
        start = layout.analogue_at - first
        self._take(levels, words[start : start + layout.analogue_inputs], words[layout.alive_at - first] & 0xFFFF)

    def _take(self, levels: bytes, counts: tuple[int, ...], alive: int) -> None:
        now_s = asyncio.get_running_loop().time()
        # One answer proves nothing: only a counter that has moved says that the inputs are of now.
        if self._alive is not None and alive != self._alive:
            self._fresh_s = now_s
        self._alive = alive
        silent = not self._recent(now_s)
        changed = (levels, counts, silent) != (self._levels, self._counts, self._silent)
        self._levels, self._counts, self._silent = levels, counts, silent
        if changed:
            self.on_change()

    def _recent(self, now_s: float) -> bool:
        return now_s - self._fresh_s <= SILENT_AFTER * self._config.poll_s

    async def _keep(self) -> None:
        while True:
            await asyncio.sleep(self._config.poll_s)
            try:
                if not self.unit.connected:
                    await self.unit.connect()
                    await self._prove()
                await self._read()
            except DockingError:
                if not self._recent(asyncio.get_running_loop().time()) and not self._silent:
                    self._silent = True
                    self.on_change()
                if not self.unit.connected:
                    await asyncio.sleep(min(AGAIN_S, 10.0 * self._config.poll_s))
