"""Register maps as data: blocks of named fields, packed to and unpacked from registers (big-endian bytes)."""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

from docking.types import FaultKind

_CODES = {"u16": "H", "i16": "h", "u32": "I", "i32": "i"}


def _compiled(fields: Sequence[str]) -> tuple[tuple[str, ...], struct.Struct]:
    names, codes = [], []
    for field in fields:
        name, kind = field.split(":")
        names.append(name)
        codes.append(f"{kind[3:]}s" if kind.startswith("str") else _CODES[kind])
    return tuple(names), struct.Struct(">" + "".join(codes))


class Block:
    """A run of registers: `fields` once, then `axis_fields` for each axis."""

    def __init__(self, address: int, fields: Sequence[str], axis_fields: Sequence[str], axes: int) -> None:
        self.address = address
        self._names, self._head = _compiled(fields)
        self._texts = tuple(field.split(":")[0] for field in fields if ":str" in field)
        _, self._axis = _compiled(axis_fields)
        self._axes = axes if axis_fields else 0
        self.count = (self._head.size + self._axes * self._axis.size) // 2

    def unpack(self, data: bytes) -> tuple[dict[str, Any], list[tuple[int, ...]]]:
        """(fields by name, one tuple of axis fields an axis) from `count` registers; text loses its padding."""
        head = dict(zip(self._names, self._head.unpack_from(data), strict=True))
        for name in self._texts:
            head[name] = head[name].rstrip(b"\0 ").decode("ascii", "replace")
        size, start = self._axis.size, self._head.size
        return head, [self._axis.unpack_from(data, start + i * size) for i in range(self._axes)]

    def pack(self, *values: int) -> bytes:
        """The fields of the head, in the order of the map, as bytes."""
        return self._head.pack(*values)


class RegisterMap:
    """One file of `drivers/maps`: `blocks`, and the tables of numbers and words as read."""

    def __init__(self, name: str) -> None:
        text = resources.files("drivers.maps").joinpath(f"{name}.toml").read_text("utf-8")
        table = tomllib.loads(text)
        self.version: int = table["version"]
        self.axes: int = table["axes"]
        self.magic: int = table["magic"]
        self.scale: dict[str, int] = table["scale"]
        self.flags: dict[str, int] = table["flags"]
        self.commands: dict[str, int] = table["commands"]
        self.states: dict[int, str] = {code: name for name, code in table["states"].items()}
        self.consequences: frozenset[int] = frozenset(table["consequences"]["faults"])
        self._kinds = {int(code): FaultKind[name] for code, name in table["kinds"].items()}
        self._faults: dict[str, str] = table["faults"]
        self._rejects: dict[str, str] = table["rejects"]
        self.blocks = {
            key: Block(block["address"], block["fields"], block.get("axis_fields", ()), self.axes)
            for key, block in table["blocks"].items()
        }

    def fault(self, code: int) -> str:
        """Words for a fault code."""
        return self._faults.get(str(code), f"fault {code}, not in the map")

    def kind(self, code: int) -> FaultKind:
        """What a fault code is about."""
        return self._kinds.get(code, FaultKind.DRIVE_FAULT)

    def reject(self, code: int) -> str:
        """Words for a rejected segment or command."""
        return self._rejects.get(str(code), f"code {code}, not in the map")


@cache
def load_map(name: str) -> RegisterMap:
    """The register map `name` of drivers/maps. KeyError or FileNotFoundError mark a broken installation."""
    return RegisterMap(name)
