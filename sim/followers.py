"""Axes that can hold a force: which of them do now, which are stuck, and which have lost their ball."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from docking.types import Array
from sim.axes import AxisBank
from sim.elastic import Equilibrium

BoolArray = NDArray[np.bool_]


class Followers:
    """The force-controlled axes of a cell, `mask` (m,).

    While one presses, its slip carries it along with the component and its motor rests; while it holds its position,
    the slip is locked and the motor moves. Both together are what its encoder shows.
    """

    def __init__(self, mask: BoolArray, equilibrium: Equilibrium, bank: AxisBank) -> None:
        self.mask = mask
        self.pressing: BoolArray = np.zeros(len(mask), dtype=bool)
        self._equilibrium, self._bank = equilibrium, bank
        self._jammed: set[int] = set()
        self._lost: dict[int, float] = {}
        self._shown: Array = np.full(len(mask), np.nan)
        self._before, self._dt_s = self._shown, 1.0
        self._all_press = False
        self._v_max: Array = np.zeros(len(mask))
        self._force_n: Array = np.zeros(len(mask))
        for index in np.flatnonzero(mask).tolist():
            equilibrium.lock(index, True)

    def press(self, force_n: Array, v_max_mm_s: Array) -> None:
        """From now on these forces (m,); an axis without one (NaN) holds the position that it has, going on as fast as
        it went. `v_max_mm_s` (m,) is how fast an axis may become that meets no resistance."""
        before, self.pressing = self.pressing, np.isfinite(force_n) & self.mask
        self._v_max, self._all_press = v_max_mm_s, bool(self.pressing[self.mask].all())
        self._force_n = np.where(self.pressing, np.nan_to_num(force_n), 0.0)
        self._hold()
        self._bank.let_go(self.pressing)
        for index in np.flatnonzero(self.mask).tolist():
            self._relock(index)
            if before[index] and not self.pressing[index]:
                self._bank.take_up(index, self._speed(index))

    def jam(self, index: int, jammed: bool) -> None:
        """Seize or free one of them mechanically."""
        (self._jammed.add if jammed else self._jammed.discard)(index)
        self._bank.seize(index, jammed)
        self._relock(index)

    def lose(self, index: int, position_mm: float) -> None:
        """The ball is lifted out of the socket of an axis that stands at `position_mm`."""
        self._lost[index] = position_mm
        self._equilibrium.part(index)
        self._hold()

    def run_away(self, dt_s: float, end_mm: Array) -> bool:
        """Let the axes run that press against nothing, up to `end_mm` (m,); True when one moved."""
        moved = False
        for index, position in self._lost.items():
            if self.pressing[index] and index not in self._jammed and position < end_mm[index]:
                self._lost[index] = min(position + float(self._v_max[index]) * dt_s, float(end_mm[index]))
                moved = True
        return moved

    def motor_mm(self, target_mm: Array) -> Array:
        """Set-points (m,) of the motors for set-points of the encoders; an axis that presses heeds none."""
        if self._all_press:
            return target_mm
        result: Array = np.where(self.mask, target_mm - self._equilibrium.slip_mm, target_mm)
        return result

    def shown_mm(self, position_mm: Array) -> Array:
        """What the encoders show (m,): `position_mm`, but for axes that have lost the component."""
        for index, own in self._lost.items():
            position_mm[index] = own
        return position_mm

    def note(self, encoder_mm: Array, dt_s: float) -> None:
        """Keep how fast the axes go, for one that shall hold its position the next moment."""
        self._before, self._shown, self._dt_s = self._shown, encoder_mm, dt_s

    def _speed(self, index: int) -> float:
        speed = float(self._shown[index] - self._before[index]) / self._dt_s
        return 0.0 if math.isnan(speed) else speed

    def _hold(self) -> None:
        """Only what touches the component presses on it."""
        touching = self._force_n.copy()
        touching[list(self._lost)] = 0.0
        self._equilibrium.hold(touching)

    def _relock(self, index: int) -> None:
        if index not in self._lost:
            self._equilibrium.lock(index, index in self._jammed or not bool(self.pressing[index]))
