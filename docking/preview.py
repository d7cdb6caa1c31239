"""`docking plan`: every move of a job planned as it would be made, without a wire, a measurement or a motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from docking import records
from docking.config.budget import docked_pose
from docking.config.build import load_from, plan_period_s, plan_settings, positioners_from
from docking.config.cell import CellFile
from docking.config.job import JobFile, Stage
from docking.config.load import default_job_path, load_cell, load_job
from docking.config.raising import raising_from
from docking.errors import BadArgument
from docking.geometry import pose_from_vector, pose_to_vector
from docking.kinematics import Positioners, axis_positions, ball_reactions_n, sink_mm
from docking.planning import (
    PlanRequest,
    PlanSettings,
    Scene,
    correction_to,
    make_plan,
    moved_pose,
)
from docking.planning.jam import JamBound, jam_bound
from docking.types import Array, Correction, Plan, Pose

SHIFT_SHARE, TURN_SHARE = 0.4, 0.25
"""A drawn start is off by up to these shares of the largest first correction."""

DRAWN_ROWS = 400


@dataclass(frozen=True, eq=False)
class StageMove:
    """One planned move: the stage it leads to, the plan, and what the jam curve is drawn from."""

    stage: Stage
    plan: Plan
    jam: JamBound


class Preview:
    """A job's moves from a start that is `offset` off the first station: mm along W and deg about the docking face."""

    def __init__(self, cell: CellFile, job: JobFile, offset: Array) -> None:
        self.cell, self.job, self.offset = cell, job, offset
        self.positioners: Positioners = positioners_from(cell, job)
        self.settings: PlanSettings = plan_settings(cell, job)
        self._docked = docked_pose(cell, job)
        self._mate = pose_from_vector(job.mate.pose)
        self._face_C = self.settings.mate.face_C_mm
        self._raising = raising_from(cell, job)

    def moves(self) -> Iterator[StageMove]:
        """Plan stage after stage, each from where the one before ends. Raises what the planner refuses."""
        here = self._start()
        q_mm = self._axes_at(here)
        before_mm = float("inf")
        for number, (kind, stage) in enumerate(self._waypoints(), start=1):
            correction = self._correction(kind, here, stage)
            request = PlanRequest(
                plan_id=number,
                stage=stage.name,
                kind=kind,
                q_now_mm=q_mm,
                correction=correction,
                speed_mm_s=stage.speed_mm_s,
                period_s=plan_period_s(self.cell),
                linear_interpolation=self.cell.bus.queued,
                scene=Scene(here, self._mate, self._docked, stage.standoff_mm, before_mm),
            )
            plan = make_plan(request, self.positioners, self.settings)
            yield StageMove(stage, plan, self._jam(plan))
            here, q_mm = moved_pose(here, correction), plan.q_mm[-1]
            before_mm = before_mm if kind in ("lift", "level") else stage.standoff_mm

    def _waypoints(self) -> Iterator[tuple[str, Stage]]:
        """Kind and stage of every move; lift and levelling happen at the first station's stand-off."""
        first, asked = self.job.stages[0], {"lift": self.job.lift_mm > 0.0, "level": self.job.level}
        for kind in (kind for kind, wanted in asked.items() if wanted):
            yield kind, first.model_copy(update={"name": kind, "speed_mm_s": self.job.lift_speed_mm_s})
        for stage in self.job.stages:
            yield "align" if stage is first else "approach", stage

    def _correction(self, kind: str, here: Pose, stage: Stage) -> Correction:
        if kind == "lift":
            return self._raising.lift(here)
        if kind == "level":
            return self._raising.levelling(here)
        return correction_to(here, self._station(stage.standoff_mm), self._face_C)

    def _jam(self, plan: Plan) -> JamBound:
        return jam_bound(self.positioners, plan.q_mm[[0, -1]], self.settings.jam, self.settings.load.up)

    def _station(self, standoff_mm: float) -> Pose:
        axis_W = self._mate.R @ self.settings.mate.axis_M
        return Pose(self._docked.R, self._docked.t_mm - standoff_mm * axis_W)

    def _start(self) -> Pose:
        """The first station, turned about its docking face and shifted, and lower by the lift."""
        first, by = self._station(self.job.stages[0].standoff_mm), pose_from_vector(self.offset)
        face = first.apply(self._face_C)
        lift_mm = self._raising.lift_mm * self._raising.up_W
        return Pose(by.R @ first.R, face + by.R @ (first.t_mm - face) + by.t_mm - lift_mm)

    def _axes_at(self, X_WC: Pose) -> Array:
        """Where the loaded axes stand with the component at X_WC: as `docking check` counts the strokes."""
        load = load_from(self.cell, self.job)
        balls = X_WC.apply(self.positioners.balls_C_mm)
        weight_n = load.mass_kg * load.gravity_m_s2
        reactions = ball_reactions_n(self.positioners, balls, X_WC.apply(load.com_C_mm), weight_n)[0]
        return axis_positions(self.positioners, balls - sink_mm(self.positioners, reactions))


