"""Loads the CANopen object maps of this folder: which object holds what, what is written, what the PDOs carry."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib import resources
from typing import Any

from docking.errors import ConfigInvalid, FileUnreadable

_BITS = {"u8": 8, "i8": 8, "u16": 16, "i16": 16, "u32": 32, "i32": 32, "text": 0}


@dataclass(frozen=True)
class ObjectEntry:
    """One object of a drive: address and type (`u8 i8 u16 i16 u32 i32 text`)."""

    name: str
    index: int
    sub: int
    type: str

    @property
    def bits(self) -> int:
        return _BITS[self.type]

    @property
    def label(self) -> str:
        """Address and name as a person reads it: `607Ah:00 target position`."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name.replace('_', ' ')}"


@dataclass(frozen=True)
class PdoEntry:
    """One PDO: communication and mapping objects, COB-ID base, transmission type, mapping words (index, sub, bits);
    `fields` are the names and types of what it carries."""

    name: str
    communication: int
    mapping: int
    cob: int
    transmission: int
    words: tuple[int, ...]
    fields: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class PositionMode:
    """One way of taking set-points: its bit in 6502h, its number for 6060h, the PDO of the set-points, what is added to
    the controlword once the drive is enabled, whether the drive rests until an edge tells it to go to its target
    instead of following one set-point a cycle, what is written besides."""

    name: str
    supported_mode_bit: int
    mode: int
    set_points: str
    enable_bits: int = 0
    rests: bool = False
    written: tuple[tuple[str, int | str], ...] = ()


@dataclass(frozen=True)
class ForceMode:
    """How axes that hold a force are set up: mode and its bit in 6502h, the rated torque that the drives must state,
    newtons at the ball in one unit of 6071h and 6072h, way of a revolution; limits in parts of the held force and of
    the axis's speed; how fast the force goes from what the axis carries to what it shall hold."""

    supported_mode_bit: int
    mode: int
    rated_torque_mnm: int
    newton_per_count: float
    mm_per_revolution: float
    max_force: float
    max_speed: float
    ramp_n_s: float
    written: tuple[tuple[str, int | str], ...]


@dataclass(frozen=True)
class HomingMode:
    """How axes find their zero: mode and its bit in 6502h, what starts and halts it in the controlword, the bits of the
    statusword that tell of it, what is written before."""

    supported_mode_bit: int
    mode: int
    start_bits: int
    halt_bits: int
    reached: int
    attained: int
    error: int
    written: tuple[tuple[str, int | str], ...]


@dataclass(frozen=True)
class ObjectMap:
    """A whole object map; `written` holds constants or `@quantity` texts in the order of writing, `proved` what must
    be read without having been written."""

    name: str
    device_profile: int
    position_modes: tuple[PositionMode, ...]
    host_node: int
    host_lost: int
    identity: dict[str, int]
    proved: dict[str, int]
    objects: dict[str, ObjectEntry]
    written: tuple[tuple[str, int | str], ...]
    following_window_factor: float
    pdos: dict[str, PdoEntry]
    pdos_off: tuple[tuple[int, int], ...]
    newton_per_count: float
    status_bits: dict[str, int]
    emergency: dict[str, str]
    abort: dict[str, str]
    force_mode: ForceMode
    homing: HomingMode

    def emergency_text(self, code: int) -> str:
        """The words of an emergency code: the longest matching beginning of its four digits."""
        digits = f"{code:04x}"
        for length in range(4, 0, -1):
            text = self.emergency.get(digits[:length])
            if text is not None:
                return text
        return "unknown code"

    def abort_text(self, code: int) -> str:
        """The words of an SDO abort code."""
        return self.abort.get(f"{code:08x}", "unknown abort code")


def _pdo(name: str, raw: dict[str, Any], objects: dict[str, ObjectEntry]) -> PdoEntry:
    words, fields = [], []
    for item in raw["content"]:
        entry = objects[item if isinstance(item, str) else item["object"]]
        bits = entry.bits if isinstance(item, str) else int(item["bits"])
        words.append(entry.index << 16 | entry.sub << 8 | bits)
        fields.append((entry.name, f"{entry.type[0]}{bits}"))
    head = raw["communication"], raw["mapping"], raw["cob"], raw["transmission"]
    return PdoEntry(name, *head, tuple(words), tuple(fields))


def _position_mode(raw: dict[str, Any]) -> PositionMode:
    return PositionMode(**{**raw, "written": tuple(raw.get("written", {}).items())})


def parse_object_map(raw: dict[str, Any]) -> ObjectMap:
    """Build an object map from its parsed TOML; KeyError or TypeError where the data is not of this form."""
    objects = {name: ObjectEntry(name, **entry) for name, entry in raw["objects"].items()}
    force_mode = dict(raw["force_mode"])
    force_written: dict[str, int | str] = force_mode.pop("written")
    homing = dict(raw["homing"])
    homing_written: dict[str, int | str] = homing.pop("written")
    of_modes = [name for mode in raw["position_modes"] for name in mode.get("written", {})]
    named = (*raw["written"], *raw["proved"], *force_written, *homing_written, *of_modes)
    unknown = [name for name in named if name not in objects]
    if unknown or any(entry.type not in _BITS for entry in objects.values()):
        raise KeyError(f"unknown object or type {unknown}")
    return ObjectMap(
        name=raw["name"],
        device_profile=raw["device_profile"],
        position_modes=tuple(_position_mode(entry) for entry in raw["position_modes"]),
        host_node=raw["host_node"],
        host_lost=raw["host_lost"],
        identity=dict(raw["identity"]),
        proved=dict(raw["proved"]),
        objects=objects,
        written=tuple(raw["written"].items()),
        following_window_factor=float(raw["margins"]["following_window"]),
        pdos={name: _pdo(name, entry, objects) for name, entry in raw["pdo"].items()},
        pdos_off=tuple((entry["communication"], entry["cob"]) for entry in raw["pdo_off"].values()),
        newton_per_count=float(raw["force"]["newton_per_count"]),
        status_bits=dict(raw["status_bits"]),
        emergency=dict(raw["emergency"]),
        abort=dict(raw["abort"]),
        force_mode=ForceMode(**force_mode, written=tuple(force_written.items())),
        homing=HomingMode(**homing, written=tuple(homing_written.items())),
    )


def load_object_map(name: str) -> ObjectMap:
    """Load `drivers/maps/NAME.toml`. Raises FileUnreadable or ConfigInvalid."""
    where = f"drivers/maps/{name}.toml"
    try:
        text = resources.files("drivers.maps").joinpath(f"{name}.toml").read_text("utf-8")
        raw = tomllib.loads(text)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise FileUnreadable(where, str(error)) from error
    try:
        return parse_object_map(raw)
    except (KeyError, TypeError) as error:
        raise ConfigInvalid(where, (f"not an object map: {error}",)) from error
