"""What is known while a docking runs: the files' settings, what was measured, where the axes are, what is planned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from docking.approach import Approach, Station
from docking.errors import DegenerateTargets, PlanStale, TargetLost, TooFewPoints
from docking.planning import PlanRequest, make_plan
from docking.ports import Motion
from docking.procedure_settings import ProcedureSettings
from docking.progress import Progress
from docking.survey import Survey
from docking.types import Array, Correction, Fit, Plan

UNSEEN = (TargetLost, TooFewPoints, DegenerateTargets)
"""Something cannot be measured, as with a blocked line of sight."""


@dataclass
class Knowledge:
    """The files' settings, and how far a docking is by instruments and axes. `approach` follows the temperatures."""

    settings: ProcedureSettings
    approach: Approach
    survey: Survey
    motion: Motion
    progress: Progress

    def station(self) -> Station:
        """The station the component stands at or heads for."""
        return self.approach.stations[self.progress.stage]

    def commanded_mm(self) -> Array:
        """Commanded positions (m,)."""
        return sure(self.progress.commanded_mm, "commanded axis positions")

    def axes_mm(self) -> Array:
        """Commanded positions of the driven axes (m,); a passive axis follows the component and is read back."""
        driven = self.settings.positioners.driven
        return np.where(driven, self.commanded_mm(), self.motion.feedback().position_mm)

    def plan(self) -> Plan:
        """The move that is planned."""
        return sure(self.progress.plan, "plan")

    def component(self) -> Fit:
        """X_WC of the newest fit."""
        return sure(self.progress.X_WC, "pose of the component")

    def mate(self) -> Fit:
        """X_WM of the newest fit."""
        return sure(self.survey.X_WM, "pose of the mate")

    def drift_sigma_mm(self) -> float:
        """What the instrument's station may have drifted since the references were looked at, 1 sigma."""
        return self.survey.drift_sigma_mm(self.settings.drift_mm_per_s)

    def passive(self) -> list[str]:
        """Names of the axes that follow the component."""
        driven = self.settings.positioners.driven
        return [axis for axis, on in zip(self.motion.axes, driven, strict=True) if not on]

    async def make(self, kind: str, stage: str, correction: Correction, speed_mm_s: float) -> Plan:
        """Plan and check a move from where the component was measured; raises as `make_plan`."""
        p, settings = self.progress, self.settings
        fit, mate, station = self.component(), self.mate(), self.station()
        p.kind, p.scene = kind, await self.survey.aside(lambda: self.approach.scene(fit, mate, station))
        request = PlanRequest(
            plan_id=p.moves + 1,
            stage=stage,
            kind=kind,
            q_now_mm=self.axes_mm(),
            correction=correction,
            speed_mm_s=speed_mm_s,
            late_mm_s=self.motion.speed_limit_mm_s,
            period_s=settings.period_s,
            linear_interpolation=settings.linear_interpolation,
            scene=p.scene,
        )
        p.plan = await self.survey.aside(lambda: make_plan(request, settings.positioners, settings.plan))
        return p.plan


T = TypeVar("T")


def sure(value: T | None, what: str) -> T:
    """`value`, which the state table has made sure is there; PlanStale names it if it is not."""
    if value is None:
        raise PlanStale(what, "it is not known in this state")
    return value
