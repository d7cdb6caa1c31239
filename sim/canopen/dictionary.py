"""The object dictionary of one simulated drive: types, access, ranges, and the rules for changing a PDO mapping."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from sim.canopen.settings import DriveSettings

INVALID: Final = 0x8000_0000
CYCLIC_RPDO: Final = (0x6040_0010, 0x607A_0020, 0x6060_0008)
INTERPOLATION_RPDO: Final = (0x6040_0010, 0x60C1_0120, 0x6060_0008)
FORCE_RPDO: Final = (0x6040_0010, 0x6071_0010, 0x6060_0008)
CYCLIC_TPDO: Final = (0x6041_0010, 0x6064_0020, 0x60F4_0010)
FORCE_TPDO: Final = (0x2100_0110,)
_LAYOUTS: Final = {0x1600: (CYCLIC_RPDO, INTERPOLATION_RPDO, FORCE_RPDO), 0x1A00: (CYCLIC_TPDO,), 0x1A01: (FORCE_TPDO,)}
_FACTORY: Final = {
    0x1400: (0x200, (0x6040_0010,)),
    0x1401: (0x300, (0x6040_0010, 0x6060_0008)),
    0x1402: (0x400, (0x6040_0010, 0x607A_0020)),
    0x1403: (0x500 | INVALID, (0x6040_0010,)),
    0x1800: (0x180, (0x6041_0010,)),
    0x1801: (0x280 | INVALID, (0x6041_0010,)),
    0x1802: (0x380 | INVALID, (0x6041_0010,)),
    0x1803: (0x480 | INVALID, (0x6041_0010,)),
}
"""Communication object -> COB-ID base and mapping as the drive leaves the factory: not what a controller wants."""

_TRANSMISSION: Final = {0x1400: (0, 240), 0x1800: (1, 1), 0x1801: (10, 10)}
"""Transmission types that these drives support: synchronous ones only."""

_SPANS: Final = {
    "B": (0, 0xFF),
    "b": (-0x80, 0x7F),
    "H": (0, 0xFFFF),
    "h": (-0x8000, 0x7FFF),
    "I": (0, 0xFFFF_FFFF),
    "i": (-0x8000_0000, 0x7FFF_FFFF),
}

RATED_TORQUE_MNM: Final = 32_000
NEWTON_PER_PER_MILLE: Final = 20.0
"""Force at the ball of one thousandth of the rated torque, through gear and screw: 20 kN at 32 Nm."""
MM_PER_REVOLUTION: Final = 10.0
ENCODER_INCREMENTS: Final = 131_072

READ_ONLY: Final = 0x0601_0002
NO_OBJECT: Final = 0x0602_0000
NOT_MAPPABLE: Final = 0x0604_0041
WRONG_LENGTH: Final = 0x0607_0010
TOO_LONG: Final = 0x0607_0012
TOO_SHORT: Final = 0x0607_0013
NO_SUB: Final = 0x0609_0011
OUT_OF_RANGE: Final = 0x0609_0030
WRONG_STATE: Final = 0x0800_0022


class Abort(Exception):
    """An access that the drive refuses; `code` is the SDO abort code."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"{code:08X}h")


@dataclass(frozen=True)
class Entry:
    """One object: struct letter (`s` = text), value, whether it may be written, its range where it is narrower."""

    kind: str
    value: int | bytes
    writable: bool = False
    low: int | None = None
    high: int | None = None


