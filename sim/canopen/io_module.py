"""A simulated CANopen I/O module (CiA 401): contacts and analogue inputs by event-driven TPDOs.

Written down apart from the controller's map: 16 contacts in two bytes, 4 analogue inputs of 16 bits. Out of the factory
both TPDOs are off and the analogue interrupts are disabled.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from typing import Final

from sim.canopen.dictionary import (
    INVALID,
    NO_OBJECT,
    NO_SUB,
    OUT_OF_RANGE,
    READ_ONLY,
    TOO_LONG,
    TOO_SHORT,
    WRONG_STATE,
    Abort,
    Entry,
)
from sim.canopen.node import OPERATIONAL, PRE_OPERATIONAL, STOPPED
from sim.canopen.sdo_server import SdoServer
from sim.input_world import InputWorld
from sim.wires.can_frames import CanEnd, CanFrame

CONTACTS: Final = 16
ANALOGUE: Final = 4
_MAPPED: Final = {
    0x1A00: tuple(0x6000_0008 | sub << 8 for sub in (1, 2)),
    0x1A01: tuple(0x6401_0010 | sub << 8 for sub in (1, 2, 3, 4)),
}
_INPUTS: Final = {0x6000: CONTACTS // 8, 0x6401: ANALOGUE}
"""Objects that are the inputs themselves, and how many sub-indices of them."""
_COBS: Final = {0x1800: 0x180, 0x1801: 0x280}


class IoDictionary:
    """Objects of the module; `contacts()` and `counts()` are its inputs now, `changed()` is called after a write."""

    def __init__(self, node: int, module: IoModule) -> None:
        self._module = module
        self._entries = _factory(node)

    def number(self, index: int, sub: int = 0) -> int:
        """An integer object."""
        return int(struct.unpack("<" + self._find(index, sub).kind, self.read(index, sub))[0])

    def read(self, index: int, sub: int) -> bytes:
        """The object as it travels. Raises Abort."""
        if index == 0x6000 and 1 <= sub <= _INPUTS[index]:
            return self._module.contacts()[sub - 1 : sub]
        if index == 0x6401 and 1 <= sub <= _INPUTS[index]:
            return struct.pack("<h", self._module.counts()[sub - 1])
        entry = self._find(index, sub)
        return entry.value if isinstance(entry.value, bytes) else struct.pack("<" + entry.kind, entry.value)

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Store what a master sends. Raises Abort."""
        if 1 <= sub <= _INPUTS.get(index, 0):
            raise Abort(READ_ONLY)
        entry = self._find(index, sub)
        if not entry.writable:
            raise Abort(READ_ONLY)
        size = struct.calcsize("<" + entry.kind)
        if len(data) != size:
            raise Abort(TOO_LONG if len(data) > size else TOO_SHORT)
        value = int(struct.unpack("<" + entry.kind, data)[0])
        if entry.high is not None and not (entry.low or 0) <= value <= entry.high:
            raise Abort(OUT_OF_RANGE)
        self._check_pdo(index, sub, value)
        self._entries[index, sub] = Entry(entry.kind, value, True, entry.low, entry.high)
        self._module.changed(index)

    def sends(self, communication: int) -> bool:
        """True while a TPDO is on and maps what this module can send, event-driven."""
        mapping = communication + 0x200
        words = tuple(self.number(mapping, sub) for sub in range(1, self.number(mapping) + 1))
        on = not self.number(communication, 1) & INVALID
        return on and self.number(communication, 2) >= 254 and words == _MAPPED[mapping]

    def _find(self, index: int, sub: int) -> Entry:
        entry = self._entries.get((index, sub))
        if entry is None:
            raise Abort(NO_SUB if any(key[0] == index for key in self._entries) else NO_OBJECT)
        return entry

    def _check_pdo(self, index: int, sub: int, value: int) -> None:
        """CiA 301: a PDO is described while it is off, in pre-operational."""
        if not 0x1800 <= index <= 0x1A01:
            return
        if self._module.state == OPERATIONAL:
            raise Abort(WRONG_STATE)
        if index in _MAPPED:
            off = self.number(index - 0x200, 1) & INVALID
            if not off or (sub and self.number(index)):
                raise Abort(WRONG_STATE)


