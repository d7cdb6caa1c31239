"""A broken connection: tried again on request, with bounded waits; everything is proved and the watchdog armed anew."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from docking.errors import DockingError, LinkLost, PortMissing, ReadBackMismatch
from drivers.modbus_positioners import ModbusPositioners
from drivers.positioner_plc import RECONNECT_S
from sim.plc import registers as reg
from sim.plc.group import PlcGroup
from sim.plc.registers import State
from sim.virtual_time import run_virtual
from tests.support.modbus_cell import StiffPlant, cell

WATCHDOG_MS = 120


class Bench:
    """Four PLCs, enabled; B loses its connection when told to."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.group = PlcGroup(StiffPlant(), cell(), (0.0,) * 4, self.loop)
        self.driver = ModbusPositioners(cell())
        self.b = self.group.plcs[1]

    async def lose_b(self) -> None:
        """Cut the connection, poll the others until B has missed the host and all are in fault."""
        self.group.drop_connections("B")
        await asyncio.sleep(0.01)
        with pytest.raises(LinkLost):
            await self.driver.poll()
        for _ in range(60):
            await self.driver.poll(surviving=True)
            await asyncio.sleep(0.05)
        assert self.b.state is State.FAULT


def with_plcs(scenario: Callable[[Bench], Awaitable[None]]) -> None:
    async def main() -> None:
        bench = Bench()
        await bench.group.serve()
        await bench.driver.bring_up()
        await bench.driver.enable()
        await bench.lose_b()
        await scenario(bench)

    run_virtual(main)


def test_a_plc_that_forgets_its_watchdog_gets_it_again_before_it_is_enabled() -> None:
    async def scenario(bench: Bench) -> None:
        bench.b.forgets_watchdog = True
        await bench.driver.command("reset")
        assert bench.b.state is State.DISABLED, "a reset moves and powers nothing"
        assert bench.b.settings.watchdog_ms == 0, "the connection has made it forget"
        await bench.driver.enable()
        assert bench.b.settings.watchdog_ms == WATCHDOG_MS
        silent_s = bench.loop.time()
        await asyncio.sleep(3.0)
        assert bench.b.fault is not reg.Fault.NONE, "armed: it stops without the host"
        assert bench.loop.time() - silent_s >= WATCHDOG_MS / 1000.0

    with_plcs(scenario)


def test_a_watchdog_that_cannot_be_armed_is_named_and_nothing_is_enabled() -> None:
    async def scenario(bench: Bench) -> None:
        bench.b.forgets_watchdog = True
        await bench.driver.command("reset")
        bench.b._set = lambda settings: None  # type: ignore[method-assign]
        with pytest.raises(ReadBackMismatch, match="positioner B, watchdog_ms"):
            await bench.driver.enable()
        assert {plc.state for plc in bench.group.plcs} == {State.DISABLED}

    with_plcs(scenario)


def test_an_address_that_stays_silent_is_given_up_in_time() -> None:
    async def scenario(bench: Bench) -> None:
        address = ("127.0.0.1", 15021)
        server = bench.loop.servers.pop(address)  # type: ignore[attr-defined]
        began_s = bench.loop.time()
        with pytest.raises(PortMissing):
            await bench.driver.command("reset")
        assert bench.loop.time() - began_s <= RECONNECT_S + 0.5
        bench.loop.servers[address] = server  # type: ignore[attr-defined]
        await bench.driver.command("reset")
        await bench.driver.enable()

    with_plcs(scenario)


def test_nothing_is_reconnected_unasked() -> None:
    async def scenario(bench: Bench) -> None:
        for _ in range(5):
            with pytest.raises(DockingError):
                await bench.driver.poll()
        assert not bench.driver._plcs[1].unit.connected

    with_plcs(scenario)
