"""What is asked of a plan and of numbers before anything begins, whatever the bus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.errors import BadArgument, PlanStale
from docking.motion.arbiter import Arbiter, Mode
from docking.motion.monitors import Watch
from docking.motion.triggers import Finding
from docking.types import Array, Feedback, Plan


def require_free(arbiter: Arbiter, *, moving: bool) -> None:
    """Nothing begins during a move or after a fault: raises the fault that is kept, or PlanStale."""
    if arbiter.first is not None:
        raise arbiter.first.error
    if moving:
        raise PlanStale("motion", "a move is running")


def newest(arbiter: Arbiter, feedback: Feedback | None) -> Feedback:
    """The newest read-back. Raises the fault that is kept, or PlanStale before the axes were enabled."""
    if arbiter.first is not None:
        raise arbiter.first.error
    if feedback is None:
        raise PlanStale("motion", "the positioners are not enabled")
    return feedback


def require_enabled(arbiter: Arbiter, watch: Watch, feedback: Feedback | None) -> None:
    """Every axis that is to move has torque, and no stop has taken the power since. Raises what says otherwise."""
    off = watch.power(newest(arbiter, feedback))
    if off is not None:
        raise off
    if arbiter.mode is not Mode.STANDING:
        raise PlanStale("motion", "the axes have to be enabled again")


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
