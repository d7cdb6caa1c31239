"""P4: a stop from any instant of a move against a twelve-axis stop computed by ruckig."""

from __future__ import annotations

import numpy as np
import ruckig

from docking.motion.playback import Playback
from docking.motion.stops import planned_stop
from docking.types import Plan
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side
from tests.support.planned_moves import a_plan, rc1_site

INSTANTS = 200
CYCLE_S = 0.01


def measure(sizes: Sizes) -> list[Metric]:
    site = rc1_site()
    plan = a_plan(site, 1)
    slew = planned_stop(plan, site.positioners.a_quick_mm_s2, CYCLE_S).fast_slew_per_s
    works = {
        "path": lambda: _stops(plan, None),
        "fast": lambda: _stops(plan, slew),
        "ruckig": lambda: _ruckig(plan),
    }
    times = side_by_side(works, sizes.repeats)
    each_us = {name: np.median(taken) / INSTANTS * 1e6 for name, taken in times.items()}
    return [
        Metric(
            "P4",
            f"{what} from any s, first set-point included",
            f"{each_us[name]:.1f} us",
            f"ruckig 12 axes {each_us['ruckig']:.1f} us",
            median_ratio(times[name], times["ruckig"]),
            20.0,
            at_least=False,
        )
        for name, what in (("path", "path-preserving stop"), ("fast", "fast path-preserving stop"))
    ]


def _stops(plan: Plan, slew_per_s: float | None) -> None:
    for tau_s in np.linspace(0.0, plan.duration_s, INSTANTS).tolist():
        playback = Playback(plan)
        playback.path_time_s = tau_s
        if slew_per_s is None:
            playback.hold()
        else:
            playback.stop_straight(slew_per_s)
        playback.advance(CYCLE_S)


def _ruckig(plan: Plan) -> None:
    """Each axis to rest from the plan's speed and acceleration there, all in one time; the first set-point, too."""
    count = plan.q_mm.shape[1]
    speed = np.gradient(plan.q_mm, plan.period_s, axis=0)
    bend = np.gradient(speed, plan.period_s, axis=0)
    rows = np.linspace(0, len(plan.q_mm) - 1, INSTANTS).round().astype(int)
    states = [(plan.q_mm[row].tolist(), speed[row].tolist(), bend[row].tolist()) for row in rows]
    otg, given, found = ruckig.Ruckig(count), ruckig.InputParameter(count), ruckig.Trajectory(count)
    given.control_interface = ruckig.ControlInterface.Velocity
    given.max_acceleration, given.max_jerk = [10.0] * count, [50.0] * count
    given.target_velocity = given.target_acceleration = [0.0] * count
    for position, velocity, acceleration in states:
        given.current_position, given.current_velocity, given.current_acceleration = position, velocity, acceleration
        assert otg.calculate(given, found) in (ruckig.Result.Working, ruckig.Result.Finished)
        found.at_time(CYCLE_S)
