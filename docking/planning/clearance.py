"""Least distance of straight edges to boxes: a signed distance, negative inside, exact to `_EXACT_MM`.

The distance to a box is a convex function of the place, so along a straight edge it lies above its tangents at both
ends: that is a lower bound of a whole piece from two points. Pieces that may hold the least value are halved until
bound and value meet; an edge that is parallel to a face is decided at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from docking.types import Array

_EXACT_MM = 0.005
_HALVINGS = 40
_STRIDE = 16

Rows = NDArray[np.intp]


def _distance(points_mm: Array, boxes_mm: Array) -> tuple[Array, Array]:
    """Signed distance (...) and its gradient (..., 3)."""
    low, high = boxes_mm[..., 0, :], boxes_mm[..., 1, :]
    off = points_mm - 0.5 * (low + high)
    over = np.abs(off) - 0.5 * (high - low)
    outside = np.maximum(over, 0.0)
    far = np.sqrt(np.einsum("...i,...i->...", outside, outside))
    deepest = over.max(axis=-1)
    nearest_face = np.arange(3) == np.argmax(over, axis=-1)[..., None]
    direction = np.where(far[..., None] > 0.0, outside / np.maximum(far, 1e-300)[..., None], nearest_face)
    return np.where(far > 0.0, far, deepest), direction * np.sign(off)


@dataclass(frozen=True)
class Nearest:
    """Where the distance least exceeds what is asked: `excess_mm` = distance - asked, in which row of poses, of which
    edge, to which box."""

    excess_mm: float
    distance_mm: float
    row: int
    edge: int
    box: int


Places = Callable[[Rows], Array]
"""Edges (p, e, 2, 3) at the given rows (p,) of a way."""


def nearest_on_way(places: Places, boxes_mm: Array, asked_mm: Array, reach_mm: float) -> Nearest:
    """The least distance less `asked_mm` (n,) over the n rows of a way; `row` counts them.

    `reach_mm`: most that distance less asked can change from one row to the next. A few rows are looked at first; of
    the others only those that could come below their best.
    """
    count = len(asked_mm)
    few = np.unique(np.append(np.arange(0, count, _STRIDE), count - 1))
    edges = places(few)
    best, least = _search(edges, boxes_mm, asked_mm[few])
    rows = np.arange(count)
    left = few[np.searchsorted(few, rows, side="right") - 1]
    right = few[np.minimum(np.searchsorted(few, rows), len(few) - 1)]
    by_row = np.full(count, np.inf)
    by_row[few] = least
    bound = np.maximum(by_row[left] - reach_mm * (rows - left), by_row[right] - reach_mm * (right - rows))
    open_ = np.flatnonzero((bound < best.excess_mm - _EXACT_MM) & ~np.isin(rows, few))
    best = replace(best, row=int(few[best.row]))
    if len(open_) == 0:
        return best
    found = nearest(places(open_), boxes_mm, asked_mm[open_])
    return min(best, replace(found, row=int(open_[found.row])), key=lambda place: place.excess_mm)


def nearest(ends_mm: Array, boxes_mm: Array, asked_mm: Array) -> Nearest:
    """Search edges `ends_mm` (p, e, 2, 3) at p poses, against `boxes_mm` (b, 2, 3), for the least distance less
    `asked_mm` (p,). Needs at least one pose, edge and box."""
    return _search(ends_mm, boxes_mm, asked_mm)[0]


def _search(ends_mm: Array, boxes_mm: Array, asked_mm: Array) -> tuple[Nearest, Array]:
    """The nearest, and a lower bound of distance less asked for each pose (p,)."""
    shape = (len(ends_mm), ends_mm.shape[1], len(boxes_mm))
    row, edge, box = (index.reshape(-1) for index in np.indices(shape))
    start, end = ends_mm[row, edge, 0], ends_mm[row, edge, 1]
    best: Nearest | None = None
    least = np.zeros(len(ends_mm))
    for _ in range(_HALVINGS):
        value, bound = _piece(start, end, boxes_mm[box], asked_mm[row])
        i = int(np.argmin(value))
        least = least if best is not None else bound.reshape(shape[0], -1).min(axis=1)
        if best is None or value[i] < best.excess_mm:
            best = Nearest(float(value[i]), float(value[i] + asked_mm[row[i]]), int(row[i]), int(edge[i]), int(box[i]))
        open_ = np.flatnonzero(bound < best.excess_mm - _EXACT_MM)
        if len(open_) == 0:
            break
        middle = 0.5 * (start[open_] + end[open_])
        start, end = np.concatenate([start[open_], middle]), np.concatenate([middle, end[open_]])
        row, edge, box = (np.tile(index[open_], 2) for index in (row, edge, box))
    assert best is not None
    return best, least


def _piece(start: Array, end: Array, boxes: Array, asked: Array) -> tuple[Array, Array]:
    """Excess (n,) at the nearer end of each piece, and the least that it can be anywhere on it."""
    along = end - start
    length = np.linalg.norm(along, axis=1)
    (first, slope_first), (last, slope_last) = _distance(start, boxes), _distance(end, boxes)
    falling = np.minimum(np.einsum("ni,ni->n", slope_first, along), 0.0)
    rising = np.maximum(np.einsum("ni,ni->n", slope_last, along), 0.0)
    # Tangents first + falling u and last - rising (1 - u): they meet where the convex distance can be least.
    steep = np.maximum(rising - falling, 1e-300)
    u = np.clip((first - last + rising) / steep, 0.0, 1.0)
    tangents = np.maximum(first + falling * u, last - rising * (1.0 - u))
    value = np.minimum(first, last)
    bound = np.minimum(np.maximum(tangents, 0.5 * (first + last - length)), value)
    return value - asked, bound - asked
