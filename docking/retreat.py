"""The way back: as many executed moves as the operator asks, confirmed once, each checked anew before it is run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from docking import records
from docking.activity import Activity
from docking.knowledge import UNSEEN, Knowledge, sure
from docking.motion.force_guard import ForceGuard
from docking.motion.weighing import weigh
from docking.planning import Gone, Scene, WayBack, retreat_plans
from docking.progress import Executed, Progress
from docking.state import Event
from docking.types import Plan

BEGIN = "start"
"""Where the first move of the way began."""


class Retreat:
    """Effects of going back. It rests on what was executed, and on the mate as it was last seen; not on a fit."""

    def __init__(self, known: Knowledge, run: Activity[Progress]) -> None:
        self._known, self._run = known, run

    async def plan(self) -> Event:
        """Plan the moves that the operator chooses, or again the next one of those that are agreed."""
        p = self._known.progress
        if p.agreed:
            p.back = await self._plans(1)
        else:
            places = self._places()
            moves = await self._run.operator.how_far(places) if len(places) > 1 else 1
            await self._look_at_the_mate()
            p.back = await self._plans(moves)
            self._run.journal.write("retreat", {"moves": moves, "to": places[moves - 1]})
        for plan in p.back:
            self._run.journal.write("plan", records.plan_record(plan))
        p.plan = p.back[0]
        return Event.PLANNED

    def _places(self) -> tuple[str, ...]:
        """Where one, two ... moves back lead: the stage of the move before."""
        stages = [step.plan.stage for step in self._known.progress.way]
        return (*reversed(stages[:-1]), BEGIN) if stages else ()

    async def _look_at_the_mate(self) -> None:
        """The mate may have moved, or have been moved, since the way was gone; unseen it counts where it was."""
        survey = self._known.survey
        self._run.operator.notify("measuring_mate")
        try:
            await survey.see_references(self._known.settings.X_WM)
        except UNSEEN as error:
            self._run.operator.notify("mate_unseen", error=error)

    async def _plans(self, moves: int) -> tuple[Plan, ...]:
        state, p = self._known, self._known.progress
        asked = WayBack(moves, state.axes_mm(), p.moves + 1, state.motion.speed_limit_mm_s)
        positioners, settings = state.settings.positioners, state.settings.plan

        def plans() -> tuple[Plan, ...]:
            way = [Gone(step.plan, step.path_time_s, step.scene, self._scene_now(step)) for step in p.way]
            return retreat_plans(way, asked, positioners, settings)

        return await state.survey.aside(plans)

    def _scene_now(self, step: Executed) -> Scene:
        approach = self._known.approach
        fit = sure(step.fit, "pose before the move")
        return approach.scene(fit, self._known.mate(), approach.stations[step.stage])

    async def ask(self) -> Event:
        """Show every move back and ask for all of them; one that was agreed, and is as it was shown, goes on."""
        state, p = self._known, self._known.progress
        plan, required = p.back[0], self._required(1)
        p.plan = replace(plan, requires=required)
        if p.agreed and _same(plan, p.agreed[0], state.settings.positioners.driven):
            p.agreed = p.agreed[1:]
            return await self._answered(Event.CONFIRMED, required)
        if p.agreed:
            self._run.operator.notify("way_changed")
        p.agreed = ()
        shown = {"retreatable": False, "passive": state.passive()}
        for each in p.back:
            self._run.operator.show(each, shown)
        required = self._required(len(p.back))
        await self._run.permissives.require(required, plan.stage)
        answer = await self._run.operator.confirm(plan, shown)
        if answer is Event.CONFIRMED:
            p.agreed = p.back[1:]
        return await self._answered(answer, required)

    async def _answered(self, answer: Event, required: tuple[str, ...]) -> Event:
        p, go = self._known.progress, answer is Event.CONFIRMED
        if go:
            await self._run.permissives.again(required, p.back[0].stage)
        left = [plan.plan_hash for plan in p.agreed]
        self._run.journal.write("confirm", {"plan_hash": p.back[0].plan_hash, "go": go, "further": left})
        return answer

    def _required(self, moves: int) -> tuple[str, ...]:
        """Permissives of the stations that the next moves lead back to, and what a person holds."""
        state = self._known
        names = [
            name
            for step in reversed(state.progress.way[-moves:])
            for name in state.approach.stations[step.stage].permissives
        ]
        return tuple(dict.fromkeys([*names, *state.settings.enabling]))

    async def guard(self) -> ForceGuard | None:
        """What watches the balls on the way back, from their forces now; None where not every ball is weighed."""
        state = self._known
        if not np.all(np.isfinite(state.motion.feedback().force_n)):
            return None
        before = await weigh(state.motion, state.settings.settle)
        return ForceGuard.of_change(state.settings.positioners, before.force_n, state.settings.retreat_rise_n)


def _same(plan: Plan, agreed: Plan, driven: NDArray[np.bool_]) -> bool:
    """Whether the driven axes will do what was shown, at the same pace; the others begin where they are."""
    return np.array_equal(plan.q_mm[:, driven], agreed.q_mm[:, driven])
