"""Stress relief: weigh, ask, one small step, weigh again, until the part is free of strain.

The only relative move of single axes under load. A supervisor asks for every step; each takes at most 0.05 mm at
0.1 mm/s, and it ends for good when a ball's force rises or the strain does not fall.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from docking import records
from docking.activity import Activity
from docking.errors import ForceRose, ForeignForce, NotRelieved, PlanStale
from docking.kinematics import Positioners
from docking.motion.force_guard import ForceGuard
from docking.motion.settle import SettleSettings
from docking.motion.weighing import weigh
from docking.planning import PlanSettings
from docking.planning.relief import ReliefSettings, Scales, StepRequest, Strain, Tare, Weighing, relief_plan
from docking.ports import Journal, Motion, Operator
from docking.progress import Standing
from docking.state import Effect, Event
from docking.types import Plan


@dataclass(frozen=True, eq=False)
class ReliefRun:
    """What a relief needs of the files and of who asks for it: `supervisor` by name, `tare` where one is known,
    `permissives` that must be given before the first step and during each."""

    positioners: Positioners
    plan: PlanSettings
    relief: ReliefSettings
    settle: SettleSettings
    period_s: float
    permissives: tuple[str, ...]
    supervisor: str
    tare: Tare | None


@dataclass
class ReliefProgress(Standing):
    """Where a relief stands: the strain before the first step, now, and the step that is planned."""

    steps: int = 0
    stalled: int = 0
    lowest_n: float = float("inf")
    first: Strain | None = None
    strain: Strain | None = None
    weighing: Weighing | None = None


class Relief(Activity[ReliefProgress]):
    """The effects of a relief run; the same interface to `docking.cell.Cell` as a docking's procedure."""

    def __init__(
        self,
        run: ReliefRun,
        motion: Motion,
        journal: Journal,
        operator: Operator,
        clock: Callable[[], float],
    ) -> None:
        super().__init__(motion, journal, operator, clock, ReliefProgress())
        self.run = run
        self.effects: dict[Effect, Callable[[], Awaitable[Event]]] = {
            Effect.CONNECT: self._connect,
            Effect.ENABLE: self._enable,
            Effect.WEIGH: self._weigh,
            Effect.STEP: self._step,
        }

    async def _weigh(self) -> Event:
        """Judge the strain that is left, and what the last step did; then have the next step asked for."""
        run, p = self.run, self.progress
        weighing = await weigh(self.motion, run.settle)
        scales = Scales(run.positioners, run.plan, run.relief, weighing.position_mm)
        strain = scales.strain(weighing, run.tare)
        self._keep(strain, weighing)
        if p.strain is not None:
            self._check_rise(scales, p.strain, strain)
        self._check_foreign(strain)
        p.weighing, p.strain, p.first = weighing, strain, p.first or strain
        if self._relieved(strain):
            return Event.RELIEVED
        if p.steps == 0:
            await self._declare()
        p.plan = self._next_plan(scales, strain, weighing)
        self.operator.show(p.plan, {"passive": self._passive()})
        facts = {"number": p.plan.plan_id, "force_n": strain.largest_n, "duration_s": p.plan.duration_s}
        asked = await self.operator.hold_to_run(facts)
        self.journal.write("confirm", {"plan_hash": p.plan.plan_hash, "go": asked, "supervisor": run.supervisor})
        if asked:
            return Event.STEP_ASKED
        self.operator.notify("released")
        return Event.RELEASED

    def _keep(self, strain: Strain, weighing: Weighing) -> None:
        names = self.run.positioners.names
        self.journal.write("strain", records.strain_record(names, strain, self.motion.axes, weighing))
        worst = names[int(np.argmax(strain.ball_n))]
        facts = {"ball": worst, "force_n": strain.largest_n, "sigma_n": strain.sigma_n}
        if self.run.tare is not None:
            self.operator.notify("strain_since_tare", **facts)
        else:
            self.operator.notify("strain_absolute", **facts)

    def _check_foreign(self, strain: Strain) -> None:
        """What neither weight nor strain explains comes from outside: relief would pull the part against it."""
        over = ~(strain.foreign_n <= strain.foreign_limit_n)
        if over.any():
            i = int(np.argmax(over))
            value, limit = float(strain.foreign_n[i]), float(strain.foreign_limit_n[i])
            raise ForeignForce(f"ball {self.run.positioners.names[i]}", value=value, limit=limit)

    def _check_rise(self, scales: Scales, before: Strain, now: Strain) -> None:
        """No ball may carry more than 5 % more than before the step; nor may the strain itself grow."""
        ForceGuard(self.run.positioners, before.force_n, scales.rise_limit_n(before)).check(now.force_n)
        slack = max(self.run.relief.rise * before.largest_n, float(scales.floor_n().max()))
        grown = now.largest_n - before.largest_n
        if not (grown <= slack):
            raise ForceRose("internal force", value=grown, limit=slack)

    def _relieved(self, strain: Strain) -> bool:
        """Whether the relief is at its end; raises NotRelieved when it goes no further and the target is not met."""
        p, relief = self.progress, self.run.relief
        p.stalled = 0 if strain.largest_n < p.lowest_n else p.stalled + 1
        p.lowest_n = min(p.lowest_n, strain.largest_n)
        if strain.largest_n <= relief.aim * relief.target_n:
            return True
        if p.stalled < relief.stalled_steps:
            return False
        if strain.largest_n <= relief.target_n:
            return True
        cause = f"{p.stalled} steps in a row without any fall."
        raise NotRelieved("part", cause, value=strain.largest_n, limit=relief.target_n)

    async def _declare(self) -> None:
        await self.permissives.require(self.run.permissives, "relief")

    def _next_plan(self, scales: Scales, strain: Strain, weighing: Weighing) -> Plan:
        run, p = self.run, self.progress
        if p.commanded_mm is None:
            raise PlanStale("relief", "the positioners are not enabled")
        q_now = np.where(run.positioners.driven, p.commanded_mm, weighing.position_mm)
        request = StepRequest(p.steps + 1, q_now, scales.step_mm(strain, weighing), run.period_s)
        plan = relief_plan(request, run.positioners, run.plan, run.relief)
        self.journal.write("plan", records.plan_record(plan))
        return plan

    def _passive(self) -> list[str]:
        driven = self.run.positioners.driven
        return [axis for axis, on in zip(self.motion.axes, driven, strict=True) if not on]

    async def _step(self) -> Event:
        p = self.progress
        if p.plan is None or p.strain is None:
            raise PlanStale("relief", "no step is planned")
        self.journal.write("intent", records.intent_record(p.plan))
        await self.journal.sync()
        await self.motion.load(replace(p.plan, requires=self.run.permissives))
        result, cause = await self._guard(p.plan, p.strain).run(self.motion, p.plan.plan_hash)
        p.steps, p.commanded_mm, p.result = p.steps + 1, result.commanded_mm, result
        self.journal.write("moved", records.moved_record(p.plan, result))
        if cause is not None:
            raise cause
        return Event.MOVED if result.result == "done" else Event.STOPPED

    def _guard(self, plan: Plan, before: Strain) -> ForceGuard:
        run = self.run
        scales = Scales(run.positioners, run.plan, run.relief, plan.q_mm[0])
        return ForceGuard(run.positioners, before.force_n, scales.rise_limit_n(before))


def summary_of(relief: Relief) -> dict[str, Any]:
    """What a relief came to, for the journal and `--json`."""
    progress, run = relief.progress, relief.run
    first, last = progress.first, progress.strain
    return {
        "supervisor": run.supervisor,
        "steps": progress.steps,
        "internal_force_before_n": None if first is None else first.largest_n,
        "internal_force_n": None if last is None else last.largest_n,
        "sigma_n": None if last is None else last.sigma_n,
        "target_n": run.relief.target_n,
        "tared": run.tare is not None,
        "alarms": [records.alarm_record(a) for a in progress.alarms],
    }
