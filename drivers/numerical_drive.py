"""One axis whose drive takes a target, a speed and an acceleration as numbers and goes there by itself (no PLC).

Which registers these are is a file of `drivers/maps`. Such drives have no common start, no queue and no heartbeat of
the host: axes that are written one after another are apart by speed x the time between the writes, and one under way
goes on when the host falls silent. They serve the `single_axes` of a cell, which carry nothing together (a platform, a
gate), not a part on several of them; no positioner of a cell file is of this kind.
"""

from __future__ import annotations

import asyncio
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from docking.errors import BadArgument, EnableFailed, OutcomeUnknown, ReadBackMismatch
from drivers.modbus_requests import RegisterUnit
from drivers.register_map import Block

POLL_S = 0.02


@dataclass(frozen=True)
class DriveState:
    """One read-back: position (mm), alarm code (0: none), and what the drive says of itself."""

    position_mm: float
    alarm: int
    powered: bool
    homed: bool
    in_position: bool


class NumericalMap:
    """A file of `drivers/maps` for drives that move by numbers."""

    def __init__(self, name: str) -> None:
        table = tomllib.loads(resources.files("drivers.maps").joinpath(f"{name}.toml").read_text("utf-8"))
        self.scale: dict[str, Any] = table["scale"]
        self.range: dict[str, list[float]] = table["range"]
        self.bits = {key: int(table[key]) for key in ("servo_on", "alarm", "homed", "in_position")}
        self.movement, self.status = (
            Block(table[key]["address"], table[key]["fields"], (), 0) for key in ("movement", "status")
        )


@cache
def load_numerical_map(name: str) -> NumericalMap:
    """The map `name` of drivers/maps. KeyError or FileNotFoundError mark a broken installation."""
    return NumericalMap(name)


class NumericalDrive:
    """The drive behind `unit`, by `layout`."""

    def __init__(self, unit: RegisterUnit, layout: NumericalMap, band_mm: float = 0.05) -> None:
        self.unit, self._map, self._band_mm = unit, layout, band_mm

    async def read(self) -> DriveState:
        """Raises DeviceSilent, BadReply, LinkLost."""
        block, bits = self._map.status, self._map.bits
        head, _ = block.unpack(await self.unit.read(block.address, block.count))
        device = head["device"]
        alarm = head["alarm"] or int(device & bits["alarm"] != 0)
        shown = (device & bits[key] != 0 for key in ("servo_on", "homed", "in_position"))
        return DriveState(head["position"] / self._map.scale["position_per_mm"], alarm, *shown)

    async def move(self, target_mm: float, speed_mm_s: float, acceleration_m_s2: float, within_s: float) -> DriveState:
        """Go to `target_mm` and return when the drive stands there by its own read-back.

        The movement is written once: when its reply is lost, the next read-backs tell whether the axis goes. Raises
        BadArgument outside the range of the drive, EnableFailed when it is off, not homed or in alarm,
        ReadBackMismatch when it is not there after `within_s`, and what `read` raises.
        """
        words = self._words(target_mm, speed_mm_s, acceleration_m_s2)
        self._require_ready(await self.read())
        try:
            await self.unit.write(self._map.movement.address, self._map.movement.pack(*words))
        except OutcomeUnknown:
            await asyncio.sleep(POLL_S)
        loop = asyncio.get_running_loop()
        end_s = loop.time() + within_s
        while True:
            state = await self.read()
            self._require_ready(state)
            if state.in_position and abs(state.position_mm - target_mm) <= self._band_mm:
                return state
            if not loop.time() < end_s:
                raise ReadBackMismatch(f"{self.unit.where}, position", value=state.position_mm, limit=target_mm)
            await asyncio.sleep(POLL_S)

    def _words(self, target_mm: float, speed_mm_s: float, acceleration_m_s2: float) -> tuple[int, ...]:
        scale = self._map.scale
        for key, value in (("position_mm", target_mm), ("speed_mm_s", speed_mm_s)):
            low, high = self._map.range[key]
            if not low <= value <= high:
                raise BadArgument(f"{self.unit.where}, {key}", f"{low:g} to {high:g}", value=value)
        acceleration = round(acceleration_m_s2 * scale["acceleration_per_m_s2"])
        if not 1 <= acceleration <= 0xFFFF:
            raise BadArgument(f"{self.unit.where}, acceleration", "at least one count", value=acceleration_m_s2)
        per_mm = scale["position_per_mm"]
        head = (round(target_mm * per_mm), max(1, round(self._band_mm * per_mm)))
        return (
            *head,
            round(speed_mm_s * scale["speed_per_mm_s"]),
            acceleration,
            scale["push_percent"],
            scale["control"],
        )

    def _require_ready(self, state: DriveState) -> None:
        if state.alarm:
            raise EnableFailed(self.unit.where, "The drive reports an alarm.", value=f"{state.alarm:#x}")
        if not (state.powered and state.homed):
            raise EnableFailed(self.unit.where, "The servo is off or the axis has no reference.", value="not ready")
