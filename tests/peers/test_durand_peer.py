"""durand, a CANopen slave written by others, under the product's master: twelve of its nodes dressed as CSP drives."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from typing import Any, ClassVar

import can
import pytest

from drivers.links.can_bus import CanBusLink
from tests.support.can_bench import assert_followed, follow

durand = pytest.importorskip("durand")
pytestmark = [pytest.mark.peer, pytest.mark.wires]

CHANNEL = "durand-peer"


class SharedNetwork:
    """durand's network interface for many nodes on one bus: several callbacks may share an identifier."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.bus = can.Bus(interface="virtual", channel=CHANNEL)
        self.listeners: dict[int, list[Callable[[int, bytes], None]]] = {}
        self.notifier = can.Notifier(self.bus, [self._received], 0.05, loop)

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self.listeners.setdefault(cob_id, []).append(callback)

    def remove_subscription(self, cob_id: int, callback: Callable[[int, bytes], None] | None = None) -> None:
        kept = [known for known in self.listeners.get(cob_id, []) if callback is not None and known != callback]
        self.listeners[cob_id] = kept

    def send(self, cob_id: int, msg: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=cob_id, data=msg, is_extended_id=False))

    def stop(self) -> None:
        self.notifier.stop()
        self.bus.shutdown()

    def _received(self, message: can.Message) -> None:
        for callback in list(self.listeners.get(message.arbitration_id, [])):
            callback(message.arbitration_id, bytes(message.data))


class PeerDrive:
    """A durand node with the least that makes a CiA 402 drive of it; the brake is bit 14, as in the product's map."""

    RECORDS = (
        (0x1016, {1: "UNSIGNED32"}),
        (0x1029, {1: "UNSIGNED8"}),
        (0x2100, {1: "INTEGER16"}),
        (0x607D, {1: "INTEGER32", 2: "INTEGER32"}),
        (0x60C2, {1: "UNSIGNED8", 2: "INTEGER8"}),
    )
    VARIABLES = (
        (0x1006, "UNSIGNED32"), (0x6007, "INTEGER16"), (0x6040, "UNSIGNED16"), (0x6041, "UNSIGNED16"),
        (0x605A, "INTEGER16"), (0x605D, "INTEGER16"), (0x605E, "INTEGER16"), (0x6060, "INTEGER8"),
        (0x6061, "INTEGER8"), (0x6064, "INTEGER32"), (0x6065, "UNSIGNED32"), (0x6066, "UNSIGNED16"),
        (0x607A, "INTEGER32"), (0x607E, "UNSIGNED8"), (0x6085, "UNSIGNED32"), (0x60F4, "INTEGER16"),
        (0x6502, "UNSIGNED32"),
    )  # fmt: skip
    NEXT: ClassVar = {
        (0x40, 0x06): 0x21, (0x21, 0x07): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x07): 0x23, (0x23, 0x06): 0x21,
        (0x21, 0x00): 0x40, (0x23, 0x00): 0x40, (0x27, 0x00): 0x40, (0x27, 0x02): 0x07, (0x07, 0x0F): 0x27,
    }  # fmt: skip

    def __init__(self, network: SharedNetwork, number: int, start_counts: int) -> None:
        from durand.datatypes import DatatypeEnum
        from durand.object_dictionary import Record, Variable

        self.node = durand.Node(network, number, None, durand.node.NodeCapabilities(1, 4, 4))
        self.od: Any = self.node.object_dictionary
        for index, subs in self.RECORDS:
            record = Record()
            for sub, kind in subs.items():
                record[sub] = Variable(DatatypeEnum[kind], "rw", 0)
            self.od[index] = record
        for index, kind in self.VARIABLES:
            self.od[index] = Variable(DatatypeEnum[kind], "rw", 0)
        self.od.write(0x1000, 0, 0x0002_0192)
        self.od.write(0x1018, 1, 0x77)
        self.od.write(0x1018, 4, 1000 + number)
        self.od.write(0x1008, 0, b"durand slave")
        self.od.write(0x6502, 0, 1 << 7)
        self.od.write(0x6064, 0, start_counts)
        self.stage = 0x40
        self.report()
        self.od.update_callbacks[(0x6040, 0)].add(self.control)
        self.od.update_callbacks[(0x6060, 0)].add(lambda value: self.od.write(0x6061, 0, value))
        self.od.update_callbacks[(0x607A, 0)].add(self.move)

    def control(self, word: int) -> None:
        self.stage = self.NEXT.get((self.stage, word), self.stage)
        self.report()

    def report(self) -> None:
        enabled = self.stage in (0x27, 0x07)
        follows, braked = self.stage == 0x27, not enabled
        self.od.write(0x6041, 0, self.stage | 0x0210 | follows << 12 | braked << 14)

    def move(self, counts: int) -> None:
        if self.stage == 0x27:
            self.od.write(0x6064, 0, counts)


async def test_durand_slaves_are_brought_up_enabled_and_follow() -> None:
    from durand.scheduler import AsyncScheduler, set_scheduler

    loop = asyncio.get_running_loop()
    set_scheduler(AsyncScheduler(loop))
    network = SharedNetwork(loop)
    drives = [PeerDrive(network, number, 1000 * number) for number in range(1, 13)]
    try:
        feedback, path, identities = await follow(CanBusLink("virtual", CHANNEL, 1_000_000), 60)
        assert identities[6] == "durand slave 00000000h 1007"
        assert_followed(feedback, path)
        assert all(drive.stage == 0x40 for drive in drives)
        od = drives[3].od
        assert od.read(0x1016, 1) == 127 << 16 | 280
        assert struct.pack("<i", od.read(0x607D, 1)) == struct.pack("<i", -250_000)
        assert od.read(0x6085, 0) == 2_000_000
    finally:
        for drive in drives:
            drive.od.write(0x1017, 0, 0)
        network.stop()
