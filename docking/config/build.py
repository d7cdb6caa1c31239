"""From the files to what the stages take: positioner geometry and the settings of kinematics, planning and motion."""

from __future__ import annotations

import numpy as np

from docking.config.budget import docked_pose
from docking.config.cell import CellFile, ModbusBus
from docking.config.job import JobFile
from docking.kinematics import Load, Positioners, RankSettings
from docking.planning import (
    ConvergenceSettings,
    GuardSettings,
    JamSettings,
    MateSettings,
    PlanSettings,
    outline_edges,
)
from docking.planning.relief import LoadCellErrors, ReliefSettings
from docking.planning.settings import READINGS
from docking.types import Array, readonly

STANDARD_GRAVITY_M_S2 = 9.80665
LOAD_CELL_CYCLES = 10
"""A load cell reports in every tenth cycle of the bus, as `drivers/maps/cia402.toml` has it."""


def positioners_from(cell: CellFile, job: JobFile) -> Positioners:
    """The cell's positioners under the job's balls, in the order of the cell file.

    The balls sit straight in their sockets in the docked attitude. The files must have passed their checks: a
    positioner without a ball raises KeyError.
    """
    balls = {ball.positioner: ball.xyz_mm for ball in job.component.balls}
    part = job.component
    grown = 1.0 + part.expansion_per_k * (part.temperature_c - cell.temperature_c)
    figure = np.array([balls[station.name] for station in cell.positioners])
    return _positioners(cell, figure * grown, docked_pose(cell, job).R)


def positioners_of(cell: CellFile) -> Positioners:
    """The cell's positioners before any job: balls where the sockets are with all axes at zero, about their middle."""
    origins = np.array([station.origin_mm for station in cell.positioners])
    return _positioners(cell, origins - origins.mean(axis=0), np.eye(3))


def _positioners(cell: CellFile, balls_C_mm: Array, neutral_R_WC: Array) -> Positioners:
    stations = cell.positioners
    axes = [axis for station in stations for axis in station.axes]
    return Positioners(
        names=tuple(station.name for station in stations),
        axes=cell.axis_names,
        origins_W_mm=np.array([station.origin_mm for station in stations]),
        axes_W=np.array([np.transpose([axis.direction for axis in station.axes]) for station in stations]),
        driven=np.array(cell.driven),
        held_n=np.array([axis.force_n or 0.0 for axis in axes]),
        held_tolerance_n=np.array([axis.force_tolerance * (axis.force_n or 0.0) for axis in axes]),
        stroke_mm=np.array([axis.stroke_mm for axis in axes]),
        v_mm_s=np.array([axis.v_mm_s for axis in axes]),
        a_mm_s2=np.array([axis.a_mm_s2 for axis in axes]),
        j_mm_s3=np.array([axis.j_mm_s3 for axis in axes]),
        a_quick_mm_s2=np.array([axis.a_quick_mm_s2 for axis in axes]),
        stiffness_n_per_mm=np.array([station.stiffness_n_per_mm for station in stations]),
        rated_n=np.array([station.rated_n for station in stations]),
        swivel_rad=np.radians([station.swivel_deg for station in stations]),
        balls_C_mm=balls_C_mm,
        neutral_R_WC=neutral_R_WC,
    )


def gravity_m_s2(cell: CellFile) -> Array:
    """Gravity (3,) in W."""
    direction = np.array(cell.gravity_direction)
    return readonly(STANDARD_GRAVITY_M_S2 * direction / np.linalg.norm(direction))


def load_from(cell: CellFile, job: JobFile) -> Load:
    """What the positioners carry."""
    part = job.component
    return Load(
        mass_kg=part.mass_kg,
        mass_tolerance_kg=part.mass_tolerance_kg,
        com_C_mm=readonly(part.com_mm),
        com_tolerance_mm=readonly(part.com_tolerance_mm),
        gravity_m_s2=gravity_m_s2(cell),
    )


def rank_settings(cell: CellFile) -> RankSettings:
    """Limits of the check that the driven axes hold the component."""
    return RankSettings(rotation_length_mm=cell.limits.rotation_length_mm, condition_max=cell.limits.condition_max)


def guard_settings(cell: CellFile) -> GuardSettings:
    """Limits of the correction guard."""
    limits = cell.limits
    return GuardSettings(
        first_mm=limits.first_correction_mm,
        first_rad=float(np.radians(limits.first_correction_deg)),
        station_min_mm=limits.station_correction_min_mm,
        station_max_mm=limits.station_correction_max_mm,
        station_gap_fraction=limits.station_correction_gap_fraction,
        lever_mm=limits.rotation_length_mm,
    )


