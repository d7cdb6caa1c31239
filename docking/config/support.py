"""Checks of what carries the component: driven-axis set, ball reactions, strokes and speeds."""

from __future__ import annotations

import numpy as np

from docking.config.budget import docked_pose
from docking.config.build import load_from, positioners_from, positioners_of, rank_settings
from docking.config.cell import CanBus, CellFile
from docking.config.findings import Finding, error
from docking.config.job import JobFile
from docking.geometry import pose_from_vector
from docking.kinematics import axis_displacements, axis_positions, conditioning, reaction_extremes, sink_mm
from docking.kinematics.forces import ball_reactions_n
from docking.types import Array, Pose

FOLLOWER_LEAN_DEG = 5.0
"""Most that an axis which holds a force may lean: its side force is carried by the axes of the other positioners."""


def rank_findings(cell: CellFile) -> list[Finding]:
    """The driven axes must hold all six degrees of freedom, well conditioned, and every vertical axis must carry."""
    findings = [
        error(
            f"positioners[{i}].axes[{j}].driven",
            f"{p.name}.Z is passive: only X and Y axes may follow, or the part tips",
        )
        for i, p in enumerate(cell.positioners)
        for j, axis in enumerate(p.axes)
        if axis.name == "Z" and not axis.powered
    ]
    settings = rank_settings(cell)
    found = conditioning(positioners_of(cell), settings)
    if found.full_rank:
        return findings
    driven = ", ".join(name for name, on in zip(cell.axis_names, cell.driven, strict=True) if on) or "none"
    if found.redundancy < 0:
        text = f"{6 + found.redundancy} driven axes ({driven}); six or more are needed"
    elif not found.sigma_min > settings.sigma_min:
        text = (
            f"the driven axes ({driven}) are rank-deficient, or nearly: some motion of the component is held by "
            f"none; least singular value {found.sigma_min:.3g}, limit {settings.sigma_min:g}"
        )
    else:
        text = (
            f"the driven axes ({driven}) hold the component badly: condition {found.condition:.3g}, limit "
            f"limits.condition_max = {settings.condition_max:g}"
        )
    return [*findings, error("positioners", text)]


def follower_findings(cell: CellFile) -> list[Finding]:
    """A force-controlled axis pushes against gravity, is weighed, within its rating, and on a bus that knows forces."""
    findings = []
    up = -np.array(cell.gravity_direction) / np.linalg.norm(cell.gravity_direction)
    for i, p in enumerate(cell.positioners):
        for j, axis in enumerate(p.axes):
            if axis.force_n is None:
                continue
            upright = up @ axis.direction / np.linalg.norm(axis.direction)
            lean = float(np.degrees(np.arccos(np.clip(upright, -1.0, 1.0))))
            peak, rated = axis.force_n * (1.0 + axis.force_tolerance), p.rated_n["XYZ".index(axis.name)]
            refusals = (
                (not lean <= FOLLOWER_LEAN_DEG, f"its direction leans {lean:.3g} deg from straight up, at most "
                 f"{FOLLOWER_LEAN_DEG:g} deg is allowed: only a vertical axis may hold a force"),
                (not peak <= rated, f"up to {peak:.0f} N with its tolerance, its rated_n is {rated:.0f} N"),
                (not (p.load_cell and cell.load_cells), "needs the load cell under its ball: load_cell and load_cells"),
                (not isinstance(cell.bus, CanBus), f"a {cell.bus.kind} bus has no force-controlled axes"),
            )  # fmt: skip
            key = f"positioners[{i}].axes[{j}].force_n"
            findings += [error(key, f"{p.name}.{axis.name}: {text}") for refused, text in refusals if refused]
    return findings


