"""The drives' own quick-stop ramps (6085h), set before each move so that all axes come to rest together."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import numpy as np

from docking.errors import AxisLimitExceeded, ReadBackMismatch
from docking.types import Array
from drivers.canopen.bring_up import NodeBringUp
from drivers.maps.objects import ObjectEntry

ROUNDING = 0.05
"""Part of the deceleration by which a drive may round what it is told."""
LEAST_PART = 0.01
"""Of the full deceleration: an axis that hardly moves in a plan still gets this much, never 0.

Its way in the common time then differs by at most 0.01 a t^2 / 2, with 200 mm/s^2 and 25 ms by 0.6 um.
"""


class QuickStopRamps:
    """Writes 6085h of all powered axes side by side and reads it back. `full_mm_s2` (m,) are the axes' own limits."""

    def __init__(
        self, setups: Sequence[NodeBringUp], entry: ObjectEntry, full_mm_s2: Array, counts_per_mm: float
    ) -> None:
        self._setups = [setup for setup in setups if setup.node.powered]
        self._entry, self._counts_per_mm = entry, counts_per_mm
        self._full = full_mm_s2
        self.armed = False

    async def arm(self, peak_mm_s: Array, t_stop_s: float) -> None:
        """Decelerations `peak_mm_s` (m,) / `t_stop_s`, so that every axis stops in one time.

        Raises AxisLimitExceeded where an axis would need more than its full deceleration, ReadBackMismatch where a
        drive rounds by more than 5 %, DeviceSilent, DeviceRefused; each names the axis.
        """
        wanted = np.maximum(np.abs(peak_mm_s) / t_stop_s if t_stop_s > 0.0 else np.nan, LEAST_PART * self._full)
        for setup in self._setups:
            k = setup.node.index
            if not (wanted[k] <= self._full[k] * (1.0 + 1e-9)):
                cause = f"quick stop of a planned move within {t_stop_s:.4g} s"
                raise AxisLimitExceeded(setup.node.name, cause, value=float(wanted[k]), limit=float(self._full[k]))
        self.armed = True
        await self._write(wanted)

    async def restore(self) -> None:
        """Write the full decelerations back. Raises as `arm`."""
        if self.armed:
            await self._write(self._full)
            self.armed = False

    async def _write(self, decel_mm_s2: Array) -> None:
        results = await asyncio.gather(
            *[self._write_one(setup, float(decel_mm_s2[setup.node.index])) for setup in self._setups],
            return_exceptions=True,
        )
        errors = [result for result in results if isinstance(result, BaseException)]
        if errors:
            raise errors[0]

    async def _write_one(self, setup: NodeBringUp, decel_mm_s2: float) -> None:
        counts = max(1, round(decel_mm_s2 * self._counts_per_mm))
        await setup.sdo.write(self._entry, counts)
        found = await setup.sdo.read(self._entry)
        if not (found > 0 and abs(found - counts) <= ROUNDING * counts):
            raise ReadBackMismatch(setup.node.name, f"object {self._entry.label}", value=found, limit=counts)