def convergence_settings(cell: CellFile, job: JobFile) -> ConvergenceSettings:
    """Limits of the convergence loop at one station."""
    return ConvergenceSettings(max_corrections=cell.limits.max_corrections, max_passes=job.measuring.max_passes)


def plan_settings(cell: CellFile, job: JobFile) -> PlanSettings:
    """Settings of the planner. Axes on a common SYNC start together, those of several CAN buses nearly so; positioner
    PLCs run on their own clocks."""
    limits, bus = cell.limits, cell.bus
    return PlanSettings(
        load=load_from(cell, job),
        stroke_margin_mm=limits.stroke_margin_mm,
        reaction_min_fraction=limits.reaction_min_fraction,
        chord_error_mm=limits.chord_error_mm,
        sync_error_mm=limits.sync_error_mm,
        start_skew_s=bus.start_skew_s,
        clock_ppm=bus.clock_ppm if isinstance(bus, ModbusBus) else 0.0,
        playback_ramp_s=bus.ramp_s if bus.queued else 0.0,
        jam=jam_settings(cell),
        mate=mate_settings(cell, job),
    )


def jam_settings(cell: CellFile) -> JamSettings:
    """How soon a jammed axis is met: two cycles of the bus, or two scans of the positioners, and the servos' lag; one
    that holds a force, as soon as its encoder or its load cell shows it."""
    limits, bus = cell.limits, cell.bus
    period_s = bus.poll_s if isinstance(bus, ModbusBus) else bus.cycle_s
    queued = isinstance(bus, ModbusBus)
    twice_s = 2.0 * (bus.scan_s if isinstance(bus, ModbusBus) else bus.cycle_s)
    return JamSettings(
        stuck_mm=limits.stuck_mm,
        passive_mm=limits.passive_mm,
        reaction_s=twice_s + bus.servo_lag_s,
        quick_floor_s=twice_s if queued else 0.0,
        sampled_s=period_s,
        readings_s=READINGS * LOAD_CELL_CYCLES * period_s,
        residual_mm=limits.ball_residual_mm,
        force_n=limits.internal_force_n,
        warp_n=limits.warp_force_n,
        held_warp_n=limits.measured_warp_n,
    )


def mate_settings(cell: CellFile, job: JobFile) -> MateSettings:
    """Outline and envelope at their temperatures. Drives go straight on without a SYNC; queues are played on the path,
    whoever falls silent."""
    part, mate, limits = job.component, job.mate, cell.limits
    grown = 1.0 + part.expansion_per_k * (part.temperature_c - cell.temperature_c)
    mate_grown = 1.0 + mate.expansion_per_k * (mate.temperature_c - cell.temperature_c)
    boxes = np.array([(box.min_mm, box.max_mm) for box in mate.envelope]).reshape(-1, 2, 3)
    axis = np.array(job.docking_axis)
    return MateSettings(
        edges_C_mm=readonly(outline_edges(tuple(np.array(ring) for ring in part.outline_mm)) * grown),
        boxes_M_mm=readonly(boxes * mate_grown),
        face_C_mm=readonly(np.array(part.docking_face_mm) * grown),
        axis_M=readonly(axis / np.linalg.norm(axis)),
        clearance_mm=limits.clearance_mm,
        contact_mm=limits.contact_mm,
        corridor_mm=limits.corridor_mm,
        corridor_length_mm=limits.corridor_length_mm,
        coast_s=0.0 if isinstance(cell.bus, ModbusBus) else cell.bus.drive_timeout_s,
    )


def relief_settings(cell: CellFile) -> ReliefSettings:
    """Limits of a stress relief. Without load cells their range is unknown, and so is every force."""
    cells = cell.load_cells
    if cells is None:
        range_n = np.full(3 * len(cell.positioners), np.nan)
        return ReliefSettings(LoadCellErrors(range_n), target_n=cell.limits.relief_target_n)
    range_n = np.tile(np.array(cells.range_n), len(cell.positioners))
    errors = LoadCellErrors(readonly(range_n), cells.crosstalk, cells.drift_per_h, cells.resolution_n)
    return ReliefSettings(errors, target_n=cell.limits.relief_target_n)


def plan_period_s(cell: CellFile) -> float:
    """Time between two rows of a plan: the bus cycle, or the segment of the positioners' queues."""
    return cell.bus.segment_s if isinstance(cell.bus, ModbusBus) else cell.bus.cycle_s
