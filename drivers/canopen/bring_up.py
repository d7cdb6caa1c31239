"""Bring-up of one drive by SDO: identity, written objects and PDO mapping, each read back; a mismatch stops it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from docking.config.cell import CanBus, LimitsConfig
from docking.errors import ConfigInvalid, DeviceRefused, ReadBackMismatch
from docking.ports import CanFrame
from docking.types import Identity
from drivers.canopen import codec
from drivers.canopen.identity import DriveProof
from drivers.canopen.nodes import AxisNode
from drivers.canopen.sdo import SdoClient
from drivers.maps.objects import ForceMode, ObjectEntry, ObjectMap, PdoEntry, PositionMode

_MODE_S = 0.5
_NO_SUCH_OBJECT = "06020000h"
_COB_MASK = codec.COB_INVALID | 0x7FF


def interpolation_period(cycle_s: float) -> tuple[int, int]:
    """60C2h: (value 1..255, exponent of ten) whose product is exactly the cycle. Raises ConfigInvalid."""
    for exponent in (-2, -3, -4, -5, -6):
        value = cycle_s / 10.0**exponent
        if 1.0 <= round(value) <= 255.0 and abs(value - round(value)) <= 1e-6 * value:
            return round(value), exponent
    raise ConfigInvalid("bus.cycle_s", (f"{cycle_s} s cannot be told to a drive exactly (60C2h)",))


def quantities(node: AxisNode, bus: CanBus, limits: LimitsConfig, omap: ObjectMap) -> dict[str, int]:
    """The `@` quantities of the object map for one axis, in the drive's units (counts, ms, us)."""
    counts, axis = bus.counts_per_mm, node.axis
    value, exponent = interpolation_period(bus.cycle_s)
    window_mm = omap.following_window_factor * limits.following_error_vmax_mm
    return {
        "cycle_us": round(bus.cycle_s * 1e6),
        "emergency_cob": codec.COB_EMERGENCY + node.node,
        "host_heartbeat": omap.host_node << 16 | round(bus.drive_timeout_s * 1e3),
        "heartbeat_ms": round(bus.heartbeat_s * 1e3),
        "following_window_counts": round(window_mm * counts),
        "stroke_min_counts": round(axis.stroke_mm[0] * counts),
        "stroke_max_counts": round(axis.stroke_mm[1] * counts),
        "quick_stop_counts_s2": round(axis.a_quick_mm_s2 * counts),
        "interpolation_value": value,
        "interpolation_exponent": exponent,
        **_force_quantities(node, omap.force_mode),
    }


def _force_quantities(node: AxisNode, mode: ForceMode) -> dict[str, int]:
    """What bounds an axis that holds a force; nothing for any other."""
    if node.force_n is None:
        return {}
    return {
        "max_torque_counts": round(mode.max_force * node.force_n / mode.newton_per_count),
        "max_speed_rpm": round(mode.max_speed * node.axis.v_mm_s * 60.0 / mode.mm_per_revolution),
    }


