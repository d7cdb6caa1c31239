"""What the planner may do, beyond the limits of the axes themselves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from docking.kinematics import Load
from docking.types import Array

READINGS = 2
"""Readings of a load cell in a row that must show a force to be wrong."""


@dataclass(frozen=True)
class JamSettings:
    """How soon a jammed axis is met, and what it may cost.

    It is seen when it hangs back by `stuck_mm` more than its lag, one without a set-point by the first of the
    read-backs, `sampled_s` apart, that shows it `passive_mm` behind its place; the others go on for `reaction_s` and
    then ramp down with the axes' a_quick, in `quick_floor_s` at least. An axis that holds a force is also seen by its
    load cell, within `readings_s` of leaving its tolerance. `residual_mm` and `force_n` at the worst ball and `warp_n`
    are the limits; `held_warp_n` where an axis that holds a force jams.
    """

    stuck_mm: float = 0.02
    passive_mm: float = 0.1
    reaction_s: float = 0.022
    quick_floor_s: float = 0.0
    sampled_s: float = 0.01
    readings_s: float = 0.2
    residual_mm: float = 0.1
    force_n: float = 1500.0
    warp_n: float = 300.0
    held_warp_n: float = 600.0


@dataclass(frozen=True, eq=False)
class MateSettings:
    """What must stay clear of what: the component's edges in C, the mate's envelope in M, and by how much.

    `edges_C_mm` (e, 2, 3) straight pieces of the outline; `boxes_M_mm` (b, 2, 3) lower and upper corners; `face_C_mm`
    (3,) centre of the docking face; `axis_M` (3,) unit vector of the insertion. Clearance asked at a gap g to the mate:
    min(clearance_mm, g / 2) - contact_mm. At gaps up to `corridor_length_mm` the part stays within `corridor_mm` of the
    straight insertion. `coast_s`: drives that miss their SYNC go straight on for so long before they stop.
    """

    edges_C_mm: Array
    boxes_M_mm: Array
    face_C_mm: Array
    axis_M: Array
    clearance_mm: float = 2.0
    contact_mm: float = 0.3
    corridor_mm: float = 4.0
    corridor_length_mm: float = 100.0
    coast_s: float = 0.0


NO_MATE = MateSettings(np.zeros((0, 2, 3)), np.zeros((0, 2, 3)), np.zeros(3), np.array([1.0, 0.0, 0.0]))


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
    jam: JamSettings = JamSettings()
    mate: MateSettings = field(default_factory=lambda: NO_MATE)
