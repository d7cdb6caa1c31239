"""What the cell does in each state: one coroutine an effect, each answering with an event.

Every measurement, fit, plan, confirmation, intent and result goes to the journal here; an intent is durable before
the first frame of its move leaves.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np

from docking import records
from docking.activity import Activity
from docking.approach import Approach, Station
from docking.errors import AmbiguousSet, DockingError, FitResidual, FrameImplausible, NotCongruent, PlanStale
from docking.independent_points import IndependentPoints
from docking.kinematics import ball_reactions_n, figure_residual_mm, pose_from_axes, sink_mm
from docking.knowledge import UNSEEN, Knowledge, sure
from docking.lifting import Lifting
from docking.motion.force_guard import ForceGuard
from docking.motion.settle import settle
from docking.motion.weighing import weigh
from docking.planning import Action, check_correction
from docking.ports import Journal, Motion, Operator
from docking.pose import fit_pose, screen
from docking.procedure_settings import ProcedureSettings
from docking.progress import RAISING, Progress
from docking.retreat import Retreat
from docking.state import Effect, Event
from docking.survey import Survey
from docking.types import Fit, MoveResult, Plan

START_TOLERANCE_MM = 0.05
"""How far an axis may stand from where its plan begins."""


class Procedure(Activity[Progress]):
    """The effects of the state table, and what is known while a docking runs."""

    def __init__(
        self,
        settings: ProcedureSettings,
        approach: Approach,
        survey: Survey,
        motion: Motion,
        journal: Journal,
        operator: Operator,
    ) -> None:
        super().__init__(motion, journal, operator, survey.clock, Progress())
        self.known = Knowledge(settings, approach, survey, motion, self.progress)
        self._survey = survey
        self._devices = (survey.tracker,)
        self._lifting = Lifting(self.known, self)
        self._retreat = Retreat(self.known, self)
        self._unseen: DockingError | None = None
        self._independent = IndependentPoints(survey, journal, settings.target_residual_mm, self._set_aside)
        self.effects: dict[Effect, Callable[[], Awaitable[Event]]] = {
            Effect.CONNECT: self._connect,
            Effect.ENABLE: self._enable,
            Effect.LOCATE: self._locate,
            Effect.MEASURE: self._measure,
            Effect.OFFER: self._offer,
            Effect.PLAN_RETREAT: self._retreat.plan,
            Effect.ASK_BACK: self._retreat.ask,
            Effect.LIFT: self._lifting.lift,
            Effect.TAKE_LOAD: self._lifting.take_load,
            Effect.LEVEL: self._lifting.level,
            Effect.FIT: self._fit,
            Effect.JUDGE: self._judge,
            Effect.PLAN: self._plan,
            Effect.ASK: self._ask,
            Effect.MOVE: self._move,
            Effect.SETTLE: self._settle,
        }

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stations, in order."""
        return tuple(station.name for station in self.known.approach.stations)

    async def _locate(self) -> Event:
        self._take_temperatures()
        self.operator.notify("measuring_references")
        await self._survey.locate(self.known.settings.X_WT, self.known.settings.X_WM)
        station = sure(self._survey.X_WT, "station")
        self.operator.notify("located", count=len(station.names), rms_mm=station.rms_mm)
        return Event.FRAME_MEASURED

    def _take_temperatures(self) -> None:
        """Temperatures count from the first measurement on; what nobody measures is as the job states."""
        changed = self.known.settings.measured(self.motion.inputs())
        if changed is None:
            return
        self._survey.nominals, self._survey.settings = changed.nominals, changed.survey
        self.known.approach = changed.approach
        for record in changed.records:
            read_c = record["read_c"]
            self.journal.write("temperature", {**record, "read_c": read_c if np.isfinite(read_c) else None})
            if record["part"] != "floor":
                self.operator.notify("temperature", **record, sensor=f"{read_c:.1f}" if np.isfinite(read_c) else "-")

    async def _measure(self) -> Event:
        p = self.progress
        more = p.passes > 0
        passes = self._survey.settings.passes
        guess = pose_from_axes(self.known.settings.positioners, self.known.commanded_mm())
        self.operator.notify("measuring_component", passes=passes)
        try:
            await self._survey.measure_component(guess, self.known.settings.X_WM, passes, more=more)
        except UNSEEN as error:
            self._unseen = error
            return Event.UNSEEN
        p.passes = passes if not more else p.passes + passes
        return Event.MEASURED

    async def _fit(self) -> Event:
        p, survey, settings = self.progress, self._survey, self._survey.settings.component_fit
        measured = sure(survey.component, "component")
        try:
            fit = await self._survey.aside(
                lambda: fit_pose(screen(survey.nominals.targets, measured, settings), settings)
            )
        except (NotCongruent, AmbiguousSet) as refusal:
            # With a third reading of every point the screening can tell a bad reading from a bad point.
            if p.passes >= 2 * survey.settings.passes:
                raise
            self.operator.notify("again", error=refusal)
            return Event.MEASURE_MORE
        except UNSEEN as error:
            self._unseen = error
            return Event.UNSEEN
        self.journal.write("fit", records.fit_record(fit, "component", self.known.station().name))
        p.rejected |= {r.name for r in fit.rejected}
        if fit.rejected:
            self.operator.notify("left_out", names=", ".join(f"{r.name} ({r.reason})" for r in fit.rejected))
        if not (fit.max_mm <= self.known.settings.target_residual_mm):
            worst = fit.names[int(np.argmax(np.linalg.norm(fit.residuals_mm, axis=1)))]
            raise FitResidual(worst, value=fit.max_mm, limit=self.known.settings.target_residual_mm)
        if self.known.settings.rms_limit_mm is not None and not (fit.rms_mm <= self.known.settings.rms_limit_mm):
            raise FitResidual("rms", value=fit.rms_mm, limit=self.known.settings.rms_limit_mm)
        self._check_against_axes(fit)
        p.X_WC, p.fitted_at_s = fit, survey.clock()
        await self._tare()
        return Event.FITTED

    async def _tare(self) -> None:
        """Weigh the part once, before its first move: as unstrained as it was taken. A stress relief starts from it."""
        if self.progress.tared or not np.all(np.isfinite(self.motion.feedback().force_n)):
            return
        self.progress.tared = True
        weighing = await weigh(self.motion, self.known.settings.settle)
        self.journal.write("tare", records.weighing_record(self.motion.axes, weighing))

    async def _offer(self) -> Event:
        error, p = sure(self._unseen, "measurement"), self.progress
        answer = await self.operator.blocked(error, retreatable=bool(p.way))
        if answer is None:
            raise error
        self.journal.write("unseen", {"error": error.text(), "answer": answer.value})
        p.passes = 0
        return answer

    def _check_against_axes(self, fit: Fit) -> None:
        """The fitted pose must put the balls where the loaded sockets are: finds swapped axes and wrong frames."""
        positioners, load, X_WC = self.known.settings.positioners, self.known.settings.plan.load, fit.X_MN
        positioners = replace(positioners, balls_C_mm=fit.grown(positioners.balls_C_mm))
        balls = X_WC.apply(positioners.balls_C_mm)
        weight = load.mass_kg * load.gravity_m_s2
        reactions = ball_reactions_n(positioners, balls, X_WC.apply(load.com_C_mm), weight)[0]
        loaded = figure_residual_mm(positioners, self.motion.feedback().position_mm, X_WC) + sink_mm(
            positioners, reactions
        )
        gaps = np.linalg.norm(loaded, axis=1)
        worst = int(np.argmax(gaps))
        if not (gaps[worst] <= self.known.settings.plausibility_mm):
            where = f"ball {positioners.names[worst]}"
            raise FrameImplausible(where, value=float(gaps[worst]), limit=self.known.settings.plausibility_mm)

    async def _judge(self) -> Event:
        p, station, approach = self.progress, self.known.station(), self.known.approach
        fit, mate, drift_mm = self.known.component(), self.known.mate(), self.known.drift_sigma_mm()
        raising = self._lifting.needed()
        if raising is not None:
            return raising if self._agreed(fit, mate) else Event.MEASURE_MORE
        errors = await self._survey.aside(lambda: approach.errors(fit, mate, station, drift_mm))
        p.errors = errors
        p.history.append(approach.look(errors, station, p.corrections, p.passes))
        when = "before" if p.moves == p.made(*RAISING) else "after"
        self.journal.write("features", records.features_record(errors, station.name, when))
        i = errors.worst()
        self.operator.notify(
            "off",
            stage=station.name,
            feature=errors.names[i],
            error_mm=float(errors.norm_mm[i]),
            sigma_mm=float(errors.sigma_mm[i]),
            tolerance_mm=float(errors.tolerance_mm[i]),
        )
        return await self._decide(station) if self._agreed(fit, mate) else Event.MEASURE_MORE

    def _agreed(self, fit: Fit, mate: Fit) -> bool:
        """Whether the points kept out of the fits agree with them; False asks for more passes."""
        last = self.progress.passes >= self.known.approach.convergence.max_passes
        return self._independent.check_points(fit, last=last) and self._independent.features(fit, mate, last=last)

    def _set_aside(self, error: DockingError) -> None:
        self.progress.rejected.add(error.where)
        self.operator.notify("set_aside", error=error)

    async def _decide(self, station: Station) -> Event:
        p, approach = self.progress, self.known.approach
        verdict = approach.verdict(p.history, station)
        if verdict.action is Action.MEASURE_MORE:
            return Event.MEASURE_MORE
        if verdict.action is Action.MOVE:
            fit, mate = self.known.component(), self.known.mate()
            correction = await self._survey.aside(lambda: approach.correction(fit, mate, station))
            gap_mm = None if p.raised_only else station.standoff_mm
            check_correction(correction, self.known.settings.guard, station.name, gap_mm)
            p.corrections, p.kind, p.stood_at = p.corrections + 1, "align", p.stage
            return Event.MOVE_NEEDED
        if verdict.error is not None:
            if verdict.action is Action.ABORT:
                raise verdict.error
            self.alarm(verdict.error)
            return Event.NOT_ACCEPTED
        if station is not approach.stations[-1]:
            p.stood_at, p.stage, p.corrections, p.kind, p.history = p.stage, p.stage + 1, 0, "approach", []
            return Event.MOVE_NEEDED
        self.journal.write("features", records.features_record(sure(p.errors, "errors"), station.name, "final"))
        return Event.ACCEPTED

    async def _plan(self) -> Event:
        state, station, approach = self.known, self.known.station(), self.known.approach
        fit, mate = state.component(), state.mate()
        correction = await self._survey.aside(lambda: approach.correction(fit, mate, station))
        plan = await state.make(self.progress.kind, station.name, correction, station.speed_mm_s)
        goal = await self._survey.aside(lambda: approach.docked_goal(fit, mate))
        names = approach.features.names
        self.journal.write("goal", records.goal_record(goal, approach.goal, names, station.name))
        self.journal.write("plan", records.plan_record(plan))
        return Event.PLANNED

    async def _ask(self) -> Event:
        plan, p, station = self.known.plan(), self.progress, self.known.station()
        deviation = {} if plan.kind in RAISING else await self._deviation()
        shown = {**deviation, "retreatable": bool(p.way), "passive": self.known.passive()}
        self.operator.show(plan, shown)
        required = (*station.permissives, *self.known.settings.enabling)
        p.plan = replace(plan, requires=required)
        await self.permissives.require(required, station.name)
        answer = await self.operator.confirm(plan, shown)
        if answer is Event.CONFIRMED:
            await self.permissives.again(required, station.name)
        self.journal.write("confirm", {"plan_hash": plan.plan_hash, "go": answer is Event.CONFIRMED})
        if answer is Event.CONFIRMED and not (self._fit_age_s() <= self.known.settings.fit_age_s):
            self.operator.notify("stale", age_s=self._fit_age_s(), limit_s=self.known.settings.fit_age_s)
            p.passes = 0
            return Event.STALE
        return answer

    def _fit_age_s(self) -> float:
        return self._survey.clock() - self.progress.fitted_at_s

    async def _deviation(self) -> dict[str, Any]:
        """The features' deviation from the goal of the planned move."""
        state, station = self.known, self.known.station()
        fit, mate, drift_mm = state.component(), state.mate(), state.drift_sigma_mm()
        errors = await self._survey.aside(lambda: state.approach.errors(fit, mate, station, drift_mm))
        return records.features_record(errors, station.name, "before")

    async def _move(self) -> Event:
        p, plan = self.progress, self.known.plan()
        self._check_start(plan)
        guard = await self._retreat.guard() if plan.kind == "retreat" else None
        self.journal.write("intent", records.intent_record(plan))
        await self.journal.sync()
        await self.motion.load(plan)
        facts = {"kind": plan.kind, "stage": plan.stage, "limited_by": plan.speed_limited_by}
        self.operator.notify("moving", duration_s=plan.duration_s, **facts)
        result, cause = await self._run(plan, guard)
        p.moved(plan, result)
        self.journal.write("moved", records.moved_record(plan, result))
        if cause is not None:
            raise cause
        if result.result == "done":
            return Event.MOVED
        self.operator.notify("stopped_at", path_time_s=result.path_time_s, duration_s=plan.duration_s)
        return Event.STOPPED

    async def _run(self, plan: Plan, guard: ForceGuard | None) -> tuple[MoveResult, Exception | None]:
        if guard is not None:
            return await guard.run(self.motion, plan.plan_hash)
        result = await self.motion.start(plan.plan_hash)
        return result, result.cause

    def _check_start(self, plan: Plan) -> None:
        """Nothing may have moved an axis between planning and confirmation."""
        gaps = np.abs(self.motion.feedback().position_mm - plan.q_mm[0])
        worst = int(np.argmax(gaps))
        if not (gaps[worst] <= START_TOLERANCE_MM):
            raise PlanStale(plan.stage, f"{plan.axes[worst]} stands {gaps[worst]:.3f} mm from the start of the plan")

    async def _settle(self) -> Event:
        rest_s = await settle(self.motion, self.known.settings.settle)
        self.journal.write("settled", {"t_s": rest_s})
        p, plan = self.progress, self.known.plan()
        self.operator.notify("moved", residual_mm=p.max_residual_mm, force_n=p.max_internal_force_n)
        if p.agreed:
            return Event.RETREAT
        return Event.LIFTED if plan.kind == "lift" else Event.SETTLED