class NodeBringUp:
    """Prepares one pre-operational node. Every error names the axis."""

    def __init__(self, node: AxisNode, bus: CanBus, omap: ObjectMap, send: Callable[[list[CanFrame]], None]) -> None:
        self.node = node
        self.sdo = SdoClient(node.name, node.node, send, omap.abort_text)
        self._proof = DriveProof(node, bus, omap, self.sdo)
        self._map = omap
        self._holds_force = node.force_n is not None

    @property
    def position_mode(self) -> PositionMode:
        """How the axis takes its set-points; known after `run`."""
        return self._proof.position_mode

    async def run(self, given: dict[str, int]) -> Identity:
        """Prove who answers; write and read back everything.

        Raises DeviceSilent, DeviceRefused, BadReply, WrongIdentity, ReadBackMismatch.
        """
        identity = await self._proof.who()
        await self._proof.scale()
        of_mode = self._map.force_mode.written if self._holds_force else self.position_mode.written
        await self.write_all(self._map.written + of_mode, given)
        await self._map_pdos()
        await self._set_mode()
        self._proof.refuse_twin()
        return identity

    async def write_all(self, written: tuple[tuple[str, int | str], ...], given: dict[str, int]) -> None:
        """Write objects in this order, each read back; texts are `@` quantities of `given`. Raises as `run`."""
        for name, value in written:
            number = given[value[1:]] if isinstance(value, str) else value
            await self._write(self._map.objects[name], number)

    async def is_homed(self) -> bool:
        """Whether the drive knows its zero: only in homing mode does it say so. Back in its own mode afterwards."""
        homing, objects = self._map.homing, self._map.objects
        await self._show_mode(homing.mode)
        attained = bool(await self.sdo.read(objects["statusword"]) >> homing.attained & 1)
        await self._set_mode()
        return attained

    async def standing(self) -> tuple[int, int]:
        """Statusword and position (counts) as they are before the first read-back frame."""
        objects = self._map.objects
        return await self.sdo.read(objects["statusword"]), await self.sdo.read(objects["position"])

    async def _write(self, entry: ObjectEntry, value: int) -> None:
        await self.sdo.write(entry, value)
        await self._confirm(entry, value)

    async def _confirm(self, entry: ObjectEntry, value: int, mask: int = 0xFFFF_FFFF) -> None:
        found = await self.sdo.read(entry)
        if found & mask != value & mask:
            raise ReadBackMismatch(self.node.name, f"object {entry.label}", value=found, limit=value)

    async def _map_pdos(self) -> None:
        for communication, cob in self._map.pdos_off:
            await self._switch_off(communication, cob + self.node.node)
        pdos = self._map.pdos
        await self._map_pdo(
            pdos["force_set_points" if self._holds_force else self.position_mode.set_points], self.node.powered
        )
        await self._map_pdo(pdos["read_back"], True)
        await self._map_pdo(pdos["force"], self.node.load_cell)

    async def _switch_off(self, communication: int, cob: int) -> None:
        """Make sure that a PDO is off; a drive that has no such PDO is as good."""
        try:
            await self._set_cob(communication, cob | codec.COB_INVALID)
        except DeviceRefused as error:
            if error.value != _NO_SUCH_OBJECT:
                raise

    async def _map_pdo(self, pdo: PdoEntry, used: bool) -> None:
        """Switch a PDO off, describe it, and switch it on only where this axis uses it."""
        cob = pdo.cob + self.node.node
        await self._set_cob(pdo.communication, cob | codec.COB_INVALID)
        if not used:
            return
        await self._write(self._entry(pdo, "transmission", pdo.communication, 2, "u8"), pdo.transmission)
        count = self._entry(pdo, "count", pdo.mapping, 0, "u8")
        await self._write(count, 0)
        for number, word in enumerate(pdo.words, start=1):
            await self._write(self._entry(pdo, f"entry {number}", pdo.mapping, number, "u32"), word)
        await self._write(count, len(pdo.words))
        await self._set_cob(pdo.communication, cob)

    async def _set_cob(self, communication: int, cob: int) -> None:
        entry = ObjectEntry("pdo_cob_id", communication, 1, "u32")
        await self.sdo.write(entry, cob)
        await self._confirm(entry, cob, _COB_MASK)

    @staticmethod
    def _entry(pdo: PdoEntry, what: str, index: int, sub: int, kind: str) -> ObjectEntry:
        return ObjectEntry(f"{pdo.name}_pdo_{what}", index, sub, kind)

    async def _set_mode(self) -> None:
        await self._show_mode(self._map.force_mode.mode if self._holds_force else self.position_mode.mode)

    async def _show_mode(self, mode: int) -> None:
        """Select a mode and wait until the drive displays it: a write alone proves nothing."""
        objects, loop = self._map.objects, asyncio.get_running_loop()
        await self._write(objects["mode"], mode)
        deadline = loop.time() + _MODE_S
        while await self.sdo.read(objects["mode_display"]) != mode:
            if not (loop.time() < deadline):
                await self._confirm(objects["mode_display"], mode)
            await asyncio.sleep(0.02)
