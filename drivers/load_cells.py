"""Three-component load cells with 4 to 20 mA transmitters on the analogue inputs of I/O modules.

    I = 4 mA + 16 mA (n - n_4) / (n_20 - n_4),    F = range (I - 12 mA) / 8 mA

Limits of the current as NAMUR NE 43 has them: 3.8 to 20.5 mA is a measurement, below 3.6 or above 21 mA is a failure.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from docking.config.cell import CellFile
from docking.config.inputs import ForceInput
from docking.config.wired_forces import load_cell_ranges_n, wired_forces
from docking.errors import BadReply, DeviceSilent, DockingError, LoadCellBroken
from docking.types import Array, Identity, readonly
from drivers.inputs import InputModule

MEASURING_MA = (3.8, 20.5)
FAILED_MA = (3.6, 21.0)
MIDDLE_MA, HALF_SPAN_MA = 12.0, 8.0
READY_S = 1.0


def current_ma(force: ForceInput, counts: int) -> float:
    """The current (mA) of an input that reads `counts`."""
    low, high = force.counts
    return 4.0 + 16.0 * (counts - low) / (high - low)


def measured_n(force: ForceInput, range_n: float, counts: int | None) -> float:
    """The force (N) of an input that reads `counts` (None: a broken wire), NaN where the current means none."""
    ma = float("nan") if counts is None else current_ma(force, counts)
    known = MEASURING_MA[0] <= ma <= MEASURING_MA[1]
    return range_n * (ma - MIDDLE_MA) / HALF_SPAN_MA if known else float("nan")


@dataclass(frozen=True)
class _Component:
    """One wire: which axis it belongs to, where it ends, how it is scaled."""

    index: int
    axis: str
    module: InputModule
    channel: int
    force: ForceInput
    range_n: float

    def read(self) -> tuple[float, DockingError | None]:
        """Force in N, NaN with the reason where there is none."""
        nothing = float("nan")
        where = f"{self.axis}, load cell {self.force.name}"
        if self.module.silent:
            return nothing, DeviceSilent(where, f"module {self.module.name} is silent")
        counts = self.module.counts(self.channel)
        if counts is None:
            return nothing, LoadCellBroken(
                where, "The module reports a broken wire.", value="no current", limit="4..20 mA"
            )
        ma = current_ma(self.force, counts)
        if not FAILED_MA[0] <= ma <= FAILED_MA[1]:
            cause = (
                "Wire broken or without supply."
                if ma < MIDDLE_MA
                else "Short circuit, or the transmitter reports a failure."
            )
            return nothing, LoadCellBroken(where, cause, value=f"{ma:.2f} mA", limit="4..20 mA")
        if not MEASURING_MA[0] <= ma <= MEASURING_MA[1]:
            return nothing, LoadCellBroken(where, "Beyond its range.", value=f"{ma:.2f} mA", limit="4..20 mA")
        return measured_n(self.force, self.range_n, counts), None


class AnalogueLoadCells:
    """`docking.ports.LoadCells` over the analogue inputs of modules, which belong to it alone."""

    def __init__(self, cell: CellFile, modules: Mapping[str, InputModule]) -> None:
        self.on_fault: Callable[[DockingError], None] = lambda error: None
        self._modules = modules
        self._count = len(cell.axis_names)
        self._components = _components(cell, modules)
        self._force_n: Array = readonly(np.full(self._count, np.nan))
        self._ill: frozenset[str] = frozenset()
        self._up = False

    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove every module, and that every wire carries a current that means a force.

        Raises LinkError: LoadCellBroken names axis and cell; BadReply where a channel does not exist.
        """
        self._up = False
        found = [await module.bring_up() for module in self._modules.values()]
        for component in self._components:
            channels = component.module.channels[1]
            if not component.channel < channels:
                cause = f"{component.force.name}: the module has no analogue input {component.channel}"
                raise BadReply(f"input module {component.module.name}", cause, value=channels)
        await self._ready()
        for module in self._modules.values():
            module.on_change = self._look
        self._up = True
        self._look()
        return tuple(found)

    async def _ready(self) -> None:
        """Wait until every module has said what its inputs are. Raises what is wrong with the first that has not."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + READY_S
        while error := next((error for _, error in map(_Component.read, self._components) if error), None):
            if not (isinstance(error, DeviceSilent) and loop.time() < end_s):
                raise error
            await asyncio.sleep(0.01)

    def latest(self) -> Array:
        """Newest forces along the axes (m,), N, NaN where no cell is wired here or nothing is known. The same object
        until something changes."""
        return self._force_n

    async def close(self) -> None:
        self._up = False
        self._force_n = readonly(np.full(self._count, np.nan))
        for module in self._modules.values():
            module.on_change = lambda: None
            await module.close()

    def _look(self) -> None:
        if not self._up:
            return
        force_n = np.full(self._count, np.nan)
        errors: dict[str, DockingError] = {}
        for component in self._components:
            force_n[component.index], error = component.read()
            if error is not None:
                errors[component.axis] = error
        self._force_n = readonly(force_n)
        fresh = [error for axis, error in errors.items() if axis not in self._ill]
        self._ill = frozenset(errors)
        for error in fresh:
            self.on_fault(error)


def _components(cell: CellFile, modules: Mapping[str, InputModule]) -> tuple[_Component, ...]:
    return tuple(
        _Component(cell.axis_names.index(axis), axis, modules[force.module], channel, force, range_n)
        for force in wired_forces(cell)
        for axis, channel, range_n in zip(
            (f"{force.positioner}.{name}" for name in "XYZ"), force.channels, load_cell_ranges_n(cell), strict=True
        )
    )


def weighed(own_n: Array, wired_n: Array) -> Array:
    """Forces (m,) that axes report themselves, completed by those of cells that are wired elsewhere."""
    return readonly(np.where(np.isnan(wired_n), own_n, wired_n))
