"""Axes that follow the part: does each still go along with it?"""

from __future__ import annotations

import numpy as np

from docking.types import Array

PROOF = 5.0
"""An axis that was to go so many times the limit, and did not leave its place by more, goes along."""


class Followed:
    """How far axes that follow the part have come off their places since they last went along with it.

    Lead errors and axis directions take an axis off its place slowly, over much way; a jam does so on the spot. What is
    off is therefore counted from a place that lies one proof back, so that no jam which has begun is part of it.
    """

    def __init__(self, limit_mm: float) -> None:
        self._proof_mm = PROOF * limit_mm
        self.begin()

    def begin(self) -> None:
        """The axes are where they belong: count from here on."""
        self._mark: Array | None = None
        self._base: Array = np.zeros(0)
        self._next: Array = np.zeros(0)

    def off_mm(self, beside_mm: Array, q_ref_mm: Array) -> Array:
        """Change (a,) of `beside_mm` (a,), the axes' places less where the others take them, at `q_ref_mm` (a,)."""
        if self._mark is None:
            self._mark, self._base, self._next = q_ref_mm, np.zeros(len(q_ref_mm)), np.zeros(len(q_ref_mm))
        off: Array = beside_mm - self._base
        gone = np.abs(q_ref_mm - self._mark) >= self._proof_mm
        if gone.any():
            self._base = np.where(gone, self._next, self._base)
            self._next = np.where(gone, beside_mm, self._next)
            self._mark = np.where(gone, q_ref_mm, self._mark)
        return off
