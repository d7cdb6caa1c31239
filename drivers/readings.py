"""What both tracker drivers ask of a reading before it becomes a `Reading`. Pure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from docking.errors import BadReply
from docking.types import Array

Covariance = Callable[[Array], Array]
"""Noise model of the device class: point (3,) mm in the station frame -> covariance (3, 3) mm^2."""

DEGRADED_SIGMA_FACTOR = 3.0
"""A usable reading whose accuracy the instrument does not guarantee counts with three times its sigma."""

FROZEN_AFTER = 3
"""So many bit-identical readings of one target in a row are a frozen sensor: noise is larger than the last digit."""


def reading_covariance(model_mm2: Array, reported_sigma_mm: Array, resolution_mm: float, degraded: bool) -> Array:
    """Covariance (3, 3) mm^2 of one reading, from the noise model and from what the instrument says of itself.

    The model carries the shape (a tracker is several times better along its line of sight than across it); the
    three reported sigmas along x, y, z carry none. The model is scaled up as a whole until no reported variance
    exceeds its diagonal, never down: an instrument may know that a reading is worse than its class, not that the
    class is better. A reported sigma is rounded to `resolution_mm`, so half of that is not held against the model;
    0 (nothing reported) leaves the model.
    """
    least_mm2 = np.maximum(reported_sigma_mm - 0.5 * resolution_mm, 0.0) ** 2
    factor = max(1.0, float(np.max(least_mm2 / np.diag(model_mm2))))
    if degraded:
        factor *= DEGRADED_SIGMA_FACTOR**2
    result: Array = model_mm2 * factor
    if not np.all(np.isfinite(result)):
        raise ValueError("the noise model gives no finite covariance")
    return result


def across_at_least(model_mm2: Array, p_T_mm: Array, sigma_rad: float) -> Array:
    """The model (3, 3) mm^2, widened across the line of sight to `p_T_mm` (3,) where the instrument says that its
    angles are worse: `sigma_rad` times the distance. Never narrowed; 0 (nothing reported) leaves the model."""
    distance_mm = float(np.linalg.norm(p_T_mm))
    sight = p_T_mm / distance_mm
    across: Array = np.eye(3) - np.outer(sight, sight)
    model_across_mm2 = 0.5 * float(np.trace(across @ model_mm2))
    result: Array = model_mm2 + max(0.0, (sigma_rad * distance_mm) ** 2 - model_across_mm2) * across
    return result


class FrozenWatch:
    """Recognises a sensor that repeats itself: the same digits for another target, or thrice for one target."""

    def __init__(self) -> None:
        self._last: tuple[float, ...] = ()
        self._target = ""
        self._times = 0

    def check(self, target: str, values: tuple[float, ...]) -> None:
        """Raise BadReply when `values` (the reading as received) cannot be a fresh reading of `target`."""
        same = values == self._last
        changed_target = target != self._target
        self._times = self._times + 1 if same else 1
        self._last, self._target = values, target
        if same and (changed_target or self._times >= FROZEN_AFTER):
            digits = ", ".join(f"{v:g}" for v in values)
            raise BadReply("tracker", f"{target} reads exactly as the one before: the sensor is frozen", value=digits)
