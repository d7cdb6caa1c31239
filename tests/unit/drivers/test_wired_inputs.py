"""Inputs from the wire: debouncing, CiA 401 and Modbus modules against their simulated devices, silence and lies."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import pytest

from docking.config.inputs import CanModule, DigitalInput, InputsConfig, ModbusModule, TemperatureInput
from docking.config.load import load_cell
from docking.errors import BadReply, DeviceSilent, ReadBackMismatch, WrongIdentity
from drivers.canopen.io_module import CanIoModule
from drivers.canopen.shared import SharedCan
from drivers.inputs import WiredInputs
from drivers.modbus_inputs import ModbusIoModule
from sim.canopen.dictionary import Entry
from sim.canopen.io_module import IoModule
from sim.input_world import InputWorld
from sim.plc.io_module import IoRegisters, IoServer
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan

CELLS = Path(__file__).parents[3] / "sim" / "cells"
CONTACTS = (
    DigitalInput(name="e_stop", use="emergency-stop", module="io1", channel=0, on="low", debounce_s=0.0),
    DigitalInput(name="crane_free", module="io1", channel=9, debounce_s=0.02),
)
SENSORS = (TemperatureInput(name="warm", of="component", module="io1", channel=1, celsius_per_count=0.1, sigma_k=1e-6),)
CAN = InputsConfig(modules=(CanModule(kind="cia401", name="io1", node=40),), digital=CONTACTS, temperatures=SENSORS)
MODBUS = InputsConfig(
    modules=(ModbusModule(kind="modbus-io", name="io1", host="127.0.0.1", port=15040),),
    digital=CONTACTS,
    temperatures=SENSORS,
)


class Bathtub:
    """A plant with one temperature."""

    celsius = 23.4

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        return dict.fromkeys(("component", "mate", "floor"), self.celsius)


class Bench:
    """Simulated module and driver, joined; `seen` collects (time, state) of every change."""

    def __init__(self, config: InputsConfig) -> None:
        self.loop = asyncio.get_running_loop()
        self.plant = Bathtub()
        cell = load_cell(CELLS / "lab-can.toml").model_copy(update={"inputs": config})
        self.world = InputWorld(cell, self.plant, self.loop, 1)
        self.config = config
        self.seen: list[tuple[float, dict[str, bool | None]]] = []

    async def can(self) -> None:
        self.bus = VirtualCan(self.loop, 1_000_000)
        far = self.bus.end()
        await far.open()
        self.device = IoModule("io1", 40, self.world, far, self.loop)
        self.device.start()
        module = self.config.modules[0]
        end = SharedCan(self.bus.end()).end(CanIoModule.cobs(module))
        self._drive(CanIoModule(module, end, lambda code: f"{code:08X}h"))

    async def modbus(self) -> None:
        module = self.config.modules[0]
        self.server = IoServer(IoRegisters("io1", self.world, self.loop.time), module.unit)
        await self.server.serve(module.host, module.port)
        self._drive(ModbusIoModule(module))

    def _drive(self, module: CanIoModule | ModbusIoModule) -> None:
        self.module = module
        self.inputs = WiredInputs(self.config, {"io1": module})
        self.inputs.on_change = lambda: self.seen.append((self.loop.time(), self.inputs.latest().given))

    async def close(self) -> None:
        await self.inputs.close()
        for device in (getattr(self, "device", None), getattr(self, "server", None)):
            result = device.close() if device is not None else None
            if asyncio.iscoroutine(result):
                await result


def on(kind: str, play):
    """Play a coroutine function on a bench in virtual time."""

    async def main():
        bench = Bench(CAN if kind == "can" else MODBUS)
        await getattr(bench, kind)()
        try:
            return await play(bench)
        finally:
            await bench.close()

    return run_virtual(main)


BOTH = pytest.mark.parametrize("kind", ["can", "modbus"])


@BOTH
def test_levels_identity_and_temperature_reach_the_host(kind):
    async def play(bench: Bench):
        (identity,) = await bench.inputs.bring_up()
        first = bench.inputs.latest()
        bench.world.hold("e_stop", True)
        bench.plant.celsius = 21.0
        await asyncio.sleep(1.1)
        return identity, first, bench.inputs.latest()

    identity, first, later = on(kind, play)
    assert identity.where == "input module io1"
    assert identity.serial in ("401040", "IO-0001")
    assert first.given == {"e_stop": False, "crane_free": True}
    assert first.temperature_c["warm"] == pytest.approx(23.4)
    assert later.given == {"e_stop": True, "crane_free": True}
    assert later.temperature_c["warm"] == pytest.approx(21.0)
    assert later.silent == ()


def test_a_change_is_told_at_once_on_can_and_within_a_poll_on_modbus():
    async def play(bench: Bench):
        await bench.inputs.bring_up()
        await asyncio.sleep(0.1234)
        bench.seen.clear()
        pressed_s = bench.loop.time()
        bench.world.hold("e_stop", True)
        await asyncio.sleep(0.2)
        return bench.seen[0][0] - pressed_s

    assert on("can", play) <= 0.001
    assert on("modbus", play) <= 0.05 + 0.005


@BOTH
def test_a_bounce_shorter_than_the_debouncing_is_not_told_and_a_longer_one_is(kind):
    async def play(bench: Bench):
        config = bench.config.digital[1].model_copy(update={"debounce_s": 0.12})
        bench.inputs = WiredInputs(
            bench.config.model_copy(update={"digital": (bench.config.digital[0], config)}), {"io1": bench.module}
        )
        changes: list[bool | None] = []
        await bench.inputs.bring_up()
        bench.inputs.on_change = lambda: changes.append(bench.inputs.latest().given["crane_free"])
        for gap_s in (0.06, 0.5):
            bench.world.hold("crane_free", False)
            await asyncio.sleep(gap_s)
            bench.world.hold("crane_free", True)
            await asyncio.sleep(0.5)
        return changes

    assert on(kind, play) == [False, True]


@BOTH
def test_a_module_that_falls_silent_gives_nothing_and_comes_back_by_itself(kind):
    async def play(bench: Bench):
        await bench.inputs.bring_up()
        bench.world.mute("io1")
        began_s, told = bench.loop.time(), asyncio.Event()
        bench.inputs.on_change = told.set
        await told.wait()
        silent_s, gone = bench.loop.time() - began_s, bench.inputs.latest()
        bench.world.mute("io1", False)
        await asyncio.sleep(3.0)
        return silent_s, gone, bench.inputs.latest()

    silent_s, gone, back = on(kind, play)
    assert silent_s <= 0.3
    assert gone.given == {"e_stop": None, "crane_free": None}
    assert gone.temperature_c["warm"] != gone.temperature_c["warm"]
    assert back.given == {"e_stop": False, "crane_free": True}
    assert back.silent == ()


def test_a_module_that_restarts_is_not_believed_until_it_is_brought_up_again():
    async def play(bench: Bench):
        await bench.inputs.bring_up()
        bench.device.restart()
        await asyncio.sleep(0.001)
        gone = bench.inputs.latest().silent
        await asyncio.sleep(1.0)
        return gone, bench.inputs.latest().silent

    assert on("can", play) == (("io1",), ("io1",))


def test_a_modbus_module_that_repeats_itself_is_silent():
    async def play(bench: Bench):
        await bench.inputs.bring_up()
        bench.server.registers.stuck = True
        await asyncio.sleep(0.5)
        gone = bench.inputs.latest().silent
        bench.server.registers.stuck = False
        await asyncio.sleep(0.5)
        return gone, bench.inputs.latest().silent

    assert on("modbus", play) == (("io1",), ())


def test_a_modbus_module_that_repeats_itself_from_the_start_is_refused():
    async def play(bench: Bench):
        bench.server.registers.stuck = True
        with pytest.raises(BadReply, match="counter stands still"):
            await bench.inputs.bring_up()

    on("modbus", play)


def test_a_modbus_module_is_found_again_after_its_connection_broke():
    async def play(bench: Bench):
        await bench.inputs.bring_up()
        bench.server.drop_connections()
        await asyncio.sleep(0.4)
        gone = bench.inputs.latest().silent
        await asyncio.sleep(2.0)
        return gone, bench.inputs.latest()

    _gone, back = on("modbus", play)
    assert back.silent == ()
    assert back.given == {"e_stop": False, "crane_free": True}


@BOTH
def test_a_broken_sensor_has_no_temperature(kind):
    async def play(bench: Bench):
        bench.world.break_sensor("warm")
        await bench.inputs.bring_up()
        return bench.inputs.latest().temperature_c["warm"]

    value = on(kind, play)
    assert value != value


@BOTH
def test_a_channel_that_the_module_does_not_have_is_named(kind):
    async def play(bench: Bench):
        far_off = bench.config.digital[1].model_copy(update={"channel": 16})
        inputs = WiredInputs(bench.config.model_copy(update={"digital": (far_off,)}), {"io1": bench.module})
        with pytest.raises(BadReply, match=r"crane_free.*no digital input 16"):
            await inputs.bring_up()

    on(kind, play)


@pytest.mark.parametrize(
    ("key", "entry", "error", "words"),
    [
        ((0x1000, 0), Entry("I", 0x0002_0192), WrongIdentity, "device profile"),
        ((0x6000, 0), Entry("B", 1), WrongIdentity, "blocks of 8 contacts"),
        ((0x6401, 0), Entry("B", 2), WrongIdentity, "analogue inputs"),
    ],
)
def test_another_device_behind_the_node_is_named(key, entry, error, words):
    async def play(bench: Bench):
        bench.device._dictionary._entries[key] = entry
        with pytest.raises(error, match=words) as caught:
            await bench.inputs.bring_up()
        assert caught.value.where == "input module io1"

    on("can", play)


@pytest.mark.parametrize(
    "key", [(0x6005, 0), (0x6423, 0), (0x1017, 0), (0x1800, 2), (0x1800, 5), (0x1A00, 0), (0x1801, 1), (0x1A01, 3)]
)
def test_a_module_that_keeps_another_value_than_it_was_told_is_refused_by_object(key):
    async def play(bench: Bench):
        dictionary = bench.device._dictionary
        write = dictionary.write
        dictionary._entries[0x6005, 0] = Entry("B", 0, True, 0, 1)

        def deaf(index: int, sub: int, data: bytes) -> None:
            if (index, sub) != key:
                write(index, sub, data)

        dictionary.write = deaf
        if key == (0x1800, 2):
            dictionary._entries[key] = Entry("B", 254, True, 254, 255)
        with pytest.raises(ReadBackMismatch, match=f"{key[0]:04X}h:{key[1]:02X}"):
            await bench.inputs.bring_up()

    on("can", play)


def test_nobody_behind_the_node_is_named():
    async def play(bench: Bench):
        bench.world.mute("io1")
        with pytest.raises(DeviceSilent, match="input module io1"):
            await bench.inputs.bring_up()

    on("can", play)


def test_the_bytes_on_the_bus_are_those_of_cia_401():
    """Read off the bus with code of the test's own: contacts lowest first at 180h + node, counts at 280h + node."""
    heard: dict[int, bytes] = {}

    async def play(bench: Bench):
        bench.bus.keep = lambda cob, data: heard.__setitem__(cob, data) is None
        await bench.inputs.bring_up()
        await asyncio.sleep(0.1)

    on("can", play)
    # e_stop is not pressed and wired to low: input 0 high; crane_free: input 9 high.
    assert heard[0x180 + 40] == bytes((0b0000_0001, 0b0000_0010))
    assert struct.unpack("<4h", heard[0x280 + 40]) == (-32768, 234, -32768, -32768)
    assert heard[0x700 + 40] == b"\x05"


def test_one_bus_for_several_drivers_is_released_with_the_last():
    async def main():
        bus = VirtualCan(asyncio.get_running_loop(), 1_000_000)
        near, other = bus.end(), bus.end()
        await other.open()
        shared = SharedCan(near)
        whole, part = shared.end(), shared.end(frozenset((0x1A8,)))
        got: dict[str, list] = {"whole": [], "part": []}
        whole.on_frames, part.on_frames = got["whole"].extend, got["part"].extend
        await whole.open()
        await part.open()
        other.send([(0x181, b"a"), (0x1A8, b"b")])
        await asyncio.sleep(0.01)
        whole.close()
        assert near.is_open
        other.send([(0x1A8, b"c")])
        await asyncio.sleep(0.01)
        part.close()
        return got, near.is_open

    got, is_open = run_virtual(main)
    assert got == {"whole": [(0x181, b"a"), (0x1A8, b"b")], "part": [(0x1A8, b"b"), (0x1A8, b"c")]}
    assert not is_open
