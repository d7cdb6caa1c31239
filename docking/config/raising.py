"""Lift and levelling of a job: the planner's settings, and what a cell must have for them."""

from __future__ import annotations

import numpy as np

from docking.config.budget import docked_pose
from docking.config.build import load_from, mate_settings, positioners_from
from docking.config.cell import CellFile
from docking.config.findings import Finding, error
from docking.config.job import JobFile
from docking.config.support import stage_positions
from docking.kinematics import axis_displacements
from docking.planning.raising import Raising, level_pivot_C_mm
from docking.types import readonly


def raising_from(cell: CellFile, job: JobFile) -> Raising:
    """How the job has its part lifted and levelled. Up in C is what is up in the docked pose by design."""
    up_W = load_from(cell, job).up
    up_C = docked_pose(cell, job).R.T @ up_W
    pivot = level_pivot_C_mm(positioners_from(cell, job).balls_C_mm, mate_settings(cell, job).face_C_mm, up_C)
    return Raising(job.lift_mm, job.level, job.lift_speed_mm_s, readonly(up_W), readonly(up_C), readonly(pivot))


def lift_findings(cell: CellFile, job: JobFile) -> list[Finding]:
    """A lifted part is weighed, so every ball needs a load cell; and it must have stood within the strokes before."""
    if job.lift_mm == 0.0:
        return []
    blind = [f"positioner {p.name} has no load_cell" for p in cell.positioners if not p.load_cell]
    blind += ["the cell has no [load_cells]"] if cell.load_cells is None else []
    findings = [error("lift_mm", f"the part is weighed when it has been lifted, and {what}") for what in blind]
    positioners, margin = positioners_from(cell, job), cell.limits.stroke_margin_mm
    down = np.tile(-job.lift_mm * load_from(cell, job).up, (len(positioners.names), 1))
    q = stage_positions(cell, job)[0] + axis_displacements(positioners, down)
    low, high = positioners.stroke_mm.T + np.array([[margin], [-margin]])
    lacking = np.maximum(low - q, q - high)
    k = int(np.argmax(lacking))
    if not lacking[k] <= 0.0:
        text = (
            f"{job.lift_mm:g} mm below the first station axis {positioners.axes[k]} would stand at {q[k]:.2f} mm, its "
            f"stroke less {margin:g} mm margin is {low[k]:g} to {high[k]:g} mm"
        )
        findings.append(error("lift_mm", text))
    return findings
