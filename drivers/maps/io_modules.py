"""Loads the maps of I/O modules: what a module has, where it stands, how it is told to send."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from docking.errors import ConfigInvalid, FileUnreadable
from drivers.maps.objects import ObjectEntry
from drivers.register_map import Block


@dataclass(frozen=True)
class InputPdo:
    """One TPDO of inputs: communication and mapping objects, COB-ID base, transmission type, first object and width."""

    name: str
    communication: int
    mapping: int
    cob: int
    transmission: int
    object: int
    bits: int

    def words(self, count: int) -> tuple[int, ...]:
        """Mapping entries of the first `count` inputs or blocks."""
        return tuple(self.object << 16 | sub << 8 | self.bits for sub in range(1, count + 1))


@dataclass(frozen=True)
class CanIoMap:
    """A CiA 401 module; `written` in the order of writing."""

    device_profile: int
    digital_blocks: int
    analogue_inputs: int
    analogue_slower: int
    broken: int
    identity: dict[str, int]
    objects: dict[str, ObjectEntry]
    written: tuple[tuple[str, int], ...]
    pdos: dict[str, InputPdo]


@dataclass(frozen=True)
class ModbusIoMap:
    """A Modbus I/O module: addresses and counts of its inputs, the block that tells what it is."""

    version: int
    digital_inputs: int
    discrete_at: int
    analogue_inputs: int
    analogue_at: int
    alive_at: int
    broken: int
    identity: Block
    magic: int


@cache
def load_can_io(name: str) -> CanIoMap:
    """The CiA 401 map `drivers/maps/NAME.toml`. Raises FileUnreadable, ConfigInvalid."""
    raw = _read(name)
    try:
        return CanIoMap(
            device_profile=raw["device_profile"],
            digital_blocks=raw["digital_blocks"],
            analogue_inputs=raw["analogue_inputs"],
            analogue_slower=raw["analogue_slower"],
            broken=raw["broken"],
            identity=dict(raw["identity"]),
            objects={key: ObjectEntry(key, **entry) for key, entry in raw["objects"].items()},
            written=tuple(raw["written"].items()),
            pdos={key: InputPdo(key, **entry) for key, entry in raw["pdo"].items()},
        )
    except (KeyError, TypeError) as error:
        raise ConfigInvalid(_where(name), (f"not a map of a CiA 401 module: {error}",)) from error


@cache
def load_modbus_io(name: str) -> ModbusIoMap:
    """The Modbus I/O map `drivers/maps/NAME.toml`. Raises FileUnreadable, ConfigInvalid."""
    raw = _read(name)
    try:
        identity = raw["identity"]
        return ModbusIoMap(
            version=raw["version"],
            digital_inputs=raw["digital_inputs"],
            discrete_at=raw["discrete_at"],
            analogue_inputs=raw["analogue_inputs"],
            analogue_at=raw["analogue_at"],
            alive_at=raw["alive_at"],
            broken=raw["broken"],
            identity=Block(identity["address"], identity["fields"], (), 0),
            magic=identity["magic"],
        )
    except (KeyError, TypeError) as error:
        raise ConfigInvalid(_where(name), (f"not a map of a Modbus I/O module: {error}",)) from error


def _where(name: str) -> str:
    return f"drivers/maps/{name}.toml"


def _read(name: str) -> dict[str, Any]:
    try:
        text = resources.files("drivers.maps").joinpath(f"{name}.toml").read_text("utf-8")
        return tomllib.loads(text)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise FileUnreadable(_where(name), str(error)) from error
