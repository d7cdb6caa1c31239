"""Homing a group of free axes: all of them together, and when one fails, all of them halt.

A drive says of itself how far it is. "Attained" alone is not believed: it may be left from an earlier homing. A drive
that is not in homing mode would take the starting bit for something else.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Final

from docking.config.cell import AxisConfig, HomingConfig
from docking.errors import DockingError, HomingFailed, HomingRefused, WrongIdentity
from docking.types import Array
from drivers.canopen import cia402
from drivers.canopen.bring_up import NodeBringUp
from drivers.canopen.cia402 import DriveState, Goal
from drivers.canopen.cyclic import CyclicImage
from drivers.maps.objects import HomingMode, ObjectMap, PositionMode

WHERE_IT_STANDS: Final = (35, 37)
"""Methods that take the present position for the zero: no motion, done within a cycle."""
EDGE_CYCLES = 3
"""SYNCs for a drive to see an edge in its controlword."""
MODE_S, ENABLE_S, STOP_S = 0.5, 2.0, 2.0
STANDS_MM = 0.005
OFFSET_MM = 0.01
"""How far an axis that was homed where it stands may be from the position of its home."""


@dataclass(frozen=True)
class HomingRules:
    """What homing rests on. `step` lets a cycle pass; `trouble(indices)` names the first axis that is not well and says
    why; `asked_to_stop()` says why the group is to halt. Both None to go on. `forces_n()` (m,) is what the load cells
    read, wherever they are wired; NaN where that is not known."""

    config: HomingConfig
    omap: ObjectMap
    counts_per_mm: float
    step: Callable[[], Awaitable[None]]
    trouble: Callable[[Sequence[int]], tuple[str, str] | None]
    asked_to_stop: Callable[[], str | None]
    forces_n: Callable[[], Array]


def method_of(axis: AxisConfig, config: HomingConfig) -> int:
    """The method (6098h) of one axis."""
    return axis.homing_method or config.method


def homing_quantities(axis: AxisConfig, config: HomingConfig, counts_per_mm: float) -> dict[str, int]:
    """The `@` quantities of the map's homing table for one axis, in counts."""
    switch, zero = (round(speed * counts_per_mm) for speed in config.speed_mm_s)
    return {
        "homing_method": method_of(axis, config),
        "homing_switch_counts_s": switch,
        "homing_zero_counts_s": zero,
        "homing_counts_s2": round(config.acceleration_mm_s2 * counts_per_mm),
        "home_counts": round(axis.home_mm * counts_per_mm),
    }


