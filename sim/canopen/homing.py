"""Homing of the simulated drives: where each counts from, whether it knows that, and the way to its home switch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from docking.types import Array

HOMING: Final = 6
START, HALT = 1 << 4, 1 << 8
REACHED, ATTAINED, ERROR = 1 << 10, 1 << 12, 1 << 13
_STANDS: Final = (35, 37)
"""Methods that take the present position."""
SEARCH_MM = 40.0
"""So far a drive looks for its switch."""


class Homing:
    """m axes. `shift_mm` (m,) is what a drive counts more than its encoder; `on_zero` is called when that has changed.

    The home switch of every axis is where its encoder reads `switch_mm` (m,); an axis in `blind` never sees it, one in
    `deaf` does not begin, one in `slips` takes a zero that is 1 mm off.
    """

    def __init__(self, count: int, homed: bool, zero_off_mm: float) -> None:
        self.on_zero: Callable[[], None] = lambda: None
        self.shift_mm: Array = np.full(count, zero_off_mm)
        self.switch_mm: Array = np.zeros(count)
        self.method: list[int] = [0] * count
        self.speed_mm_s: Array = np.ones(count)
        self.home_mm: Array = np.zeros(count)
        self.blind: set[int] = set()
        self.deaf: set[int] = set()
        self.slips: set[int] = set()
        self._bits: list[int] = [REACHED | ATTAINED * homed] * count
        self._looking: dict[int, float] = {}
        self._halted: set[int] = set()

    def bits(self, index: int) -> int:
        """Bits 10, 12 and 13 of the statusword in homing mode."""
        return self._bits[index]

    def shown_mm(self, encoder_mm: Array) -> Array:
        """What the drives count (m,)."""
        return encoder_mm + self.shift_mm if self.shift_mm.any() else encoder_mm

    def control(self, index: int, before: int, word: int, encoder_mm: float) -> None:
        """A controlword to an axis that is under torque in homing mode."""
        (self._halted.add if word & HALT else self._halted.discard)(index)
        if word & HALT:
            self._bits[index] |= REACHED
        elif not word & START:
            self._looking.pop(index, None)
        elif not before & START and index not in self.deaf:
            self._bits[index] = 0
            self._looking[index] = 0.0
            if self.method[index] in _STANDS:
                self._take_zero(index, encoder_mm)

    def leave(self, index: int) -> None:
        """The axis is no longer under torque: what was begun is given up."""
        if self._looking.pop(index, None) is not None:
            self._bits[index] |= REACHED

    def step(self, index: int, dt_s: float, now_mm: float) -> float:
        """Set-point of one axis a step later, at constant speed towards its switch."""
        gone = self._looking.get(index)
        if gone is None or index in self._halted:
            return now_mm
        way = float(self.switch_mm[index]) - now_mm
        step = min(float(self.speed_mm_s[index]) * dt_s, SEARCH_MM if index in self.blind else abs(way))
        self._looking[index] = gone + step
        now_mm += step if way >= 0.0 else -step
        if index in self.blind:
            if gone + step >= SEARCH_MM:
                self._looking.pop(index)
                self._bits[index] = REACHED | ERROR
        elif abs(float(self.switch_mm[index]) - now_mm) < 1e-9:
            self._take_zero(index, now_mm)
        return now_mm

    def _take_zero(self, index: int, encoder_mm: float) -> None:
        self.shift_mm = self.shift_mm.copy()
        self.shift_mm[index] = self.home_mm[index] - encoder_mm + (index in self.slips)
        self._looking.pop(index, None)
        self._bits[index] = REACHED | ATTAINED
        self.on_zero()
