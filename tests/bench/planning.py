"""P3: a complete plan of 10,000 samples against ruckig's calculate and 10,000 samples of it, twelve axes each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import ruckig

import sim
from docking.config.budget import docked_pose
from docking.config.build import plan_settings, positioners_from
from docking.config.load import load_cell, load_job
from docking.geometry import pose_from_vector
from docking.kinematics import axis_positions
from docking.planning import PlanRequest, Scene, correction_to, make_plan
from docking.types import Pose
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side

SAMPLES = 10_000
TURN_DEG = 0.3


def measure(sizes: Sizes) -> list[Metric]:
    plan, rows = _product()
    times = side_by_side({"product": plan, "peer": _peer()}, 3 * sizes.repeats)
    product, peer = (1e3 * float(np.median(times[name])) for name in ("product", "peer"))
    ratio = median_ratio(times["product"], times["peer"])
    what = f"complete plan, {rows} samples, corridor and mate"
    return [Metric("P3", what, f"{product:.1f} ms", f"{peer:.1f} ms ruckig, 12 axes", ratio, 2.0, at_least=False)]


def _product() -> tuple[Callable[[], object], int]:
    """RC-1 from stand-off 300 mm, turned a little, to 100 mm, at the speed that takes 10,000 rows."""
    path = Path(sim.__file__).parent / "cells" / "fuselage-can.toml"
    cell = load_cell(path)
    job = load_job(path.with_name("fuselage-can.job.toml"), cell)
    positioners, settings = positioners_from(cell, job), plan_settings(cell, job)
    docked, mate = docked_pose(cell, job), pose_from_vector(job.mate.pose)
    turn = pose_from_vector(np.array([0.0, 0.0, 0.0, 0.0, 0.0, TURN_DEG]))
    here = Pose(turn.R @ docked.R, docked.t_mm - np.array([300.0, 0.0, 0.0]))
    goal = Pose(docked.R, docked.t_mm - np.array([100.0, 0.0, 0.0]))
    request = PlanRequest(
        plan_id=1,
        stage="approach-100",
        kind="approach",
        q_now_mm=axis_positions(positioners, here.apply(positioners.balls_C_mm)),
        correction=correction_to(here, goal, np.array(job.component.docking_face_mm)),
        speed_mm_s=2.0,
        period_s=cell.bus.cycle_s if cell.bus.kind == "canopen" else 0.01,
        linear_interpolation=False,
        scene=Scene(here, mate, docked, 100.0, 300.0),
    )
    first = make_plan(request, positioners, settings)
    request = replace(request, speed_mm_s=2.0 * first.duration_s / (request.period_s * SAMPLES))
    rows = len(make_plan(request, positioners, settings).t_s)
    return lambda: make_plan(request, positioners, settings), rows


def _peer() -> Callable[[], object]:
    axes = 12
    wanted = ruckig.InputParameter(axes)
    wanted.current_position = [0.0] * axes
    wanted.target_position = [200.0 + 0.5 * k for k in range(axes)]
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [2.0] * axes, [5.0] * axes, [50.0] * axes

    def calculate_and_sample() -> float:
        trajectory = ruckig.Trajectory(axes)
        ruckig.Ruckig(axes).calculate(wanted, trajectory)
        last = 0.0
        for t in np.linspace(0.0, trajectory.duration, SAMPLES):
            last = trajectory.at_time(float(t))[0][0]
        return last

    return calculate_and_sample