class HomingGroup:
    """Homes the axes of `setups`; disabled before and after, whatever happens. `begun`: their zeros are not trusted."""

    def __init__(self, image: CyclicImage, setups: Sequence[NodeBringUp], rules: HomingRules) -> None:
        self._image, self._setups, self._rules = image, setups, rules
        self._mode: HomingMode = rules.omap.homing
        self._indices = [setup.node.index for setup in setups]
        self._names = {setup.node.index: setup.node.name for setup in setups}
        self.begun = False

    async def run(self) -> None:
        """Home all axes of the group.

        Raises HomingRefused before anything moves; HomingFailed naming the axis, after the whole group stands and is
        disabled; WrongIdentity, ReadBackMismatch, DeviceRefused, DeviceSilent where a drive cannot be prepared.
        """
        self._require_free()
        await self._each(self._prepare)
        self.begun = True
        try:
            await self._select()
            await self._enable()
            await self._find()
        except DockingError as error:
            await self._halt()
            raise self._failure(error) from error
        finally:
            await self._leave()

    # before anything moves ---------------------------------------------------------------------------------------
    def _require_free(self) -> None:
        for index in self._indices:
            state = self._image.state(index)
            if state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE):
                raise HomingRefused(self._names[index], "It is under torque.", value=state.value, limit="disabled")
        if (loaded := self._loaded()) is not None:
            cause = "Its load cell shows a component: one axis of it moved alone would strain it."
            limit = f"{self._rules.config.free_n:g} N"
            raise HomingRefused(loaded[0], cause, value=f"{loaded[1]:.0f} N", limit=limit)

    def _loaded(self) -> tuple[str, float] | None:
        """The first axis of the group whose load cell reads more than a free one's, or nothing, and its reading (N)."""
        forces_n = self._rules.forces_n()
        for index in self._indices:
            loaded = not (abs(forces_n[index]) <= self._rules.config.free_n)
            if self._image.nodes[index].weighed and loaded:
                return self._names[index], float(forces_n[index])
        return None

    async def _prepare(self, setup: NodeBringUp) -> None:
        rules, axis = self._rules, setup.node.axis
        modes = await setup.sdo.read(rules.omap.objects["supported_modes"])
        if not modes >> self._mode.supported_mode_bit & 1:
            wanted = f"mode {self._mode.mode}"
            cause = "the drive has no homing mode"
            raise WrongIdentity(setup.node.name, cause, value=f"6502h = {modes:08X}h", limit=wanted)
        given = homing_quantities(axis, rules.config, rules.counts_per_mm)
        await setup.write_all(self._mode.written, given)

    async def _select(self) -> None:
        """Homing mode, displayed by every drive before any of them is enabled."""
        mode = PositionMode("homing", self._mode.supported_mode_bit, self._mode.mode, "set_points")
        for index in self._indices:
            self._image.choose(index, mode)
        await self._each(self._shown)

    async def _shown(self, setup: NodeBringUp) -> None:
        loop = asyncio.get_running_loop()
        deadline, display = loop.time() + MODE_S, self._rules.omap.objects["mode_display"]
        while (found := await setup.sdo.read(display)) != self._mode.mode:
            if not (loop.time() < deadline):
                cause = f"It does not take homing mode: object {display.label} reads {found}."
                raise HomingFailed(setup.node.name, cause)
            await self._rules.step()

    async def _each(self, act: Callable[[NodeBringUp], Awaitable[None]]) -> None:
        """Side by side; the first error in the order of the axes after all have ended."""
        results = await asyncio.gather(*(act(setup) for setup in self._setups), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result

    # together ----------------------------------------------------------------------------------------------------
    async def _enable(self) -> None:
        deadline = asyncio.get_running_loop().time() + ENABLE_S
        on = DriveState.OPERATION_ENABLED
        while waiting := [i for i in self._indices if self._image.state(i) is not on or self._image.brake_closed(i)]:
            self._watch()
            if not (asyncio.get_running_loop().time() < deadline):
                raise HomingFailed(self._names[waiting[0]], f"It could not be enabled within {ENABLE_S:g} s.")
            for index in self._indices:
                word = cia402.next_controlword(self._image.state(index), Goal.ENABLED, brake_closed=True)
                self._image.command(index, word)
            await self._rules.step()

    async def _find(self) -> None:
        """Start all in one cycle and wait until each has found its zero."""
        loop, mode = asyncio.get_running_loop(), self._mode
        self._command_all(cia402.ENABLE_OPERATION | mode.start_bits)
        deadline = loop.time() + self._rules.config.timeout_s
        begun = {i for i in self._indices if self._method(i) in WHERE_IT_STANDS}
        first = self._image.cycles + EDGE_CYCLES
        while True:
            await self._rules.step()
            self._watch()
            words = {index: self._image.word(index) for index in self._indices}
            begun |= {index for index, word in words.items() if not word >> mode.attained & 1}
            for index, word in words.items():
                if self._image.state(index) is not DriveState.OPERATION_ENABLED:
                    raise HomingFailed(self._names[index], f"The drive is {self._image.state(index).value}.")
                if word >> mode.error & 1 and self._image.cycles > first:
                    raise HomingFailed(self._names[index], "The drive reports a homing error.")
            found = {i for i, word in words.items() if word >> mode.attained & word >> mode.reached & 1}
            waiting = [i for i in self._indices if i not in found & begun]
            if not waiting and self._image.cycles > first:
                return self._check_zeros()
            if not (loop.time() < deadline):
                what = "has not found its zero" if waiting[0] in begun else "has not begun"
                raise HomingFailed(self._names[waiting[0]], f"It {what} after {self._rules.config.timeout_s:g} s.")

    def _check_zeros(self) -> None:
        """An axis that was homed where it stands must now count from its home."""
        for index in self._indices:
            if self._method(index) in WHERE_IT_STANDS:
                home_mm = self._image.nodes[index].axis.home_mm
                shown_mm = self._image.position_mm(index)
                if not (abs(shown_mm - home_mm) <= OFFSET_MM):
                    cause = f"It reads {shown_mm:.3f} mm where its home is {home_mm:.3f} mm."
                    raise HomingFailed(self._names[index], cause)

    def _watch(self) -> None:
        """Raise for the first axis of the group that is not well, and where somebody asks for a stop."""
        reason = self._rules.asked_to_stop()
        if reason is not None:
            raise HomingFailed(", ".join(self._names.values()), reason)
        trouble = self._rules.trouble(self._indices)
        if trouble is not None:
            raise HomingFailed(*trouble)
        if (loaded := self._loaded()) is not None:
            limit_n = self._rules.config.free_n
            cause = f"Its load cell reads {loaded[1]:.0f} N, more than the {limit_n:g} N of a free axis."
            raise HomingFailed(loaded[0], cause)

    # the end -----------------------------------------------------------------------------------------------------
    async def _halt(self) -> None:
        """Halt every axis of the group in one cycle, and wait until all stand. Axes of no group hear nothing."""
        loop = asyncio.get_running_loop()
        self._command_all(cia402.ENABLE_OPERATION | self._mode.halt_bits)
        deadline, before = loop.time() + STOP_S, self._positions()
        still = 0
        while still < EDGE_CYCLES and loop.time() < deadline:
            try:
                await self._rules.step()
            except DockingError:
                return
            now = self._positions()
            moved = max(abs(a - b) for a, b in zip(now, before, strict=True))
            still, before = still + 1 if moved <= STANDS_MM else 0, now

    async def _leave(self) -> None:
        """Disable the group, brakes first, and give every axis its own mode back."""
        deadline = asyncio.get_running_loop().time() + STOP_S
        off = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
        while any(self._image.state(i) not in off for i in self._indices):
            if not (asyncio.get_running_loop().time() < deadline):
                break
            for index in self._indices:
                closed = self._image.brake_closed(index)
                word = cia402.next_controlword(self._image.state(index), Goal.DISABLED, closed)
                self._image.command(index, word)
            try:
                await self._rules.step()
            except DockingError:
                break
        for setup in self._setups:
            self._image.choose(setup.node.index, setup.position_mode)

    def _failure(self, error: DockingError) -> HomingFailed:
        return error if isinstance(error, HomingFailed) else HomingFailed(error.where, error.text())

    def _command_all(self, word: int) -> None:
        """One word to every axis that is under torque; a drive in fault stops by itself."""
        for index in self._indices:
            if self._image.state(index) is DriveState.OPERATION_ENABLED:
                self._image.command(index, word)

    def _positions(self) -> list[float]:
        return [self._image.position_mm(index) for index in self._indices]

    def _method(self, index: int) -> int:
        return method_of(self._image.nodes[index].axis, self._rules.config)
