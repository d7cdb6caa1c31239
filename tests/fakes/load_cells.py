"""In-memory load cells without wire and bytes: what the port means, in a few lines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from docking.errors import DeviceSilent, DockingError, LoadCellBroken
from docking.types import Array, Identity

BRING_UP_S = 0.01


class FakeLoadCells:
    """`docking.ports.LoadCells`: one cell under the second of four positioners."""

    name = "cell_B"

    def __init__(self) -> None:
        self.on_fault: Callable[[DockingError], None] = lambda error: None
        self._load_n = (0.0, 0.0, 0.0)
        self._error: DockingError | None = None
        self._up = False
        self._force_n: Array = np.full(12, np.nan)

    async def bring_up(self) -> tuple[Identity, ...]:
        await asyncio.sleep(BRING_UP_S)
        if self._error is not None:
            raise self._error
        self._up = True
        self._tell()
        return (Identity(f"load cell {self.name}", "tests", "fake", "1", "1"),)

    def latest(self) -> Array:
        return self._force_n

    async def close(self) -> None:
        self._up = False
        self._force_n = np.full(12, np.nan)

    def pull(self, x_n: float, y_n: float, z_n: float) -> None:
        self._load_n = (x_n, y_n, z_n)
        self._tell()

    def tear(self, torn: bool) -> None:
        self._fail(LoadCellBroken(f"B.X, load cell {self.name}", value="0.00 mA", limit="4..20 mA") if torn else None)

    def mute(self, muted: bool) -> None:
        self._fail(DeviceSilent(f"B.X, load cell {self.name}", "module is silent") if muted else None)

    def _fail(self, error: DockingError | None) -> None:
        self._error = error
        self._tell()
        if error is not None and self._up:
            self.on_fault(error)

    def _tell(self) -> None:
        if self._up:
            self._force_n = np.full(12, np.nan)
            if self._error is None:
                self._force_n[3:6] = self._load_n