def open_preview(cell_path: Path, job_path: Path | None, start: str | None, seed: int | None) -> Preview:
    """Load the files; the start is as told, drawn from a seed, or the first station itself."""
    cell = load_cell(cell_path)
    job = load_job(default_job_path(cell_path) if job_path is None else job_path, cell)
    if start is not None and seed is not None:
        raise BadArgument("--seed", "the start is either told with --from or drawn with --seed", value=seed)
    if start is not None:
        return Preview(cell, job, _told(start))
    return Preview(cell, job, np.zeros(6) if seed is None else _drawn(cell, seed))


def _told(start: str) -> Array:
    try:
        offset = np.array([float(number) for number in start.split(",")])
    except ValueError:
        offset = np.zeros(0)
    if offset.shape != (6,) or not np.all(np.isfinite(offset)):
        raise BadArgument("--from", "six numbers x,y,z,alpha,beta,gamma in mm and deg are needed", value=start)
    return offset


def _drawn(cell: CellFile, seed: int) -> Array:
    rng, limits = np.random.default_rng(seed), cell.limits
    shift = SHIFT_SHARE * limits.first_correction_mm * rng.uniform(-1.0, 1.0, 3)
    return np.concatenate([shift, TURN_SHARE * limits.first_correction_deg * rng.uniform(-1.0, 1.0, 3)])


def curves(move: StageMove) -> tuple[Array, tuple[Array, ...]]:
    """Along s (n,): displacement, speed, acceleration of every axis, force and warp if it jammed there; each (n, m)."""
    plan = move.plan
    speed = np.gradient(plan.q_mm, plan.period_s, axis=0)
    rows = np.unique(np.linspace(0, len(plan.s) - 1, min(len(plan.s), DRAWN_ROWS)).round().astype(int))
    jammed = [np.array([cost(np.abs(speed[row])) for row in rows]) for cost in (move.jam.jam_n, move.jam.jam_warp_n)]
    acceleration = np.gradient(speed, plan.period_s, axis=0)
    return plan.s[rows], (plan.q_mm[rows] - plan.q_mm[0], speed[rows], acceleration[rows], *jammed)


def preview_json(preview: Preview, moves: list[StageMove]) -> dict[str, Any]:
    """The facts for programs: one object."""
    return {
        "cell": preview.cell.name,
        "job": {"part_number": preview.job.part_number, "serial_number": preview.job.serial_number},
        "start_offset": dict(zip(records.POSE_KEYS, preview.offset.tolist(), strict=True)),
        "duration_s": sum(move.plan.duration_s for move in moves),
        "stages": [
            {
                "standoff_mm": move.stage.standoff_mm,
                "asked_mm_s": move.stage.speed_mm_s,
                **records.plan_record(move.plan),
            }
            for move in moves
        ],
    }


def head_text(preview: Preview) -> str:
    """What is planned, from where."""
    start = " ".join(f"{value:z.3f}" for value in pose_to_vector(pose_from_vector(preview.offset)))
    return (
        f"cell {preview.cell.name}, job {preview.job.part_number} / {preview.job.serial_number}: planned only, nothing "
        f"is connected or moved\nstart: first station, off by [mm, deg] {start}"
    )


def move_text(move: StageMove) -> str:
    """One stage as a table: every axis, margins, what sets the speed, what a jammed axis would do."""
    plan, bounds = move.plan, move.plan.bounds
    rows = [
        "",
        f"{move.stage.name}: stand-off {move.stage.standoff_mm:g} mm, {plan.duration_s:.2f} s, "
        f"{move.stage.speed_mm_s:g} mm/s asked; speed set by {plan.speed_limited_by}",
    ]
    if bounds is None:
        return "\n".join(rows)
    used = ", ".join(f"{name} {share:.0%}" for name, share in bounds.limits[:4])
    rows += [
        f"  limits used: {used}",
        f"  part: interpolation and start {bounds.residual_mm:.4f} mm, {bounds.force_n:.0f} N, warp {bounds.warp_n:.0f}"
        f" N; all axes at rest {1e3 * bounds.quick_stop_s:.0f} ms after a quick stop",
    ]
    if np.isfinite(bounds.clearance_mm):
        rows.append(
            f"  mate: {bounds.clearance_mm:.2f} mm clear where it is tightest (s = {bounds.clearance_s:.2f}), "
            f"{bounds.clearance_asked_mm:.2f} mm asked there"
        )
    rows.append("  axis       move mm  peak mm/s  stroke left mm  speed left mm/s  jammed mm  jammed N  warp N")
    for k, (axis, room, speed) in enumerate(plan.margins):
        rows.append(
            f"  {axis:<8}{plan.displacement_mm[k]:>10.3f}{bounds.peak_mm_s[k]:>11.3f}{room:>16.2f}{speed:>17.3f}"
            f"{bounds.jam_mm[k]:>11.4f}{bounds.jam_n[k]:>10.0f}{bounds.jam_warp_n[k]:>8.0f}"
        )
    return "\n".join(rows)
