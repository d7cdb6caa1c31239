"""What the cell does in each state: one coroutine an effect, each answering with an event.

Every measurement, fit, plan, confirmation, intent and result goes to the journal here; an intent is durable before
the first frame of its move leaves.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from docking import records
from docking.activity import Activity
from docking.approach import Approach, Station
from docking.errors import (
    AmbiguousSet,
    DegenerateTargets,
    DockingError,
    FitResidual,
    FrameImplausible,
    NotCongruent,
    PlanStale,
    TargetLost,
    TooFewPoints,
)
from docking.independent_points import IndependentPoints
from docking.kinematics import ball_reactions_n, figure_residual_mm, pose_from_axes, sink_mm
from docking.motion.settle import settle
from docking.motion.weighing import weigh
from docking.planning import Action, Gone, PlanRequest, WayBack, check_correction, make_plan, retreat_plans
from docking.ports import Journal, Motion, Operator
from docking.pose import fit_pose, screen
from docking.procedure_settings import ProcedureSettings
from docking.progress import Progress
from docking.state import Effect, Event
from docking.survey import Survey
from docking.types import Array, Fit, Plan

START_TOLERANCE_MM = 0.05
"""How far an axis may stand from where its plan begins."""

UNSEEN = (TargetLost, TooFewPoints, DegenerateTargets)
"""The component cannot be measured, as with a blocked line of sight: a person clears it, or retreats without a fit."""


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
        self._settings, self._approach, self._survey = settings, approach, survey
        self._devices = (survey.tracker,)
        self._unseen: DockingError | None = None
        self._independent = IndependentPoints(survey, journal, settings.target_residual_mm, self._set_aside)
        self.effects: dict[Effect, Callable[[], Awaitable[Event]]] = {
            Effect.CONNECT: self._connect,
            Effect.ENABLE: self._enable,
            Effect.LOCATE: self._locate,
            Effect.MEASURE: self._measure,
            Effect.OFFER: self._offer,
            Effect.PLAN_RETREAT: self._plan_retreat,
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
        return tuple(station.name for station in self._approach.stations)

    async def _locate(self) -> Event:
        self._take_temperatures()
        self.operator.notify("measuring_references")
        await self._survey.locate(self._settings.X_WT, self._settings.X_WM)
        station = _known(self._survey.X_WT, "station")
        self.operator.notify("located", count=len(station.names), rms_mm=station.rms_mm)
        return Event.FRAME_MEASURED

    def _take_temperatures(self) -> None:
        """Temperatures count from the first measurement on; what nobody measures is as the job states."""
        changed = self._settings.measured(self.motion.inputs())
        if changed is None:
            return
        self._survey.nominals, self._survey.settings = changed.nominals, changed.survey
        self._approach = changed.approach
        for record in changed.records:
            read_c = record["read_c"]
            self.journal.write("temperature", {**record, "read_c": read_c if np.isfinite(read_c) else None})
            if record["part"] != "floor":
                self.operator.notify("temperature", **record, sensor=f"{read_c:.1f}" if np.isfinite(read_c) else "-")

    async def _measure(self) -> Event:
        p = self.progress
        more = p.passes > 0
        passes = self._survey.settings.passes
        guess = pose_from_axes(self._settings.positioners, self._commanded())
        self.operator.notify("measuring_component", passes=passes)
        try:
            await self._survey.measure_component(guess, self._settings.X_WM, passes, more=more)
        except UNSEEN as error:
            self._unseen = error
            return Event.UNSEEN
        p.passes = passes if not more else p.passes + passes
        return Event.MEASURED

    async def _fit(self) -> Event:
        p, survey, settings = self.progress, self._survey, self._survey.settings.component_fit
        measured = _known(survey.component, "component")
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
        self.journal.write("fit", records.fit_record(fit, "component", self._station().name))
        p.rejected |= {r.name for r in fit.rejected}
        if fit.rejected:
            self.operator.notify("left_out", names=", ".join(f"{r.name} ({r.reason})" for r in fit.rejected))
        if not (fit.max_mm <= self._settings.target_residual_mm):
            worst = fit.names[int(np.argmax(np.linalg.norm(fit.residuals_mm, axis=1)))]
            raise FitResidual(worst, value=fit.max_mm, limit=self._settings.target_residual_mm)
        if self._settings.rms_limit_mm is not None and not (fit.rms_mm <= self._settings.rms_limit_mm):
            raise FitResidual("rms", value=fit.rms_mm, limit=self._settings.rms_limit_mm)
        self._check_against_axes(fit)
        p.X_WC, p.fitted_at_s = fit, survey.clock()
        await self._tare()
        return Event.FITTED

    async def _tare(self) -> None:
        """Weigh the part once, before its first move: as unstrained as it was taken. A stress relief starts from it."""
        if self.progress.tared or not np.all(np.isfinite(self.motion.feedback().force_n)):
            return
        self.progress.tared = True
        weighing = await weigh(self.motion, self._settings.settle)
        self.journal.write("tare", records.weighing_record(self.motion.axes, weighing))

    async def _offer(self) -> Event:
        error, p = _known(self._unseen, "measurement"), self.progress
        answer = await self.operator.blocked(error, retreatable=bool(p.way))
        if answer is None:
            raise error
        self.journal.write("unseen", {"error": error.text(), "answer": answer.value})
        p.passes = 0
        return answer

    def _check_against_axes(self, fit: Fit) -> None:
        """The fitted pose must put the balls where the loaded sockets are: finds swapped axes and wrong frames."""
        positioners, load, X_WC = self._settings.positioners, self._settings.plan.load, fit.X_MN
        positioners = replace(positioners, balls_C_mm=fit.grown(positioners.balls_C_mm))
        balls = X_WC.apply(positioners.balls_C_mm)
        weight = load.mass_kg * load.gravity_m_s2
        reactions = ball_reactions_n(positioners, balls, X_WC.apply(load.com_C_mm), weight)[0]
        loaded = figure_residual_mm(positioners, self.motion.feedback().position_mm, X_WC) + sink_mm(
            positioners, reactions
        )
        gaps = np.linalg.norm(loaded, axis=1)
        worst = int(np.argmax(gaps))
        if not (gaps[worst] <= self._settings.plausibility_mm):
            where = f"ball {positioners.names[worst]}"
            raise FrameImplausible(where, value=float(gaps[worst]), limit=self._settings.plausibility_mm)

    async def _judge(self) -> Event:
        p, station = self.progress, self._station()
        fit, mate = self._component_fit(), self._mate_fit()
        drift_mm = self._drift_sigma_mm()
        errors = await self._survey.aside(lambda: self._approach.errors(fit, mate, station, drift_mm))
        p.errors = errors
        when = "before" if p.moves == 0 else "after"
        p.history.append(self._approach.look(errors, station, p.corrections, p.passes))
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
        last = p.passes >= self._approach.convergence.max_passes
        agree = self._independent.check_points(fit, last=last) and self._independent.features(fit, mate, last=last)
        return self._decide(station) if agree else Event.MEASURE_MORE

    def _set_aside(self, error: DockingError) -> None:
        self.progress.rejected.add(error.where)
        self.operator.notify("set_aside", error=error)

    def _decide(self, station: Station) -> Event:
        p, verdict = self.progress, self._approach.verdict(self.progress.history, station)
        if verdict.action is Action.MEASURE_MORE:
            return Event.MEASURE_MORE
        if verdict.action is Action.MOVE:
            correction = self._approach.correction(self._component_fit(), self._mate_fit(), station)
            gap_mm = station.standoff_mm if p.way else None
            check_correction(correction, self._settings.guard, station.name, gap_mm)
            p.corrections, p.kind, p.stood_at = p.corrections + 1, "align", p.stage
            return Event.MOVE_NEEDED
        if verdict.error is not None:
            if verdict.action is Action.ABORT:
                raise verdict.error
            self.alarm(verdict.error)
            return Event.NOT_ACCEPTED
        if station is not self._approach.stations[-1]:
            p.stood_at, p.stage, p.corrections, p.kind, p.history = p.stage, p.stage + 1, 0, "approach", []
            return Event.MOVE_NEEDED
        self.journal.write("features", records.features_record(_known(p.errors, "errors"), station.name, "final"))
        return Event.ACCEPTED

    async def _plan(self) -> Event:
        p, station = self.progress, self._station()
        correction = self._approach.correction(self._component_fit(), self._mate_fit(), station)
        request = PlanRequest(
            plan_id=p.moves + 1,
            stage=station.name,
            kind=p.kind,
            q_now_mm=self._where_axes_are(),
            correction=correction,
            speed_mm_s=min(station.speed_mm_s, self.motion.speed_limit_mm_s),
            period_s=self._settings.period_s,
            linear_interpolation=self._settings.linear_interpolation,
            scene=self._approach.scene(self._component_fit(), self._mate_fit(), station),
        )
        p.plan = await self._survey.aside(lambda: make_plan(request, self._settings.positioners, self._settings.plan))
        goal, rule = self._approach.docked_goal(self._component_fit(), self._mate_fit()), self._approach.goal
        self.journal.write("goal", records.goal_record(goal, rule, self._approach.features.names, station.name))
        self.journal.write("plan", records.plan_record(p.plan))
        return Event.PLANNED

    async def _plan_retreat(self) -> Event:
        """The last move reversed. It rests on what was executed, not on a fit."""
        p = self.progress
        way = [Gone(step.plan, step.path_time_s) for step in p.way]
        asked, settings = WayBack(1, self._where_axes_are(), p.moves + 1), self._settings
        (p.plan,) = await self._survey.aside(lambda: retreat_plans(way, asked, settings.positioners, settings.plan))
        self.journal.write("plan", records.plan_record(p.plan))
        return Event.PLANNED

    async def _ask(self) -> Event:
        plan, p = self._planned(), self.progress
        back = plan.kind == "retreat"
        shown = {**({} if back else await self._deviation()), "retreatable": bool(p.way) and not back}
        shown["passive"] = [
            a for a, on in zip(self.motion.axes, self._settings.positioners.driven, strict=True) if not on
        ]
        self.operator.show(plan, shown)
        station = self._approach.stations[p.way[-1].stage] if back else self._station()
        required = (*station.permissives, *self._settings.enabling)
        p.plan = replace(plan, requires=required)
        await self._permissives.require(required, station.name)
        answer = await self.operator.confirm(plan, shown)
        if answer is Event.CONFIRMED:
            await self._permissives.again(required, station.name)
        self.journal.write("confirm", {"plan_hash": plan.plan_hash, "go": answer is Event.CONFIRMED})
        if answer is Event.CONFIRMED and not back and not (self._fit_age_s() <= self._settings.fit_age_s):
            self.operator.notify("stale", age_s=self._fit_age_s(), limit_s=self._settings.fit_age_s)
            p.passes = 0
            return Event.STALE
        return answer

    def _fit_age_s(self) -> float:
        return self._survey.clock() - self.progress.fitted_at_s

    async def _deviation(self) -> dict[str, Any]:
        """The features' deviation from the goal of the planned move."""
        station, fit, mate, drift_mm = self._station(), self._component_fit(), self._mate_fit(), self._drift_sigma_mm()
        errors = await self._survey.aside(lambda: self._approach.errors(fit, mate, station, drift_mm))
        return records.features_record(errors, station.name, "before")

    async def _move(self) -> Event:
        p, plan = self.progress, self._planned()
        self._check_start(plan)
        self.journal.write("intent", records.intent_record(plan), durable=True)
        await self.motion.load(plan)
        facts = {"kind": plan.kind, "stage": plan.stage, "limited_by": plan.speed_limited_by}
        self.operator.notify("moving", duration_s=plan.duration_s, **facts)
        result = await self.motion.start(plan.plan_hash)
        p.moved(plan, result)
        self.journal.write("moved", records.moved_record(plan, result))
        if result.cause is not None:
            raise result.cause
        if result.result == "done":
            return Event.MOVED
        self.operator.notify("stopped_at", path_time_s=result.path_time_s, duration_s=plan.duration_s)
        return Event.STOPPED

    def _check_start(self, plan: Plan) -> None:
        """Nothing may have moved an axis between planning and confirmation."""
        gaps = np.abs(self.motion.feedback().position_mm - plan.q_mm[0])
        worst = int(np.argmax(gaps))
        if not (gaps[worst] <= START_TOLERANCE_MM):
            raise PlanStale(plan.stage, f"{plan.axes[worst]} stands {gaps[worst]:.3f} mm from the start of the plan")

    async def _settle(self) -> Event:
        rest_s = await settle(self.motion, self._settings.settle)
        self.journal.write("settled", {"t_s": rest_s})
        p = self.progress
        self.operator.notify("moved", residual_mm=p.max_residual_mm, force_n=p.max_internal_force_n)
        return Event.SETTLED

    # what is known ---------------------------------------------------------------------------------------------
    def _station(self) -> Station:
        return self._approach.stations[self.progress.stage]

    def _commanded(self) -> Array:
        return _known(self.progress.commanded_mm, "commanded axis positions")

    def _where_axes_are(self) -> Array:
        """Commanded positions of the driven axes (m,); a passive axis follows the component and is read back."""
        driven = self._settings.positioners.driven
        return np.where(driven, self._commanded(), self.motion.feedback().position_mm)

    def _planned(self) -> Plan:
        return _known(self.progress.plan, "plan")

    def _component_fit(self) -> Fit:
        return _known(self.progress.X_WC, "pose of the component")

    def _mate_fit(self) -> Fit:
        return _known(self._survey.X_WM, "pose of the mate")

    def _drift_sigma_mm(self) -> float:
        return self._survey.drift_sigma_mm(self._settings.drift_mm_per_s)


T = TypeVar("T")


def _known(value: T | None, what: str) -> T:
    """`value`, which the state table has made sure is there; PlanStale names it if it is not."""
    if value is None:
        raise PlanStale(what, "it is not known in this state")
    return value
