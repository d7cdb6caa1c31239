"""python-canopen's local nodes, slaves written by others, under the product's master: twelve dressed as CSP drives."""

from __future__ import annotations

import asyncio
import struct
from typing import Any, ClassVar

import can
import pytest

from drivers.links.can_bus import CanBusLink
from tests.support.can_bench import assert_followed, follow

canopen = pytest.importorskip("canopen")
pytestmark = [pytest.mark.peer, pytest.mark.wires]

CHANNEL = "canopen-slaves"
FORCE_EVERY = 10


class PeerDrive:
    """A local node with the least that makes a CiA 402 drive of it; the brake is bit 14, as in the product's map.

    The library serves SDO, NMT, heartbeat and the mapping of PDOs; SYNC and the states of the drive are made here.
    """

    RECORDS: ClassVar = {
        0x1016: ("u8", "u32"), 0x1018: ("u8", "u32", "u32", "u32", "u32"), 0x1029: ("u8", "u8"), 0x2100: ("u8", "i16"),
        0x607D: ("u8", "i32", "i32"), 0x60C2: ("u8", "u8", "i8"),
    }  # fmt: skip
    VARIABLES: ClassVar = {
        0x1000: "u32", 0x1005: "u32", 0x1006: "u32", 0x1008: "text", 0x1014: "u32", 0x1017: "u16", 0x6007: "i16",
        0x6040: "u16", 0x6041: "u16", 0x605A: "i16", 0x605D: "i16", 0x605E: "i16", 0x6060: "i8", 0x6061: "i8",
        0x6064: "i32", 0x6065: "u32", 0x6066: "u16", 0x607A: "i32", 0x607E: "u8", 0x6085: "u32", 0x60F4: "i16",
        0x6502: "u32",
    }  # fmt: skip
    NEXT: ClassVar = {
        (0x40, 0x06): 0x21, (0x21, 0x07): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x07): 0x23, (0x23, 0x06): 0x21,
        (0x21, 0x00): 0x40, (0x23, 0x00): 0x40, (0x27, 0x00): 0x40, (0x27, 0x02): 0x07, (0x07, 0x0F): 0x27,
    }  # fmt: skip

    def __init__(self, network: Any, number: int, start_counts: int) -> None:
        self.node = canopen.LocalNode(number, self.dictionary(number))
        network.add_node(self.node)
        self.node.nmt.state = "PRE-OPERATIONAL"
        self.stage, self.counts, self.syncs = 0x40, start_counts, 0
        self.mapped = False
        self.node.add_read_callback(self.answer)
        network.subscribe(0, self.told)
        network.subscribe(0x80, self.synced)

    @classmethod
    def dictionary(cls, number: int) -> Any:
        from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes

        kinds = {
            "u8": datatypes.UNSIGNED8, "u16": datatypes.UNSIGNED16, "u32": datatypes.UNSIGNED32,
            "i8": datatypes.INTEGER8, "i16": datatypes.INTEGER16, "i32": datatypes.INTEGER32,
            "text": datatypes.VISIBLE_STRING,
        }  # fmt: skip
        factory = {
            (0x1000, 0): 0x0002_0192, (0x1008, 0): "canopen slave", (0x1018, 1): 0x99, (0x1018, 4): 2000 + number,
            (0x6502, 0): 1 << 7,
        }  # fmt: skip

        def variable(index: int, sub: int, kind: str) -> Any:
            made = ODVariable(f"{index:X}:{sub}", index, sub)
            made.data_type = kinds[kind]
            made.default = factory.get((index, sub), "" if kind == "text" else 0)
            return made

        records = dict(cls.RECORDS)
        for base in (0x1400, 0x1800):
            for k in range(4):
                records[base + k], records[base + 0x200 + k] = ("u8", "u32", "u8"), ("u8", *["u32"] * 8)
                factory[base + k, 1] = 0x8000_0000
        od = ObjectDictionary()
        for index, kind in cls.VARIABLES.items():
            od.add_object(variable(index, 0, kind))
        for index, subs in records.items():
            record = ODRecord(f"{index:X}", index)
            for sub, kind in enumerate(subs):
                record.add_member(variable(index, sub, kind))
            od.add_object(record)
        return od

    def answer(self, *, index: int, **_: Any) -> int | None:
        """What SDO reads of the objects that live; the others are as they were written."""
        if index == 0x6061:
            return int(self.node.sdo[0x6060].raw)
        return {0x6041: self.statusword, 0x6064: self.counts}.get(index)

    @property
    def statusword(self) -> int:
        follows, braked = self.stage == 0x27, self.stage not in (0x27, 0x07)
        return self.stage | 0x0210 | follows << 12 | braked << 14

    def told(self, *_: Any) -> None:
        """An NMT command, which the node has obeyed: its PDOs are as they are mapped now."""
        if self.node.nmt.state == "OPERATIONAL" and not self.mapped:
            self.node.rpdo.read()
            self.node.tpdo.read()
            self.mapped = True

    def synced(self, *_: Any) -> None:
        if self.node.nmt.state != "OPERATIONAL":
            return
        self.syncs += 1
        orders, report, force = self.node.rpdo[1], self.node.tpdo[1], self.node.tpdo[2]
        if orders.is_received:
            self.stage = self.NEXT.get((self.stage, orders[0x6040].raw), self.stage)
            if self.stage == 0x27:
                self.counts = orders[0x607A].raw
        report[0x6041].raw, report[0x6064].raw = self.statusword, self.counts
        report.transmit()
        if self.syncs % FORCE_EVERY == 0:
            force.transmit()


async def test_the_nodes_of_python_canopen_are_brought_up_enabled_and_follow() -> None:
    network = canopen.Network(can.Bus(interface="virtual", channel=CHANNEL))
    network.notifier = can.Notifier(network.bus, network.listeners, 0.05, asyncio.get_running_loop())
    drives = [PeerDrive(network, number, 1000 * number) for number in range(1, 13)]
    try:
        feedback, path, identities = await follow(CanBusLink("virtual", CHANNEL, 1_000_000), 60)
        assert identities[6] == "canopen slave 00000000h 2007"
        assert_followed(feedback, path)
        assert all(drive.stage == 0x40 for drive in drives)
        kept = drives[3].node.data_store
        assert kept[0x1016][1] == struct.pack("<I", 127 << 16 | 280)
        assert kept[0x607D][1] == struct.pack("<i", -250_000)
        assert kept[0x6085][0] == struct.pack("<I", 2_000_000)
    finally:
        for drive in drives:
            drive.node.nmt.stop_heartbeat()
        network.disconnect()
