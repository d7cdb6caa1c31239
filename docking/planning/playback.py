"""Where the axes belong at any path time: between the rows of a plan the part stays rigid."""

from __future__ import annotations

import numpy as np

from docking.types import Array, Plan


def position_at(plan: Plan, path_time_s: float) -> Array:
    """Axis positions (m,) at `path_time_s`, held at both ends; cubic through the four nearest rows.

    Linear interpolation would squeeze the ball figure by L theta^2 / 8 of the turn between two rows.
    """
    i, weights = _weights(plan, path_time_s)
    result: Array = weights @ plan.q_mm[i - 1 : i + 3]
    return result


def coordinate_at(plan: Plan, path_time_s: float) -> float:
    """The path coordinate s at `path_time_s`, of the same interpolation."""
    i, weights = _weights(plan, path_time_s)
    return min(max(float(weights @ plan.s[i - 1 : i + 3]), 0.0), 1.0)


def _weights(plan: Plan, path_time_s: float) -> tuple[int, Array]:
    """Second of the four nearest rows, and what each counts."""
    last = len(plan.t_s) - 1
    x = min(max(path_time_s / plan.period_s, 0.0), float(last))
    i = min(max(int(x), 1), last - 2)
    u = x - i
    before, after, beyond = u + 1.0, u - 1.0, u - 2.0
    return i, np.array(
        [-u * after * beyond / 6.0, before * after * beyond / 2.0, -before * u * beyond / 2.0, before * u * after / 6.0]
    )
