"""What the planner may do, beyond the limits of the axes themselves."""

from __future__ import annotations

from dataclasses import dataclass

from docking.kinematics import Load


@dataclass(frozen=True, eq=False)
class PlanSettings:
    """Settings of path pacing and pre-flight.

    `sync_error_mm`, `start_skew_s`, `clock_ppm` bound the speed of axes that start and run on their own clocks: two
    controllers part by speed x (skew + 2 ppm T). `playback_ramp_s` is the fixed time in which the devices take the
    playback rate from 1 to 0 (0: the host sets the rate). `acceleration_share` of each axis is for the path, the rest
    for holding and stopping on it. `reaction_min_fraction` is of the equal share of the weight.
    """

    load: Load
    stroke_margin_mm: float = 2.0
    reaction_min_fraction: float = 0.1
    chord_error_mm: float = 0.02
    sync_error_mm: float = 0.05
    start_skew_s: float = 0.0
    clock_ppm: float = 0.0
    playback_ramp_s: float = 0.0
    acceleration_share: float = 0.5
    rate_slew_max_per_s: float = 10.0
    sample_mm: float = 0.05
