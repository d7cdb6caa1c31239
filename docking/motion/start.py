"""What is asked of a plan and of numbers before anything begins, whatever the bus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument, PlanStale
from docking.motion.triggers import Finding
from docking.types import Array, Plan


def require_here(plan: Plan, commanded_mm: Array, driven: NDArray[np.bool_], tolerance_mm: float) -> None:
    """A plan begins where the driven axes are commanded (m,). Raises PlanStale."""
    gap = float(np.max(np.abs(plan.q_mm[0] - commanded_mm)[driven]))
    if not (gap <= tolerance_mm):
        raise PlanStale(plan.stage, f"it starts {gap:.4f} mm from where the axes are commanded")


def require(objection: Finding | None) -> None:
    """Raise what forbids a start; nothing is kept, as the next start is judged anew."""
    if objection is not None:
        raise objection.error


def share_of(percent: float) -> float:
    """The rate of path time that a speed override of 0..100 % asks for. Raises BadArgument."""
    if not (0.0 <= percent <= 100.0):
        raise BadArgument("speed override", value=percent, limit="0 to 100 %")
    return percent / 100.0