class Dictionary:
    """Objects of one node. `live(index, sub)` answers for values that change by themselves, None for the rest;
    `changed(index, sub, value)` hears of every write after it was stored; `operational()` guards the PDO set-up.
    Faults: writes to `refused` objects are aborted with their code, writes to `deaf` ones change nothing; reads of
    those in `lies` bring that value whatever is stored."""

    def __init__(
        self,
        node: int,
        settings: DriveSettings,
        live: Callable[[int, int], int | None],
        changed: Callable[[int, int, int], None],
        operational: Callable[[], bool],
    ) -> None:
        self.node = node
        self.refused: dict[tuple[int, int], int] = {}
        self.deaf: set[tuple[int, int]] = set()
        self.lies: dict[tuple[int, int], int] = {}
        self._live, self._changed, self._operational = live, changed, operational
        self._entries: dict[tuple[int, int], Entry] = {**_identity(node, settings), **_drive(settings), **_pdos(node)}

    def number(self, index: int, sub: int = 0) -> int:
        """An integer object's stored or live value. Raises Abort."""
        live = self._live(index, sub)
        if live is not None:
            return live
        value = self._find(index, sub).value
        if isinstance(value, bytes):
            raise Abort(WRONG_LENGTH)
        return value

    def read(self, index: int, sub: int) -> bytes:
        """The object as it travels. Raises Abort."""
        entry = self._find(index, sub)
        if isinstance(entry.value, bytes):
            return entry.value
        lie = self.lies.get((index, sub))
        return struct.pack("<" + entry.kind, self.number(index, sub) if lie is None else lie)

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Store what a master sends. Raises Abort."""
        entry = self._find(index, sub)
        if not entry.writable:
            raise Abort(READ_ONLY)
        if (index, sub) in self.refused:
            raise Abort(self.refused[index, sub])
        size = struct.calcsize("<" + entry.kind)
        if len(data) != size:
            raise Abort(TOO_LONG if len(data) > size else TOO_SHORT)
        value = int(struct.unpack("<" + entry.kind, data)[0])
        low, high = _SPANS[entry.kind]
        if not (low if entry.low is None else entry.low) <= value <= (high if entry.high is None else entry.high):
            raise Abort(OUT_OF_RANGE)
        if 0x1400 <= index < 0x1C00:
            self._check_pdo(index, sub, value)
        if (index, sub) in self.deaf:
            return
        self._entries[index, sub] = replace(entry, value=value)
        self._changed(index, sub, value)

    def mapped(self, communication: int, layout: tuple[int, ...]) -> bool:
        """True while the PDO is valid and carries this layout."""
        mapping = communication + 0x200
        count = self.number(mapping, 0)
        words = tuple(self.number(mapping, sub) for sub in range(1, count + 1))
        low, high = _TRANSMISSION[communication]
        timely = low <= self.number(communication, 2) <= high
        return timely and not self.number(communication, 1) & INVALID and words == layout

    def _find(self, index: int, sub: int) -> Entry:
        entry = self._entries.get((index, sub))
        if entry is None:
            known = any(key[0] == index for key in self._entries)
            raise Abort(NO_SUB if known else NO_OBJECT)
        return entry

    def _check_pdo(self, index: int, sub: int, value: int) -> None:
        """CiA 301: a PDO is switched off, its mapping emptied, filled, counted, and the PDO switched on again."""
        if self._operational():
            raise Abort(WRONG_STATE)
        if not index & 0x200:
            before = self.number(index, 1)
            if sub == 1 and not before & INVALID and not value & INVALID and before != value:
                raise Abort(OUT_OF_RANGE)
            low, high = _TRANSMISSION.get(index, (0, 255))
            if sub == 2 and not low <= value <= high:
                raise Abort(OUT_OF_RANGE)
            return
        if not self.number(index - 0x200, 1) & INVALID:
            raise Abort(WRONG_STATE)
        if sub > 0 and self.number(index, 0):
            raise Abort(WRONG_STATE)
        if sub == 0 and value:
            words = tuple(self.number(index, number) for number in range(1, value + 1))
            if words not in (*_LAYOUTS.get(index, ()), _FACTORY[index - 0x200][1]):
                raise Abort(NOT_MAPPABLE)


def _identity(node: int, settings: DriveSettings) -> dict[tuple[int, int], Entry]:
    return {
        (0x1000, 0): Entry("I", 0x0002_0192),
        (0x1001, 0): Entry("B", 0),
        (0x1005, 0): Entry("I", 0x80, True),
        (0x1006, 0): Entry("I", 0, True),
        (0x1008, 0): Entry("s", b"Simulated positioner drive"),
        (0x100A, 0): Entry("s", b"1.3.0"),
        (0x1014, 0): Entry("I", 0x80 + node, True),
        (0x1016, 0): Entry("B", 1),
        (0x1016, 1): Entry("I", 0, True),
        (0x1017, 0): Entry("H", 0, True),
        (0x1018, 0): Entry("B", 4),
        (0x1018, 1): Entry("I", settings.vendor),
        (0x1018, 2): Entry("I", settings.product),
        (0x1018, 3): Entry("I", settings.revision),
        (0x1018, 4): Entry("I", settings.first_serial + node),
        (0x1029, 0): Entry("B", 1),
        (0x1029, 1): Entry("B", 0, True, 0, 2),
    }


def _drive(settings: DriveSettings) -> dict[tuple[int, int], Entry]:
    return {
        (0x2100, 0): Entry("B", 1),
        (0x2100, 1): Entry("h", 0),
        (0x6007, 0): Entry("h", 1, True, 0, 3),
        (0x603F, 0): Entry("H", 0),
        (0x6040, 0): Entry("H", 0, True),
        (0x6041, 0): Entry("H", 0),
        (0x605A, 0): Entry("h", 2, True, 0, 8),
        (0x605D, 0): Entry("h", 1, True, 1, 4),
        (0x605E, 0): Entry("h", 2, True, 0, 4),
        (0x6060, 0): Entry("b", 0, True),
        (0x6061, 0): Entry("b", 0),
        (0x6064, 0): Entry("i", 0),
        (0x6065, 0): Entry("I", 0xFFFF_FFFF, True),
        (0x6066, 0): Entry("H", 0, True),
        (0x6071, 0): Entry("h", 0, True),
        (0x6072, 0): Entry("H", 1000, True),
        (0x6076, 0): Entry("I", RATED_TORQUE_MNM),
        (0x607A, 0): Entry("i", 0, True),
        (0x607C, 0): Entry("i", 0, True),
        (0x607D, 0): Entry("B", 2),
        (0x607D, 1): Entry("i", -0x8000_0000, True),
        (0x607D, 2): Entry("i", 0x7FFF_FFFF, True),
        (0x607E, 0): Entry("B", 0),
        (0x6080, 0): Entry("I", 6000, True),
        (0x6081, 0): Entry("I", 10_000, True),
        (0x6083, 0): Entry("I", 100_000, True, 1),
        (0x6084, 0): Entry("I", 100_000, True, 1),
        (0x6085, 0): Entry("I", 1_000_000, True, 1),
        (0x608F, 0): Entry("B", 2),
        (0x608F, 1): Entry("I", ENCODER_INCREMENTS),
        (0x608F, 2): Entry("I", 1),
        (0x6091, 0): Entry("B", 2),
        (0x6091, 1): Entry("I", 1),
        (0x6091, 2): Entry("I", 1),
        (0x6092, 0): Entry("B", 2),
        (0x6092, 1): Entry("I", 0),
        (0x6092, 2): Entry("I", 1),
        (0x6098, 0): Entry("b", 0, True, 0, 37),
        (0x6099, 0): Entry("B", 2),
        (0x6099, 1): Entry("I", 10_000, True, 1),
        (0x6099, 2): Entry("I", 1_000, True, 1),
        (0x609A, 0): Entry("I", 100_000, True, 1),
        (0x60C0, 0): Entry("h", 0, True, 0, 0),
        (0x60C1, 0): Entry("B", 1),
        (0x60C1, 1): Entry("i", 0, True),
        (0x60C2, 0): Entry("B", 2),
        (0x60C2, 1): Entry("B", 20, True, 1),
        (0x60C2, 2): Entry("b", -3, True, -6, 0),
        (0x60F4, 0): Entry("i", 0),
        (0x6502, 0): Entry("I", settings.supported_modes),
    }


def _pdos(node: int) -> dict[tuple[int, int], Entry]:
    entries: dict[tuple[int, int], Entry] = {}
    for index, (cob, words) in _FACTORY.items():
        entries[index, 0] = Entry("B", 2)
        entries[index, 1] = Entry("I", cob + node, True)
        entries[index, 2] = Entry("B", 255, True)
        entries[index + 0x200, 0] = Entry("B", len(words), True, 0, 8)
        for sub in range(1, 9):
            entries[index + 0x200, sub] = Entry("I", words[sub - 1] if sub <= len(words) else 0, True)
    return entries
