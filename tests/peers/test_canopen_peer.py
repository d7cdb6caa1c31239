"""python-canopen, a master written by others, commands the simulated drives over the AF_UNIX bus in real time."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.links.unix_bus import UnixBus
from sim.canopen import DriveGroup, DriveSettings
from sim.canopen.drives import Stage
from sim.wires.unix_can import UnixCanServer
from tests.support.can_bench import FakePlant, can_cell

canopen = pytest.importorskip("canopen")
pytestmark = [pytest.mark.peer, pytest.mark.wires]

NODE = 5


def dictionary() -> Any:
    """The objects that this client uses, as an EDS would name them."""
    from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes

    od = ObjectDictionary()

    def add(parent: Any, name: str, index: int, sub: int, kind: int) -> None:
        variable = ODVariable(name, index, sub)
        variable.data_type = kind
        (parent.add_member if parent is not od else od.add_object)(variable)

    for name, index, kind in (
        ("Device name", 0x1008, datatypes.VISIBLE_STRING),
        ("Heartbeat", 0x1017, datatypes.UNSIGNED16),
        ("Controlword", 0x6040, datatypes.UNSIGNED16),
        ("Statusword", 0x6041, datatypes.UNSIGNED16),
        ("Mode", 0x6060, datatypes.INTEGER8),
        ("Mode display", 0x6061, datatypes.INTEGER8),
        ("Position", 0x6064, datatypes.INTEGER32),
        ("Target", 0x607A, datatypes.INTEGER32),
        # Only its low 16 bits are mapped, which this client can decode only as a 16-bit object.
        ("Following error", 0x60F4, datatypes.INTEGER16),
        ("Supported modes", 0x6502, datatypes.UNSIGNED32),
    ):
        add(od, name, index, 0, kind)
    identity = ODRecord("Identity", 0x1018)
    for sub, name in enumerate(("count", "vendor", "product", "revision", "serial")):
        add(identity, name, 0x1018, sub, datatypes.UNSIGNED32 if sub else datatypes.UNSIGNED8)
    od.add_object(identity)
    for base in (0x1400, 0x1800):
        for number in range(4):
            parameters = ODRecord(f"PDO {base + number:X}", base + number)
            for sub, kind in enumerate((datatypes.UNSIGNED8, datatypes.UNSIGNED32, datatypes.UNSIGNED8)):
                add(parameters, f"p{sub}", base + number, sub, kind)
            od.add_object(parameters)
            mapping = ODRecord(f"Mapping {base + number:X}", base + 0x200 + number)
            for sub in range(9):
                kind = datatypes.UNSIGNED32 if sub else datatypes.UNSIGNED8
                add(mapping, f"m{sub}", base + 0x200 + number, sub, kind)
            od.add_object(mapping)
    return od


def map_pdos(node: Any) -> None:
    """Give the drive the cyclic mapping, by the client's own means."""
    for pdo, content in (
        (node.rpdo[1], ((0x6040, 16), (0x607A, 32), (0x6060, 8))),
        (node.tpdo[1], ((0x6041, 16), (0x6064, 32), (0x60F4, 16))),
    ):
        pdo.read()
        pdo.clear()
        for index, bits in content:
            pdo.add_variable(index, 0, bits)
        pdo.trans_type = 1
        pdo.enabled = True
        pdo.save()
    for pdo in (node.rpdo[2], node.rpdo[3]):
        pdo.read()
        pdo.enabled = False
        pdo.save()


def drive_one_axis(path: Path) -> dict[str, Any]:
    """What a user of python-canopen does, in a thread of its own."""
    from canopen.profiles.p402 import BaseNode402

    seen: dict[str, Any] = {}
    network = canopen.Network(bus=UnixBus(str(path)))
    network.connect()
    emergencies: list[int] = []
    try:
        node = BaseNode402(NODE, dictionary())
        network.add_node(node)
        node.emcy.add_callback(lambda error: emergencies.append(error.code))
        seen["name"] = node.sdo[0x1008].raw
        seen["serial"] = node.sdo[0x1018][4].raw
        seen["modes"] = node.sdo[0x6502].raw
        try:
            node.sdo[0x1018][1].raw = 1
        except canopen.SdoAbortedError as abort:
            seen["abort"] = abort.code
        node.sdo[0x6060].raw = 8
        node.sdo[0x1017].raw = 50
        map_pdos(node)
        node.nmt.state = "OPERATIONAL"
        network.sync.start(0.01)
        seen["heartbeat"] = node.nmt.wait_for_heartbeat(1.0)
        node.setup_402_state_machine(read_pdos=False)
        start = node.sdo[0x6064].raw
        node.rpdo[1]["Target"].raw = start
        node.rpdo[1]["Mode"].raw = 8
        node.rpdo[1].start(0.01)
        node.state = "OPERATION ENABLED"
        seen["state"] = node.state
        time.sleep(0.12)
        for k in range(30):
            node.rpdo[1]["Target"].raw = start + 200 * (k + 1)
            time.sleep(0.01)
        time.sleep(0.05)
        seen["moved"] = node.tpdo[1]["Position"].raw - start
        node.rpdo[1]["Controlword"].raw = 0x02
        time.sleep(0.1)
        seen["stopped"] = node.sdo[0x6041].raw & 0x6F
        seen["emergencies"] = emergencies
    finally:
        node.rpdo[1].stop()
        network.sync.stop()
        network.disconnect()
    return seen


async def test_python_canopen_commands_a_simulated_drive(tmp_path: Path) -> None:
    cell = can_cell("lab-can")
    plant = FakePlant(cell.axis_names, np.linspace(-1.0, 1.0, 12), np.array(cell.driven))
    server = UnixCanServer(tmp_path / "can0")
    await server.open()
    group = DriveGroup(plant, cell, DriveSettings(), server, asyncio.get_running_loop())
    group.start()
    start = plant.position.copy()
    try:
        seen = await asyncio.to_thread(drive_one_axis, tmp_path / "can0")
        assert seen["name"] == "Simulated positioner drive"
        assert seen["serial"] == 402_005
        assert seen["modes"] >> 7 & 1
        assert seen["abort"] == 0x0601_0002
        assert seen["heartbeat"] == "OPERATIONAL"
        assert seen["state"] == "OPERATION ENABLED"
        assert seen["moved"] == 6000, "0.6 mm in tenths of a micrometre"
        assert seen["emergencies"] == []
        assert seen["stopped"] == 0x40, "605Ah = 2 as from the factory: the ramp ends in switch on disabled"
        assert group.drives.stages[NODE - 1] is Stage.SWITCH_ON_DISABLED
        assert group.drives.braked.all()
        moved = plant.position - start
        assert moved[NODE - 1] == pytest.approx(0.6, abs=1e-3)
        assert not np.delete(moved, NODE - 1).any()
    finally:
        group.close()
        server.close()
