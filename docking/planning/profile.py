"""Straight pieces of a plan for drives that go to a target by their own ramps (profile position).

docs/mechanics.md (41). Speeds, accelerations and decelerations in the proportion of the ways keep all axes at one
fraction of a piece at any time, on the way, while ramping and in a halt: the axes trace a straight line from rest to
rest. What is left is how far the rigid path bends away from it, what the drives' whole counts round, and how far apart
they begin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from docking.errors import StrainForeseen
from docking.types import Array, readonly


@dataclass(frozen=True)
class ProfileLimits:
    """`chord_mm`: how far an axis may be off its straight line; `ramp_s`: from rest to full speed, and back; `skew_s`:
    largest time between the beginnings of two drives; `counts_per_mm` of their speeds; `residual_mm`: what all of it
    may squeeze the ball figure."""

    chord_mm: float
    ramp_s: float
    skew_s: float
    counts_per_mm: float
    residual_mm: float


@dataclass(frozen=True, eq=False)
class ProfilePiece:
    """Rows `first` to `last` of a plan as one straight motion from rest to rest.

    `start_mm`, `end_mm` (d,); `speed_mm_s`, `acceleration_mm_s2` (d,) in the proportion of the ways; `fraction`
    (last - first + 1,) of the way at each row, 0 to 1; `duration_s` from rest to rest.
    """

    first: int
    last: int
    start_mm: Array
    end_mm: Array
    speed_mm_s: Array
    acceleration_mm_s2: Array
    fraction: Array
    duration_s: float


def profile_pieces(q_mm: Array, peak_mm_s: Array, limits: ProfileLimits) -> tuple[ProfilePiece, ...]:
    """Cut the rows `q_mm` (n, d) into the fewest straight pieces inside the chord limit, greedily.

    No axis is faster than its peak in the plan, `peak_mm_s` (d,). Raises StrainForeseen where bend, rounding and skew
    together could squeeze the figure by more than the limit.
    """
    pieces, first = [], 0
    while first < len(q_mm) - 1:
        last = _farthest(q_mm, first, limits.chord_mm)
        pieces.append(_piece(q_mm, first, last, peak_mm_s, limits))
        first = last
    for piece in pieces:
        # Whole counts a second: an axis may be off by half of one for as long as the piece lasts.
        rounding_mm = 0.5 * piece.duration_s / limits.counts_per_mm
        residual_mm = 2.0 * (limits.chord_mm + rounding_mm) + float(piece.speed_mm_s.max()) * limits.skew_s
        if not (residual_mm <= limits.residual_mm):
            cause = "synchronous profile position: bend, rounding and start skew of a straight piece"
            raise StrainForeseen("bus", cause, value=residual_mm, limit=limits.residual_mm)
    return tuple(pieces)


def _farthest(q_mm: Array, first: int, chord_mm: float) -> int:
    """The last row that a straight line from `first` reaches without leaving the rows between by more."""
    low, high = first + 1, len(q_mm) - 1
    if _bend_mm(q_mm[first : high + 1]) <= chord_mm:
        return high
    while high - low > 1:
        middle = (low + high) // 2
        if _bend_mm(q_mm[first : middle + 1]) <= chord_mm:
            low = middle
        else:
            high = middle
    return low


def _fractions(rows_mm: Array) -> Array:
    """How much of the way from the first to the last row each row has behind it (n,)."""
    way = rows_mm[-1] - rows_mm[0]
    length = float(way @ way)
    if length == 0.0:
        return np.linspace(0.0, 1.0, len(rows_mm))
    fraction: Array = np.maximum.accumulate(np.clip((rows_mm - rows_mm[0]) @ way / length, 0.0, 1.0))
    return fraction


def _bend_mm(rows_mm: Array) -> float:
    """Largest distance of any axis from its straight line."""
    line = rows_mm[0] + _fractions(rows_mm)[:, None] * (rows_mm[-1] - rows_mm[0])
    return float(np.abs(rows_mm - line).max())


def _piece(q_mm: Array, first: int, last: int, peak_mm_s: Array, limits: ProfileLimits) -> ProfilePiece:
    rows = q_mm[first : last + 1]
    way = np.abs(rows[-1] - rows[0])
    moving = way > 0.0
    # Fractions a second: the axis that comes to its peak first decides; a short piece is all ramp.
    rate = float(np.min(peak_mm_s[moving] / way[moving])) if moving.any() else 1.0
    ramp_s = limits.ramp_s
    acceleration = rate / ramp_s
    if rate * ramp_s > 1.0:
        rate = acceleration**0.5
        ramp_s = rate / acceleration
    return ProfilePiece(
        first=first,
        last=last,
        start_mm=readonly(rows[0]),
        end_mm=readonly(rows[-1]),
        speed_mm_s=readonly(way * rate),
        acceleration_mm_s2=readonly(way * acceleration),
        fraction=readonly(_fractions(rows)),
        duration_s=1.0 / rate + ramp_s,
    )
