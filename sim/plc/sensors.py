"""Read-backs of the plant as register words, converted at most once a scan for all PLCs."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from docking.types import Array
from sim.plc.playback import Point
from sim.plc.registers import AXES, NO_FORCE

FORCE_EVERY = 5
"""Scans between two conversions of the load cells."""


class PlantView(Protocol):
    """What a PLC group asks of the plant; arrays (m,) in the order of the cell's axes."""

    def step(self, t_s: float, target_mm: Array, powered: NDArray[np.bool_], braked: NDArray[np.bool_]) -> None: ...

    def encoder_mm(self) -> Array: ...

    def following_error_mm(self) -> Array: ...

    def force_n(self) -> Array: ...


class Readings:
    """The plant's read-backs of one scan. `has_force` (m,) marks the axes with a load cell."""

    def __init__(self, plant: PlantView, has_force: NDArray[np.bool_]) -> None:
        self._plant, self._has_force = plant, has_force
        self._scan = 0
        self._words_scan = self._force_scan = -FORCE_EVERY
        self._worst_scan, self._worst_mm = -1, 0.0
        self._errors: Array | None = None
        self._errors_before: Array | None = None
        self._measured = bool(has_force.any())
        self._force = [NO_FORCE] * len(has_force)
        self._rows: list[tuple[int, int, int]] = []

    def next_scan(self) -> None:
        """Forget what was converted: the plant has moved."""
        self._scan += 1
        self._errors_before, self._errors = self._errors, None

    def encoder_mm(self) -> Array:
        return self._plant.encoder_mm()

    def following_error_mm(self) -> Array:
        if self._errors is None:
            self._errors = self._plant.following_error_mm()
        return self._errors

    def following_error_before_mm(self) -> Array:
        """Those of the scan before; of this one when nobody asked then."""
        before = self._errors_before
        return self.following_error_mm() if before is None else before

    def worst_error_mm(self) -> float:
        """Largest following error of all axes in this scan."""
        if self._worst_scan != self._scan:
            self._worst_scan = self._scan
            self._worst_mm = float(np.abs(self.following_error_mm()).max())
        return self._worst_mm

    def rows(self) -> list[tuple[int, int, int]]:
        """(position um, following error um, force 10 N) of every axis."""
        if self._words_scan != self._scan:
            self._words_scan = self._scan
            position = np.rint(self._plant.encoder_mm() * 1000.0).astype(np.int64).tolist()
            error = _whole(self.following_error_mm() * 1000.0).astype(np.int64).tolist()
            self._rows = list(zip(position, error, self._forces(), strict=True))
        return self._rows

    def _forces(self) -> list[int]:
        if self._measured and self._scan - self._force_scan >= FORCE_EVERY:
            self._force_scan = self._scan
            tens = _whole(self._plant.force_n() / 10.0)
            self._force = np.where(self._has_force, tens, NO_FORCE).astype(np.int64).tolist()
        return self._force


def _whole(values: Array) -> Array:
    """Whole numbers that fit a signed register (np.clip costs five times as much on small arrays)."""
    return np.rint(np.maximum(np.minimum(values, 32767.0), -32767.0))


class Sensors:
    """The three axes of positioner number `index`."""

    def __init__(self, readings: Readings, index: int) -> None:
        self._readings, self._span = readings, slice(AXES * index, AXES * (index + 1))

    def point_mm(self) -> Point:
        x, y, z = self._readings.encoder_mm()[self._span].tolist()
        return (x, y, z)

    def strays(self, limit_mm: float) -> bool:
        """True when some axis of the cell has a following error over the limit: a quick look before a close one."""
        return not self._readings.worst_error_mm() <= limit_mm

    def following_error_mm(self) -> list[float]:
        result: list[float] = self._readings.following_error_mm()[self._span].tolist()
        return result

    def following_error_before_mm(self) -> list[float]:
        result: list[float] = self._readings.following_error_before_mm()[self._span].tolist()
        return result

    def words(self) -> list[tuple[int, int, int]]:
        return self._readings.rows()[self._span]
