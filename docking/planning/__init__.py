"""From a correction to a checked table of axis positions. Domain 5."""

from docking.planning.correction import (
    Action,
    Attempt,
    ConvergenceSettings,
    GuardSettings,
    Verdict,
    attempt,
    check_correction,
    correction_to,
    decide,
    displaced,
)
from docking.planning.plan import PlanRequest, make_plan
from docking.planning.playback import position_at
from docking.planning.settings import PlanSettings

__all__ = [
    "Action",
    "Attempt",
    "ConvergenceSettings",
    "GuardSettings",
    "PlanRequest",
    "PlanSettings",
    "Verdict",
    "attempt",
    "check_correction",
    "correction_to",
    "decide",
    "displaced",
    "make_plan",
    "position_at",
]
