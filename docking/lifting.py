"""Lift and levelling: the first waypoints of a docking, and the weighing of the part that has been lifted."""

from __future__ import annotations

from math import degrees

from docking import records
from docking.activity import Activity
from docking.errors import IterationsExhausted
from docking.kinematics import pose_from_axes
from docking.knowledge import Knowledge
from docking.motion.weighing import weigh
from docking.planning import check_correction
from docking.planning.load_check import check_load, find_load
from docking.planning.raising import LEVEL_RAD
from docking.progress import Progress
from docking.state import Event
from docking.types import Correction

LEVELLINGS = 3
"""Attempts to come level; two suffice where the frames are right."""


class Lifting:
    """Effects between the first fit and the first alignment, for jobs that ask for them."""

    def __init__(self, known: Knowledge, run: Activity[Progress]) -> None:
        self._known, self._run = known, run

    def needed(self) -> Event | None:
        """What the measured component needs before it may be aligned. Raises IterationsExhausted where levelling does
        not lead to a level component."""
        known, p = self._known, self._known.progress
        raising = known.settings.raising
        if not p.raised_only:
            return None
        if raising.lift_mm > 0.0 and p.made("lift") == 0:
            return Event.LIFT_NEEDED
        tilt_rad = raising.tilt_rad(known.component().X_MN)
        if not raising.level or tilt_rad <= LEVEL_RAD:
            return None
        if p.made("level") >= LEVELLINGS:
            raise IterationsExhausted("level", value=p.made("level"), limit=LEVELLINGS)
        self._run.operator.notify("tilted", tilt_deg=degrees(tilt_rad), limit_deg=degrees(LEVEL_RAD))
        return Event.LEVEL_NEEDED

    async def lift(self) -> Event:
        """Plan the lift, straight up from where the component was measured."""
        known = self._known
        return await self._plan("lift", known.settings.raising.lift(known.component().X_MN))

    async def level(self) -> Event:
        """Plan the levelling. Raises CorrectionTooLarge beyond what a first correction may be."""
        known = self._known
        correction = known.settings.raising.levelling(known.component().X_MN)
        check_correction(correction, known.settings.guard, "level")
        return await self._plan("level", correction)

    async def _plan(self, kind: str, correction: Correction) -> Event:
        known = self._known
        known.progress.stood_at = known.progress.stage
        plan = await known.make(kind, kind, correction, known.settings.raising.speed_mm_s)
        self._run.journal.write("plan", records.plan_record(plan))
        return Event.PLANNED

    async def take_load(self) -> Event:
        """Weigh the part where it hangs now. Raises LoadUnexpected, LoadCellSilent."""
        known = self._known
        settings = known.settings
        weighing = await weigh(known.motion, settings.settle)
        X_WC = pose_from_axes(settings.positioners, weighing.position_mm)
        found = find_load(weighing, X_WC, settings.positioners, settings.plan.load, settings.cells)
        self._run.journal.write("load", vars(found))
        self._run.operator.notify("load", **vars(found))
        check_load(found, settings.plan.load, settings.warp_limit_n)
        return Event.LOAD_TAKEN
