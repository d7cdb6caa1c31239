"""Axes whose load cells are wired to I/O modules: the same drivers, their read-backs completed by the forces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from docking.config.cell import CellFile
from docking.ports import CanLink, LoadCells, SerialLink
from docking.types import Array, Feedback, Identity
from drivers.canopen.positioners import CanopenPositioners
from drivers.load_cells import weighed
from drivers.modbus_client import Tap
from drivers.modbus_positioners import ModbusPositioners


class _Scale:
    """Puts the forces of `cells` into read-backs. Readings that are not new keep their object: they count once."""

    def __init__(self, cells: LoadCells) -> None:
        self.cells = cells
        self._before: tuple[Array, Array] | None = None
        self._force_n: Array

    def weigh(self, feedback: Feedback) -> Feedback:
        wired_n, own_n = self.cells.latest(), feedback.force_n
        if self._before is None or self._before[0] is not wired_n or self._before[1] is not own_n:
            self._before, self._force_n = (wired_n, own_n), weighed(own_n, wired_n)
        return replace(feedback, force_n=self._force_n)


class WeighedDrives(CanopenPositioners):
    """`docking.ports.StreamedPositioners` with load cells elsewhere."""

    def __init__(self, cell: CellFile, link: CanLink, cells: LoadCells) -> None:
        super().__init__(cell, link)
        self._scale = _Scale(cells)

    async def bring_up(self) -> tuple[Identity, ...]:
        """The axes first: their wire may be the one that the modules share."""
        return (*await super().bring_up(), *await self._scale.cells.bring_up())

    async def enable(self) -> Feedback:
        return self._scale.weigh(await super().enable())

    def latest(self) -> Feedback:
        return self._scale.weigh(super().latest())

    async def close(self) -> None:
        try:
            await super().close()
        finally:
            await self._scale.cells.close()


class WeighedControllers(ModbusPositioners):
    """`docking.ports.QueuedPositioners` with load cells elsewhere."""

    def __init__(
        self,
        cell: CellFile,
        addresses: Mapping[str, tuple[str, int]] | None,
        tap: Tap | None,
        link: SerialLink | None,
        cells: LoadCells,
    ) -> None:
        super().__init__(cell, addresses, tap, link)
        self._scale = _Scale(cells)

    async def bring_up(self) -> tuple[Identity, ...]:
        return (*await super().bring_up(), *await self._scale.cells.bring_up())

    async def enable(self) -> Feedback:
        return self._scale.weigh(await super().enable())

    async def poll(self, *, surviving: bool = False) -> Feedback:
        return self._scale.weigh(await super().poll(surviving=surviving))

    async def close(self) -> None:
        try:
            await super().close()
        finally:
            await self._scale.cells.close()
