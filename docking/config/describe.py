"""A cell and a job in words: what drives, what carries, what the instrument can prove."""

from __future__ import annotations

import numpy as np

from docking.config.budget import docked_pose, feature_budget, least_risk
from docking.config.build import load_from, positioners_from, rank_settings
from docking.config.cell import CanBus, CellFile
from docking.config.job import JobFile
from docking.config.support import stage_positions
from docking.config.torque_off import strain_text
from docking.geometry import pose_to_vector
from docking.kinematics import conditioning, reaction_extremes
from docking.kinematics.forces import ball_reactions_n
from docking.types import RISK_LIMIT


def describe(cell: CellFile, job: JobFile) -> str:
    """Summary for people of files that passed their checks: axes, support, stages, expected uncertainty."""
    head = [
        f"cell {cell.name}: {_instrument(cell)}; {_bus(cell)}",
        f"job  {job.part_number} / {job.serial_number}: {job.component.mass_kg:g} kg, "
        f"{len(job.component.targets)} targets, {len(job.component.check_points)} check points, "
        f"{len(job.mate.targets)} mate targets",
    ]
    parts = (_axes(cell, job), _reactions(cell, job), strain_text(cell, job), _stages(job), _proof(cell, job))
    return "\n\n".join("\n".join(rows) for rows in (head, *parts))


def _instrument(cell: CellFile) -> str:
    faces = ", two faces" if cell.tracker.two_face else ""
    return f"{cell.tracker.device_class} ({cell.tracker.protocol}{faces}), {len(cell.tracker.ers)} reference points"


def _bus(cell: CellFile) -> str:
    if isinstance(cell.bus, CanBus):
        buses = f"{len(cell.bus.channels)} buses, " if cell.bus.further_channels else ""
        return f"CANopen {buses}{cell.bus.bitrate // 1000} kbit/s, {1.0 / cell.bus.cycle_s:g} Hz"
    return f"Modbus TCP, segments of {cell.bus.segment_s:g} s"


def _axes(cell: CellFile, job: JobFile) -> list[str]:
    found = conditioning(positioners_from(cell, job), rank_settings(cell))
    count, driven = len(cell.axis_names), sum(cell.driven)
    passive = [name for name, on in zip(cell.axis_names, cell.powered, strict=True) if not on]
    follow = f"; passive: {', '.join(passive)}" if passive else ""
    follow += "".join(
        f"; {p.name}.{axis.name} holds {axis.force_n:g} N +- {100.0 * axis.force_tolerance:g} %"
        for p in cell.positioners
        for axis in p.axes
        if axis.force_n is not None
    )
    pose = " ".join(f"{v:z.3f}" for v in pose_to_vector(docked_pose(cell, job)))
    rows = [
        f"axes: {count}, {driven} driven, redundancy {found.redundancy}, condition {found.condition:.2f} "
        f"(limit {cell.limits.condition_max:g}){follow}",
        f"docked pose of the component in W [mm, deg]: {pose}",
        "axis      stroke mm          least room mm at the stages",
    ]
    q = stage_positions(cell, job)
    strokes = np.array([axis.stroke_mm for p in cell.positioners for axis in p.axes])
    room = np.minimum(q - strokes[:, 0], strokes[:, 1] - q).min(axis=0)
    for name, (low, high), left in zip(cell.axis_names, strokes, room, strict=True):
        rows.append(f"  {name:<8}{low:8.1f} .. {high:<8.1f}{left:8.1f}")
    return rows


def _reactions(cell: CellFile, job: JobFile) -> list[str]:
    positioners, load = positioners_from(cell, job), load_from(cell, job)
    docked = docked_pose(cell, job)
    balls, com = docked.apply(positioners.balls_C_mm), docked.apply(load.com_C_mm)
    upward = ball_reactions_n(positioners, balls, com, load.mass_kg * load.gravity_m_s2)[0] @ load.up
    found = reaction_extremes(positioners, docked, load)
    rows = ["ball      up kN   least share over the tolerance (limit " + f"{cell.limits.reaction_min_fraction:.0%})"]
    for name, force, share in zip(positioners.names, upward, found.least_share, strict=True):
        rows.append(f"  {name:<6}{force / 1000.0:8.2f}   {share:8.0%}")
    return rows


def _stages(job: JobFile) -> list[str]:
    rows = ["stage             stand-off mm   speed mm/s   permissives"]
    for stage in job.stages:
        asked = ", ".join(stage.permissives) or "-"
        rows.append(f"  {stage.name:<16}{stage.standoff_mm:12g}{stage.speed_mm_s:13g}   {asked}")
    return rows


def _proof(cell: CellFile, job: JobFile) -> list[str]:
    measuring = job.measuring
    counts = measuring.passes, measuring.max_passes
    budgets = zip(*(feature_budget(cell, job, n) for n in counts), strict=True)
    passes = f"{measuring.passes} / {measuring.max_passes}"
    rows = [f"feature           tolerance mm   2 sigma mm with {passes} passes   largest part"]
    for few, many in budgets:
        part, sigma = many.largest
        rows.append(
            f"  {few.name:<16}{few.tolerance_mm:12g}{2.0 * few.sigma_mm:16.3f} / {2.0 * many.sigma_mm:.3f}"
            f"           {part} ({sigma:.3f} mm)"
        )
    least = " / ".join(f"{least_risk(cell, job, n):.2%}" for n in counts)
    rows.append(f"risk that a feature is out of tolerance when no error is measured: {least} (limit {RISK_LIMIT:.1%})")
    return rows
