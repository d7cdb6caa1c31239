"""The positioners as they really stand: true frames, springs, play, and what lies behind each motor."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from docking.config import CellFile
from docking.types import Array
from sim.axes import AxisTruth, stick_table, wander_shape
from sim.elastic import Supports
from sim.truth import Draws, TruthFile

_LOADED = 0.7
"""An axis counts as vertical when this much of gravity pulls along it."""


def gravity_unit(cell: CellFile) -> Array:
    """Unit vector of gravity in W (3,)."""
    down = np.array(cell.gravity_direction)
    unit: Array = down / np.linalg.norm(down)
    return unit


def _true_directions(cell: CellFile, truth: TruthFile, draws: Draws) -> Array:
    """(k, 3, 3) direction matrices: columns of the cell file, each turned by its calibration error, then the base."""
    tilt = truth.calibration.direction_mrad * 1e-3 * draws.normal("calibration", (len(cell.positioners), 3, 3))
    base = np.deg2rad(truth.uncalibrated_base.deg) * draws.scale("uncalibrated_base")
    signs = draws.generator("uncalibrated_base").choice((-1.0, 1.0), len(cell.positioners))
    result = np.empty((len(cell.positioners), 3, 3))
    for i, positioner in enumerate(cell.positioners):
        turned = Rotation.from_rotvec(tilt[i]).apply(np.array([a.direction for a in positioner.axes]))
        result[i] = Rotation.from_rotvec(signs[i] * base * gravity_unit(cell)).as_matrix() @ turned.T
    return result


def _down_signs(cell: CellFile, directions: Array) -> Array:
    """(m,) sign of each axis direction along gravity, 0 for level axes."""
    along = np.einsum("kij,i->kj", directions, gravity_unit(cell)).ravel()
    signs: Array = np.where(np.abs(along) > _LOADED, np.sign(along), 0.0)
    return signs


def true_supports(cell: CellFile, truth: TruthFile, draws: Draws) -> tuple[Supports, Array]:
    """The springs under the component, and (m,) the sign of each axis along gravity.

    Raises numpy.linalg.LinAlgError for axis directions that do not span space.
    """
    origins = np.array([p.origin_mm for p in cell.positioners])
    origins = origins + truth.calibration.origin_mm * draws.normal("calibration", origins.shape)
    directions = _true_directions(cell, truth, draws)
    down = _down_signs(cell, directions)
    driven = np.array(cell.driven, dtype=bool)
    half_play = 0.5e-3 * draws.span("ball_clearance", truth.ball_clearance.um, (len(cell.positioners),))
    clearance = np.where(driven, np.where(down == 0.0, np.repeat(half_play, 3), 0.0), np.inf)
    friction = np.where(driven, truth.ball_clearance.friction_n, truth.drives.passive_friction_n)
    held = np.array([axis.force_n or 0.0 for p in cell.positioners for axis in p.axes])
    friction = np.where(held > 0.0, truth.drives.follower_friction * held, friction)
    supports = Supports(
        rows=np.asarray(np.linalg.inv(directions), dtype=np.float64).reshape(-1, 3),
        origin_mm=origins,
        stiffness=np.array([s for p in cell.positioners for s in p.stiffness_n_per_mm]),
        friction_n=np.where(driven & (down != 0.0), np.inf, friction),
        clearance_mm=clearance,
        driven=driven,
        held_n=held,
    )
    return supports, down


def true_axes(cell: CellFile, truth: TruthFile, draws: Draws, down: Array) -> AxisTruth:
    """Constants of the axes. Weight keeps a loaded vertical screw on one flank: it has no backlash."""
    axes = [a for p in cell.positioners for a in p.axes]
    count = len(axes)
    driven = np.array(cell.driven, dtype=bool)
    drives = truth.drives
    # Lags differ from drive to drive by their tuning, not by an error that a study switches.
    spread = np.linspace(-1.0, 1.0, count)[np.argsort(np.sin(np.arange(1.0, count + 1.0)))]
    wander, waves, phases = wander_shape(draws.generator("repeatability"), count, truth.repeatability.um * 1e-3)
    stick = stick_table(draws.generator("stick_slip"), count, truth.stick_slip.um * 1e-3)
    return AxisTruth(
        lag_s=drives.servo_lag_s * (1.0 + drives.servo_lag_spread * spread),
        v_max=drives.overspeed_factor * np.array([a.v_mm_s for a in axes]),
        a_max=drives.acceleration_factor * np.array([a.a_quick_mm_s2 for a in axes]),
        stroke_mm=np.array([a.stroke_mm for a in axes]),
        backlash_mm=np.where(driven & (down == 0.0), truth.backlash.um * 1e-3 * draws.scale("backlash"), 0.0),
        lead=np.where(driven, truth.screw_lead.um_per_m * 1e-6 * draws.normal("screw_lead", (count,)), 0.0),
        wander_mm=np.where(driven, draws.scale("repeatability"), 0.0)[:, None] * wander,
        wave_per_mm=waves,
        phase=phases,
        stick_mm=np.where(driven, draws.scale("stick_slip"), 0.0) * stick,
        down=down,
        brake_mm_s2=drives.brake_mm_s2,
        back_drive_mm_s2=drives.back_drive_mm_s2,
        driven=np.array(cell.powered, dtype=bool),
    )
