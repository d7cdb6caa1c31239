"""The monitors of a cell, from its files."""

from __future__ import annotations

import numpy as np

from docking.config.build import load_from, positioners_from
from docking.config.cell import CellFile, ModbusBus
from docking.config.job import JobFile
from docking.motion.monitors.limits import Timing, WatchLimits
from docking.motion.monitors.watch import Watch


def watch_limits(cell: CellFile) -> WatchLimits:
    """The limits of the cell file."""
    limits = cell.limits
    return WatchLimits(
        following_rest_mm=limits.following_error_rest_mm,
        following_vmax_mm=limits.following_error_vmax_mm,
        ball_residual_mm=limits.ball_residual_mm,
        internal_force_n=limits.internal_force_n,
        warp_force_n=limits.warp_force_n,
        missing_cycles=limits.missing_cycles,
        stuck_mm=limits.stuck_mm,
        standstill_mm=limits.standstill_mm,
        passive_mm=limits.passive_mm,
        adrift_mm=limits.adrift_mm,
        ball_rms_mm=limits.ball_rms_mm,
        ball_pair_mm=limits.ball_pair_mm,
        sync_error_mm=limits.sync_error_mm,
        measured_force_n=limits.measured_force_n,
        measured_warp_n=limits.measured_warp_n,
        measured_whole_force_n=limits.measured_whole_force_n,
        measured_whole_warp_n=limits.measured_whole_warp_n,
        standing_force_n=limits.standing_force_n,
        overload=limits.overload_fraction,
        underload=limits.underload_fraction,
    )


def watch_from(cell: CellFile, job: JobFile) -> Watch:
    """The monitors of a cell that carries the component of a job."""
    bus = cell.bus
    period_s = bus.poll_s if isinstance(bus, ModbusBus) else bus.cycle_s
    fitted = [station.load_cell and cell.load_cells is not None for station in cell.positioners]
    return Watch(
        positioners_from(cell, job),
        load_from(cell, job),
        watch_limits(cell),
        np.repeat(fitted, 3),
        Timing(period_s, bus.servo_lag_s),
    )
