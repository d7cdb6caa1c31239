"""From a correction to a checked table of axis positions. docs/mechanics.md (27) to (53)."""

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
from docking.planning.mate import Scene, moved_pose, outline_edges
from docking.planning.plan import PlanRequest, make_plan
from docking.planning.playback import position_at
from docking.planning.retreat import Gone, WayBack, retreat_plans
from docking.planning.settings import JamSettings, MateSettings, PlanSettings

__all__ = [
    "Action",
    "Attempt",
    "ConvergenceSettings",
    "Gone",
    "GuardSettings",
    "JamSettings",
    "MateSettings",
    "PlanRequest",
    "PlanSettings",
    "Scene",
    "Verdict",
    "WayBack",
    "attempt",
    "check_correction",
    "correction_to",
    "decide",
    "displaced",
    "make_plan",
    "moved_pose",
    "outline_edges",
    "position_at",
    "retreat_plans",
]
