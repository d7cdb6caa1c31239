"""What the cell shows of a single axis's error, and what a category-0 stop costs: torque off before brakes have closed.

A vertical axis without torque is driven back by the weight: `a t^2 / 2` until its brake holds. One axis alone, or all
of them with brakes that close at different times, force the part out of shape; only a controlled stop first (SS1) does
not. An axis that holds a force holds a position as soon as its brake has closed.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from docking.config.budget import docked_pose
from docking.config.build import load_from, positioners_from
from docking.config.cell import CellFile
from docking.config.job import JobFile
from docking.kinematics import Positioners, internal_force_matrix, warp_rows
from docking.planning.jam import residual_matrix
from docking.types import Array

BLIND_MM = 0.05
"""A millimetre that shows as less than this is not seen: the figure's own errors are as large."""
_MOST_PATTERNS = 12


@dataclass(frozen=True)
class Detectability:
    """What 1 mm of error of one axis of a kind shows, least over the axes of that kind that hold a position: at the
    worst ball and over all balls (rss) in mm, as internal force and as warp in N.

    `seen`: what the monitor of all read-backs shows at the worst ball, mm, where only the encoder errs. Encoders of
    axes that follow count: the part really goes where the axis does."""

    kind: str
    seen: float
    worst_ball: float
    all_balls: float
    force_n: float
    warp_n: float


@dataclass(frozen=True)
class TorqueOff:
    """What torque off costs: one axis alone (`axis`), and all vertical axes with the most different brakes."""

    axis: str
    fall_mm: tuple[float, float]
    one_residual_mm: float
    one_force_n: float
    all_residual_mm: float
    all_force_n: float
    force_limit_n: float

    @property
    def needs_ss1(self) -> bool:
        """True where the part would be strained over the coupling limit; NaN counts as over."""
        return not max(self.one_force_n, self.all_force_n) <= self.force_limit_n


@dataclass(frozen=True, eq=False)
class _Matrices:
    residual: Array
    force: Array
    warp: Array
    read_backs: Array


def _matrices(cell: CellFile, job: JobFile, *, braked: bool = False) -> _Matrices:
    """`braked`: every axis that has a brake holds its position."""
    positioners, up = positioners_from(cell, job), load_from(cell, job).up
    balls = docked_pose(cell, job).apply(positioners.balls_C_mm)
    seen = residual_matrix(_holding(positioners, np.ones(len(positioners.axes), dtype=np.bool_)), balls)
    if braked:
        positioners = _holding(positioners, positioners.powered)
    force, modes = internal_force_matrix(positioners, balls), warp_rows(balls, up)
    vertical = np.einsum("wk,c->wkc", modes, up).reshape(len(modes), len(force))
    return _Matrices(residual_matrix(positioners, balls), force, vertical @ force, seen)


def _holding(positioners: Positioners, axes: NDArray[np.bool_]) -> Positioners:
    """The positioners with these axes (m,) holding a position, and no others anything."""
    none = np.zeros(len(axes))
    return replace(positioners, driven=axes, held_n=none, held_tolerance_n=none)


def _worst(vectors: Array) -> Array:
    """Largest ball vector of each column (3k, n): (n,)."""
    result: Array = np.linalg.norm(vectors.reshape(-1, 3, vectors.shape[1]), axis=1).max(axis=0)
    return result


def detectability(cell: CellFile, job: JobFile) -> tuple[Detectability, ...]:
    """One row for each kind of axis that holds a position somewhere."""
    m, driven = _matrices(cell, job), np.array(cell.driven)
    seen, worst, force = _worst(m.read_backs), _worst(m.residual), _worst(m.force)
    together, warp = np.linalg.norm(m.residual, axis=0), np.abs(m.warp).max(axis=0, initial=0.0)
    found = []
    for kind in "XYZ":
        rows = np.flatnonzero(driven & np.array([name.endswith(f".{kind}") for name in cell.axis_names]))
        if len(rows):
            least = [float(values[rows].min()) for values in (seen, worst, together, force, warp)]
            found.append(Detectability(kind, *least))
    return tuple(found)


def torque_off(cell: CellFile, job: JobFile) -> TorqueOff | None:
    """The cost of a category-0 stop; None where every axis holds itself."""
    m = _matrices(cell, job, braked=True)
    back = np.array([p.back_drive_m_s2 * (axis.name == "Z") for p in cell.positioners for axis in p.axes])
    back *= cell.powered
    brakes = np.array([p.brake_s for p in cell.positioners for _ in p.axes])
    first, last = (500.0 * back[:, None] * brakes**2).T
    rows = np.flatnonzero(last > 0.0)
    if len(rows) == 0:
        return None
    residual, force = _worst(m.residual) * last, _worst(m.force) * last
    k = int(np.argmax(force))
    pattern = _patterns(first, last, rows)
    return TorqueOff(
        cell.axis_names[k],
        (float(first[rows].min()), float(last.max())),
        float(residual[k]),
        float(force[k]),
        float(_worst(m.residual @ pattern).max()),
        float(_worst(m.force @ pattern).max()),
        cell.limits.internal_force_n,
    )


def _patterns(first: Array, last: Array, rows: NDArray[np.intp]) -> Array:
    """Falls (m, n) of the axes `rows` with every combination of earliest and latest brake."""
    free = rows[:_MOST_PATTERNS]
    combinations = np.array(list(itertools.product((False, True), repeat=len(free)))).T
    result = np.repeat(-last[:, None], combinations.shape[1], axis=1)
    result[free] = -np.where(combinations, last[free, None], first[free, None])
    return result


def strain_json(cell: CellFile, job: JobFile) -> dict[str, Any]:
    """The facts for programs."""
    off = torque_off(cell, job)
    return {
        "detectability": [asdict(row) for row in detectability(cell, job)],
        "category_0": None if off is None else {**asdict(off), "needs_ss1": off.needs_ss1},
    }


def strain_text(cell: CellFile, job: JobFile) -> list[str]:
    """What one axis's error shows and what torque off costs, in words."""
    rows = ["1 mm of error of one axis   seen mm   worst ball mm   all balls mm   internal force N   warp N"]
    shown = detectability(cell, job)
    rows += [
        f"  {row.kind:<26}{row.seen:8.2f}{row.worst_ball:16.2f}{row.all_balls:15.2f}"
        f"{row.force_n:19.0f}{row.warp_n:9.0f}"
        for row in shown
    ]
    blind = [row.kind for row in shown if not row.seen >= BLIND_MM]
    if blind:
        rows.append(f"  no read-back shows an encoder of {' or '.join(blind)} that errs: the tracker alone does")
    off = torque_off(cell, job)
    if off is None:
        return [*rows, "category-0 stop: every axis holds itself without torque"]
    low, high = off.fall_mm
    rows += [
        f"category-0 stop: a vertical axis falls {low:.2f} to {high:.2f} mm until its brake has closed",
        f"  {off.axis} alone: {off.one_residual_mm:.2f} mm at the worst ball, {off.one_force_n / 1e3:.2f} kN",
        f"  all axes, brakes at different times: {off.all_residual_mm:.2f} mm, {off.all_force_n / 1e3:.2f} kN (limit "
        f"{off.force_limit_n / 1e3:g} kN)",
    ]
    if off.needs_ss1:
        rows.append("  over the limit: the safety relay has to stop with SS1 (ramp first, torque off after the brakes)")
    return rows