def reaction_findings(cell: CellFile, job: JobFile) -> list[Finding]:
    """No ball may lift (least share of the weight) and no axis may be over its rating, over the COM's tolerance."""
    positioners, load = positioners_from(cell, job), load_from(cell, job)
    found = reaction_extremes(positioners, docked_pose(cell, job), load)
    fraction = cell.limits.reaction_min_fraction
    share_n = float(np.linalg.norm(load.heaviest_n)) / len(positioners.names)
    findings = [
        error(
            "component.com_mm",
            f"the part could tip: with {list(job.component.com_mm)} +- {list(job.component.com_tolerance_mm)} mm ball "
            f"{name} carries {found.least_up_n[i]:.0f} N at least; {fraction * share_n:.0f} N are needed "
            f"(limits.reaction_min_fraction = {fraction:g} of the equal share)",
        )
        for i, name in enumerate(positioners.names)
        if not found.least_share[i] >= fraction
    ]
    return findings + [
        error("component.mass_kg", f"axis {axis} carries up to {peak:.0f} N, its rated_n is {rated:.0f} N")
        for axis, peak, rated in zip(positioners.axes, found.peak_axis_n, positioners.rated_n.reshape(-1), strict=True)
        if not peak <= rated
    ]


def stage_positions(cell: CellFile, job: JobFile) -> Array:
    """Nominal axis positions (stages, m) at every stage, the compliance under the weight included."""
    positioners, load = positioners_from(cell, job), load_from(cell, job)
    docked = docked_pose(cell, job)
    balls = docked.apply(positioners.balls_C_mm)
    weight_n = load.mass_kg * load.gravity_m_s2
    sink = sink_mm(positioners, ball_reactions_n(positioners, balls, docked.apply(load.com_C_mm), weight_n)[0])
    axis = _docking_axis_W(job)
    return np.array([axis_positions(positioners, balls - sink - stage.standoff_mm * axis) for stage in job.stages])


def stroke_findings(cell: CellFile, job: JobFile) -> list[Finding]:
    """Every axis, driven or passive, must reach every stage inside its stroke less the margin; the worst is named."""
    positioners = positioners_from(cell, job)
    q, margin = stage_positions(cell, job), cell.limits.stroke_margin_mm
    low, high = positioners.stroke_mm.T + np.array([[margin], [-margin]])
    lacking = np.maximum(low - q, q - high)
    findings = []
    for k in np.flatnonzero(~np.all(lacking <= 0.0, axis=0)):
        i = int(np.argmax(lacking[:, k]))
        text = (
            f"{job.stages[i].standoff_mm:g} mm cannot be reached: axis {positioners.axes[k]} would stand at "
            f"{q[i, k]:.2f} mm, its stroke less {margin:g} mm margin is {low[k]:g} to {high[k]:g} mm"
        )
        findings.append(error(f"stages[{i}].standoff_mm", text))
    return findings


def speed_findings(cell: CellFile, job: JobFile) -> list[Finding]:
    """A speed asked along the docking axis must be within the speed limit of every axis that it moves."""
    positioners = positioners_from(cell, job)
    per_mm = np.abs(axis_displacements(positioners, np.tile(_docking_axis_W(job), (len(positioners.names), 1))))
    fastest = np.divide(positioners.v_mm_s, per_mm, out=np.full(len(per_mm), np.inf), where=per_mm > 0.0)
    k = int(np.argmin(fastest))
    return [
        error(
            f"stages[{i}].speed_mm_s",
            f"{stage.speed_mm_s:g} mm/s is over the {fastest[k]:.4g} mm/s that axis {positioners.axes[k]} allows "
            f"(v_mm_s = {positioners.v_mm_s[k]:g})",
        )
        for i, stage in enumerate(job.stages)
        if not stage.speed_mm_s <= fastest[k] * (1.0 + 1e-3)
    ]


def _docking_axis_W(job: JobFile) -> Array:
    """Unit docking axis (3,) in W."""
    X_WM: Pose = pose_from_vector(job.mate.pose)
    axis: Array = X_WM.R @ np.array(job.docking_axis)
    return axis / float(np.linalg.norm(axis))
