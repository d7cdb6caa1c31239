"""The check of a whole move before its first command: every axis, driven and passive, at every point of the path.

docs/mechanics.md (38), (39) and what follows (41). Each refusal names the axis, where on the path (s), the value and
the limit.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from docking.errors import AxisLimitExceeded, StrokeExceeded
from docking.kinematics import Positioners
from docking.planning.path import RigidPath
from docking.planning.settings import PlanSettings
from docking.types import Array

_ROUNDING = 1e-6


def check_strokes(path: RigidPath, positioners: Positioners, settings: PlanSettings) -> Array:
    """Least distance of each axis to its stroke ends over the path (m,), mm, at one sample per `sample_mm` or denser.

    Raises StrokeExceeded where an axis comes nearer than the margin. An axis that starts outside may only come back:
    its violation must shrink and never grow on the way.
    """
    s = np.linspace(0.0, 1.0, ceil(path.travel_mm / settings.sample_mm) + 2)
    q = path.axes_mm(s)
    low, high = positioners.stroke_mm.T
    least: Array = np.minimum(q.min(axis=0) - low, high - q.max(axis=0))
    for k in np.flatnonzero(~(least >= settings.stroke_margin_mm - _ROUNDING)):
        lacking = settings.stroke_margin_mm - np.minimum(q[:, k] - low[k], high[k] - q[:, k])
        shrinking = bool(np.all(np.diff(np.maximum(lacking, 0.0)) <= 1e-9)) and lacking[-1] < lacking[0]
        if not (lacking[0] > _ROUNDING and shrinking):
            _refuse_stroke(positioners, settings, int(k), s, q[:, k])
    return least


def _refuse_stroke(positioners: Positioners, settings: PlanSettings, k: int, s: Array, q_mm: Array) -> None:
    low, high = positioners.stroke_mm[k] + (settings.stroke_margin_mm, -settings.stroke_margin_mm)
    over = np.maximum(low - q_mm, q_mm - high)
    worst = int(np.argmax(np.where(np.isnan(over), np.inf, over)))
    first = int(np.argmax(~(over <= _ROUNDING)))
    value = float(q_mm[worst])
    fits = f"{100.0 * s[first - 1]:.1f} % of the move fit" if first > 0 else "the start is outside already"
    cause = f"First outside at s = {s[first]:.3f}, worst at s = {s[worst]:.3f}; {fits}."
    raise StrokeExceeded(positioners.axes[k], cause, value=value, limit=float(low if value < low else high))


def check_table(s: Array, q_mm: Array, period_s: float, positioners: Positioners) -> Array:
    """Finite differences of the emitted set-points `q_mm` (n, m), at rest before and after, against v, a, j.

    Returns the peak speed of each axis (m,). Raises AxisLimitExceeded.
    """
    rest = np.broadcast_to(q_mm[0], (3, q_mm.shape[1])), np.broadcast_to(q_mm[-1], (3, q_mm.shape[1]))
    rows = np.ascontiguousarray(np.concatenate([rest[0], q_mm, rest[1]]).T)
    peak_speed: Array = np.zeros(len(rows))
    limits = (
        ("speed in mm/s", positioners.v_mm_s),
        ("acceleration in mm/s^2", positioners.a_mm_s2),
        ("jerk in mm/s^3", positioners.j_mm_s3),
    )
    for order, (what, limit) in enumerate(limits):
        rows = (rows[:, 1:] - rows[:, :-1]) / period_s
        peak = np.abs(np.maximum(rows.max(axis=1), -rows.min(axis=1)))
        if order == 0:
            peak_speed = peak
        k = int(np.argmax(np.where(np.isnan(peak), np.inf, peak / limit)))
        if not peak[k] <= limit[k] * (1.0 + _ROUNDING):
            row = min(max(int(np.argmax(np.abs(rows[k]))) - 2, 0), len(s) - 1)
            fits = 100.0 * float((limit[k] / peak[k]) ** (1.0 / (order + 1))) if peak[k] > 0.0 else 0.0
            cause = f"{what} of the set-points near s = {s[row]:.3f}; {fits:.0f} % of the speed would fit."
            raise AxisLimitExceeded(positioners.axes[k], cause, value=float(peak[k]), limit=float(limit[k]))
    return peak_speed


def chord_error_mm(path: RigidPath, s: Array) -> float:
    """L theta^2 / 8 of the largest turn between two rows of the table; docs/mechanics.md (38)."""
    turn = path.angle_rad * float(np.max(np.diff(s)))
    return path.spread_mm * turn * turn / 8.0


def segments_needed(path: RigidPath, chord_limit_mm: float) -> int:
    """Least number of equal turns that keeps the chord error inside `chord_limit_mm`: theta sqrt(L / (8 delta))."""
    return max(1, ceil(path.angle_rad * sqrt(path.spread_mm / (8.0 * chord_limit_mm)) - 1e-9))


def check_chord(path: RigidPath, s: Array, chord_limit_mm: float) -> float:
    """Chord error of the table, mm. Raises AxisLimitExceeded over the limit, with the segments that would do."""
    error = chord_error_mm(path, s)
    if not error <= chord_limit_mm:
        needed = segments_needed(path, chord_limit_mm)
        cause = f"Chord error in mm over {len(s) - 1} segments; {needed} even turns are needed."
        raise AxisLimitExceeded("interpolation", cause, value=error, limit=chord_limit_mm)
    return error
