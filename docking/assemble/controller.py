"""The controller of a cell: settings from the files, drivers on the given wires, the loop on top."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from docking.approach import Approach, Station
from docking.assemble.live import watched_motion
from docking.assemble.motion_side import local_motion, motion_beside
from docking.assemble.wires import Wires
from docking.cell import Cell
from docking.config import CellFile, JobFile
from docking.config.budget import noise_of
from docking.config.build import (
    convergence_settings,
    guard_settings,
    plan_period_s,
    plan_settings,
    positioners_from,
    relief_settings,
)
from docking.config.nominal import (
    ers_points,
    feature_points,
    goal_rule,
    mate_feature_points,
    measured_features,
    target_points,
)
from docking.config.raising import raising_from
from docking.config.temperatures import part_temperatures, with_temperatures
from docking.geometry import pose_from_vector
from docking.kinematics import Positioners
from docking.live import LiveListeners, ReportingMotion
from docking.motion.settle import SettleSettings
from docking.ports import Aside, Journal, Operator, SerialLink, Tracker, at_once
from docking.pose import Features, FitSettings
from docking.procedure import Procedure
from docking.procedure_settings import Measured, ProcedureSettings
from docking.survey import Nominals, Survey, SurveySettings
from docking.types import Array, InputState
from drivers.geocom_tracker import GeocomTracker
from drivers.line_tracker import LineTracker

__all__ = ["Company", "Wires", "build_cell"]

AGREEING_POINTS = 4
"""Points that must agree before the cell believes a fit: three have nothing left to prove them wrong."""


RETREAT_RISE = 0.75
"""How far a ball's force may rise on the way back, as a share of the internal force that stops any other move."""


@dataclass(frozen=True)
class Company:
    """Who a run works with: the journal, the operator, the clock of the loop, who works out what takes long; `step`
    says that a person asks for every move."""

    journal: Journal
    operator: Operator
    clock: Callable[[], float]
    aside: Aside = at_once
    step: bool = False


def build_cell(
    cell: CellFile, job: JobFile, wires: Wires, company: Company, motion: ReportingMotion | None = None
) -> Cell[Procedure]:
    """The whole controller of one docking; without `motion` the motion side runs on this very loop."""
    positioners = positioners_from(cell, job)
    if motion is None:
        motion = motion_beside(cell, local_motion(cell, job, wires))
    watched = watched_motion(cell, job, motion, wires.streams) if cell.live is not None else None
    survey = Survey(
        tracker=tracker_of(cell, wires.serial),
        journal=company.journal,
        nominals=_nominals(cell, job),
        settings=_survey_settings(cell, job),
        clock=company.clock,
        aside=company.aside,
    )
    settings = _procedure_settings(cell, job, positioners)
    if company.step and cell.inputs is not None:
        settings = replace(settings, enabling=cell.inputs.names("enabling-device"))
    approach = _approach(cell, job)
    procedure = Procedure(settings, approach, survey, watched or motion, company.journal, company.operator)
    if watched is not None:
        watched.listeners = LiveListeners(procedure.alarm, partial(company.journal.write, "live"))
    return Cell(procedure)


def tracker_of(cell: CellFile, link: SerialLink) -> Tracker:
    """The driver of the cell's instrument on a serial line."""
    """The tracker of the cell file on `link`, with the noise of its class."""
    noise = noise_of(cell)

    def covariance(p_T_mm: Array) -> Array:
        one: Array = noise.covariance(p_T_mm)[0]
        return one

    if cell.tracker.protocol == "geocom":
        return GeocomTracker(link, cell.tracker, covariance)
    return LineTracker(link, cell.tracker, covariance)


def _nominals(cell: CellFile, job: JobFile) -> Nominals:
    part, mate = job.component, job.mate
    features, mate_features = measured_features(job, cell)
    return Nominals(
        ers=ers_points(cell.tracker.ers),
        mate=target_points(mate.targets, mate, cell),
        targets=target_points(part.targets, part, cell),
        checks=target_points(part.check_points, part, cell),
        features=features,
        mate_features=mate_features,
    )


def _survey_settings(cell: CellFile, job: JobFile) -> SurveySettings:
    part, mate = job.component, job.mate

    def fit(where: str, expansion_sigma: float = 0.0) -> FitSettings:
        return FitSettings(where=where, min_agreeing=AGREEING_POINTS, majority=True, expansion_sigma=expansion_sigma)

    return SurveySettings(
        passes=job.measuring.passes,
        drift_points=job.measuring.drift_points,
        two_face_limit_mm=cell.tracker.two_face_limit_mm,
        station_fit=fit("station"),
        mate_fit=fit("mate", mate.expansion_per_k * mate.temperature_sigma_k),
        component_fit=fit("component", part.expansion_per_k * part.temperature_sigma_k),
    )


def _procedure_settings(cell: CellFile, job: JobFile, positioners: Positioners) -> ProcedureSettings:
    settle, limits = cell.settle, cell.limits
    return ProcedureSettings(
        positioners=positioners,
        plan=plan_settings(cell, job),
        guard=guard_settings(cell),
        settle=SettleSettings(settle.window_s, settle.readings, settle.tolerance_mm, settle.timeout_s),
        X_WT=pose_from_vector(cell.tracker.station_pose),
        X_WM=pose_from_vector(job.mate.pose),
        period_s=plan_period_s(cell),
        linear_interpolation=cell.bus.queued,
        drift_mm_per_s=cell.tracker.drift_um_per_h * 1e-3 / 3600.0,
        target_residual_mm=limits.target_residual_mm,
        rms_limit_mm=job.rms_limit_mm,
        plausibility_mm=limits.frame_plausibility_mm,
        fit_age_s=limits.fit_age_s,
        raising=raising_from(cell, job),
        cells=relief_settings(cell).cells,
        warp_limit_n=limits.measured_whole_warp_n,
        retreat_rise_n=RETREAT_RISE * limits.measured_force_n,
        measured=lambda state: _measured(cell, job, state),
    )


def _measured(cell: CellFile, job: JobFile, state: InputState) -> Measured | None:
    """The same nominals, fits and geometry at the temperatures that sensors make of those that the job states."""
    found = part_temperatures(cell, job, state.temperature_c)
    if not found:
        return None
    warm = with_temperatures(job, found)
    rows = tuple(vars(one) for one in found)
    return Measured(_nominals(cell, warm), _survey_settings(cell, warm), _approach(cell, warm), rows)


def _approach(cell: CellFile, job: JobFile) -> Approach:
    part, mate = job.component, job.mate
    features = Features(
        names=tuple(f.name for f in part.features),
        component_mm=feature_points(part, cell).xyz_mm,
        mate_mm=mate_feature_points(part, mate, cell).xyz_mm,
        component_sigma_mm=np.array([f.sigma_mm for f in part.features]),
        mate_sigma_mm=np.array([f.mate_sigma_mm for f in part.features]),
        tolerance_mm=np.array([f.tolerance_mm for f in part.features]),
    )
    return Approach(
        features=features,
        component_expansion=part.expansion_per_k * part.temperature_sigma_k,
        mate_expansion=mate.expansion_per_k * mate.temperature_sigma_k,
        axis_M=np.array(job.docking_axis),
        face_C_mm=np.array(part.docking_face_mm),
        stations=tuple(Station(s.name, s.standoff_mm, s.speed_mm_s, s.permissives) for s in job.stages),
        convergence=convergence_settings(cell, job),
        goal=goal_rule(job),
    )
