"""The traces of all moves laid end to end on one axis: time in motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from docking.report.run import Move

Array = NDArray[np.float64]

POINTS: Final = 700
"""Most points a drawn line keeps over the whole run; extremes of each stretch are kept, so no peak is lost."""


@dataclass(frozen=True)
class Track:
    """The moves that left a trace, with `starts_s` and `ends_s` of each on the common time axis."""

    moves: tuple[Move, ...]
    starts_s: tuple[float, ...]
    ends_s: tuple[float, ...]

    def line(self, *keys: str) -> tuple[Array, Array]:
        """Time (k,) and value (k,) of the quantity under `keys` in each trace, NaN between moves and where unknown."""
        times: list[Array] = []
        values: list[Array] = []
        total_s = max(self.ends_s[-1], 1e-9)
        for move, start_s, end_s in zip(self.moves, self.starts_s, self.ends_s, strict=True):
            t = _floats(move.moved["trace"]["t_s"])
            v = _floats(_under(move.moved["trace"], keys))
            n = min(len(t), len(v))
            if n:
                kept = envelope(v[:n], max(40, round(POINTS * (end_s - start_s) / total_s)))
                times.append(np.append(t[kept] - t[0] + start_s, end_s))
                values.append(np.append(v[kept], np.nan))
        if not times:
            return np.empty(0), np.empty(0)
        return np.concatenate(times), np.concatenate(values)


def track(moves: list[Move]) -> Track | None:
    """Lay the traces end to end; None when no move left one."""
    traced = [move for move in moves if len((move.moved.get("trace") or {}).get("t_s") or ()) > 1]
    if not traced:
        return None
    starts, ends, clock_s = [], [], 0.0
    for move in traced:
        t = _floats(move.moved["trace"]["t_s"])
        starts.append(clock_s)
        clock_s += float(t[-1] - t[0])
        ends.append(clock_s)
    return Track(tuple(traced), tuple(starts), tuple(ends))


def envelope(values: Array, most: int) -> NDArray[np.intp]:
    """Indices of at most about `most` samples that keep the smallest and largest value of every stretch."""
    n = len(values)
    if n <= most:
        return np.arange(n)
    stretches = max(1, most // 2)
    size = -(-n // stretches)
    padded = np.full(stretches * size, np.nan)
    padded[:n] = values
    rows = padded.reshape(stretches, size)
    first = np.arange(stretches) * size
    lowest = first + np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)
    highest = first + np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)
    kept = np.unique(np.concatenate([lowest, highest, [0, n - 1]]))
    return kept[kept < n]


def _under(trace: dict[str, Any], keys: tuple[str, ...]) -> list[Any]:
    found: Any = trace
    for key in keys:
        found = (found or {}).get(key)
    return found or []


def _floats(values: Any) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
