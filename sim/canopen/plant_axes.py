"""What the simulated drives need of `sim.plant.Plant`."""

from __future__ import annotations

from typing import Final, Protocol

from docking.types import Array
from sim.canopen.parameters import BoolArray

NEWTON_PER_COUNT: Final = 10.0
"""Unit of the load-cell object 2100h."""


class PlantAxes(Protocol):
    """Axes in the cell's order, arrays (m,)."""

    axes: tuple[str, ...]

    def step(self, t_s: float, target_mm: Array, powered: BoolArray, braked: BoolArray) -> None: ...

    def press(self, force_n: Array, v_max_mm_s: Array) -> None: ...

    def encoder_mm(self) -> Array: ...

    def following_error_mm(self) -> Array: ...

    def at_rest(self) -> bool: ...

    def force_n(self) -> Array: ...
