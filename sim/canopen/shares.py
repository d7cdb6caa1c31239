"""One plant for the drives of several CAN buses: whichever bus steps it, the drives of the others come along."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from docking.types import Array, readonly
from sim.canopen.parameters import BoolArray
from sim.canopen.plant_axes import PlantAxes

LEAST_CYCLES = 0.3
"""Part of a cycle below which a second SYNC belongs to the first."""

At = Callable[[float], tuple[Array, BoolArray, BoolArray]]
"""Set-points (m,) mm, torque and brakes of one bus' axes at a time."""


class PlantShares:
    """Splits `plant` by its axes. Make one `share` a bus and set its `at` before anything steps.

    SYNCs of two buses that belong to one cycle step the plant once: its servos are modelled by whole cycles.
    """

    def __init__(self, plant: PlantAxes, cycle_s: float) -> None:
        self.plant, self._least_s = plant, LEAST_CYCLES * cycle_s
        self._shares: list[PlantShare] = []
        count = len(plant.axes)
        self._target: Array = plant.encoder_mm().copy()
        self._powered: BoolArray = np.zeros(count, np.bool_)
        self._braked: BoolArray = np.ones(count, np.bool_)
        self._force_n: Array = np.full(count, np.nan)
        self._v_max: Array = np.full(count, np.inf)
        self._t_s = -math.inf

    def share(self, axes: tuple[str, ...]) -> PlantShare:
        """The part of the plant that drives of `axes` see."""
        share = PlantShare(self, axes, np.array([self.plant.axes.index(axis) for axis in axes], dtype=np.intp))
        self._shares.append(share)
        return share

    def step(self, stepping: PlantShare, t_s: float, own: tuple[Array, BoolArray, BoolArray]) -> None:
        """Bring the whole plant to `t_s`. Buses whose SYNCs came at one time step it once."""
        t_s = max(t_s, self._t_s)
        for share in self._shares:
            target, powered, braked = own if share is stepping else share.at(t_s)
            rows = share.rows
            self._powered, self._braked = self._powered.copy(), self._braked.copy()
            self._target = self._target.copy()
            self._target[rows], self._powered[rows], self._braked[rows] = target, powered, braked
        if t_s - self._t_s >= self._least_s:
            self._t_s = t_s
            self.plant.step(t_s, self._target, self._powered, self._braked)

    def press(self, share: PlantShare, force_n: Array, v_max_mm_s: Array) -> None:
        """Pass on what the axes of one bus exert, with what those of the others do."""
        self._force_n, self._v_max = self._force_n.copy(), self._v_max.copy()
        self._force_n[share.rows], self._v_max[share.rows] = force_n, v_max_mm_s
        self.plant.press(self._force_n, self._v_max)


class PlantShare:
    """`PlantAxes` for the axes of one bus; `at` says what its drives do when another bus steps the plant."""

    def __init__(self, shares: PlantShares, axes: tuple[str, ...], rows: NDArray[np.intp]) -> None:
        self.axes, self.rows = axes, rows
        self.at: At
        self._shares = shares
        self._whole: Array | None = None
        self._encoder: Array

    def step(self, t_s: float, target_mm: Array, powered: BoolArray, braked: BoolArray) -> None:
        self._shares.step(self, t_s, (target_mm, powered, braked))

    def press(self, force_n: Array, v_max_mm_s: Array) -> None:
        self._shares.press(self, force_n, v_max_mm_s)

    def encoder_mm(self) -> Array:
        """The same array until something moves."""
        whole = self._shares.plant.encoder_mm()
        if whole is not self._whole:
            self._whole, self._encoder = whole, readonly(whole[self.rows])
        return self._encoder

    def following_error_mm(self) -> Array:
        error: Array = self._shares.plant.following_error_mm()[self.rows]
        return error

    def at_rest(self) -> bool:
        return self._shares.plant.at_rest()

    def force_n(self) -> Array:
        force: Array = self._shares.plant.force_n()[self.rows]
        return force