class IoModule:
    """One node on the bus. `muted`: nothing of it is heard."""

    def __init__(self, name: str, node: int, world: InputWorld, link: CanEnd, loop: asyncio.AbstractEventLoop) -> None:
        self.name, self.node = name, node
        self._world, self._link, self._loop = world, link, loop
        self.state = PRE_OPERATIONAL
        self._timers: dict[int, asyncio.TimerHandle] = {}
        self.forget()
        world.listeners.append(self._contacts_changed)

    def forget(self) -> None:
        """Back to the factory's objects."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers = {}
        self._dictionary = IoDictionary(self.node, self)
        self._server = SdoServer(self._dictionary)
        self._sent = b""

    def start(self) -> None:
        """Power up."""
        self._link.on_frames = self._on_frames
        self._boot()

    def restart(self) -> None:
        """The module resets by itself."""
        self.forget()
        self._boot()

    def close(self) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._timers = {}

    def contacts(self) -> bytes:
        return self._world.contacts(self.name, CONTACTS)

    def counts(self) -> tuple[int, ...]:
        return self._world.counts(self.name, ANALOGUE)

    def changed(self, index: int) -> None:
        """A master has written an object."""
        if index == 0x1017:
            self._arm(index, self._beat, self._dictionary.number(0x1017))

    # frames ------------------------------------------------------------------------------------------------------
    def _on_frames(self, batch: list[CanFrame]) -> None:
        for cob, data in batch:
            if cob == 0x600 + self.node and self.state != STOPPED and self.name not in self._world.silent:
                answer = self._server.answer(data)
                if answer is not None:
                    self._send(0x580, answer)
            elif cob == 0 and len(data) == 2 and data[1] in (0, self.node):
                self._command(data[0])

    def _command(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.restart()
        elif command in (0x01, 0x02, 0x80):
            self.state = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}[command]
            if self.state == OPERATIONAL:
                self._send_contacts()
                self._send_counts()

    def _boot(self) -> None:
        self.state = PRE_OPERATIONAL
        self._send(0x700, b"\0")

    def _beat(self) -> None:
        self._send(0x700, bytes((self.state,)))
        self._arm(0x1017, self._beat, self._dictionary.number(0x1017))

    def _contacts_changed(self) -> None:
        if self.contacts() != self._sent and self._dictionary.number(0x6005):
            self._send_contacts()

    def _send_contacts(self) -> None:
        if self.state == OPERATIONAL and self._dictionary.sends(0x1800):
            self._sent = self.contacts()
            self._send(0x180, self._sent)
            self._arm(0x1800, self._send_contacts, self._dictionary.number(0x1800, 5))

    def _send_counts(self) -> None:
        if self.state == OPERATIONAL and self._dictionary.sends(0x1801) and self._dictionary.number(0x6423):
            self._send(0x280, struct.pack(f"<{ANALOGUE}h", *self.counts()))
            self._arm(0x1801, self._send_counts, self._dictionary.number(0x1801, 5))

    def _arm(self, key: int, call: Callable[[], None], ms: int) -> None:
        if key in self._timers:
            self._timers.pop(key).cancel()
        if ms:
            self._timers[key] = self._loop.call_at(self._loop.time() + ms * 1e-3, call)

    def _send(self, base: int, data: bytes) -> None:
        if self.name not in self._world.silent:
            self._link.send([(base + self.node, data)])


def _factory(node: int) -> dict[tuple[int, int], Entry]:
    entries = {
        (0x1000, 0): Entry("I", 0x0005_0191),
        (0x1001, 0): Entry("B", 0),
        (0x1008, 0): Entry("s", b"Simulated I/O module"),
        (0x100A, 0): Entry("s", b"2.1"),
        (0x1017, 0): Entry("H", 0, True),
        (0x1018, 0): Entry("B", 4),
        (0x1018, 1): Entry("I", 0x0000_05D0),
        (0x1018, 2): Entry("I", 0x0401_1604),
        (0x1018, 3): Entry("I", 0x0002_0001),
        (0x1018, 4): Entry("I", 401_000 + node),
        (0x6000, 0): Entry("B", CONTACTS // 8),
        (0x6005, 0): Entry("B", 1, True, 0, 1),
        (0x6401, 0): Entry("B", ANALOGUE),
        (0x6423, 0): Entry("B", 0, True, 0, 1),
    }
    for communication, base in _COBS.items():
        mapping = communication + 0x200
        entries[communication, 0] = Entry("B", 5)
        entries[communication, 1] = Entry("I", (base + node) | INVALID, True)
        entries[communication, 2] = Entry("B", 255, True, 254, 255)
        entries[communication, 5] = Entry("H", 0, True)
        entries[mapping, 0] = Entry("B", 0, True, 0, len(_MAPPED[mapping]))
        for sub in range(1, len(_MAPPED[mapping]) + 1):
            entries[mapping, sub] = Entry("I", 0, True)
    return entries
