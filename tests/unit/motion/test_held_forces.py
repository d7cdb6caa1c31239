"""The monitor of axes that hold a force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import AxisDrift, BallForceTrip, BallUnloaded
from docking.motion.monitors.held import HeldForces
from docking.motion.monitors.limits import Margins, Timing, WatchLimits
from docking.motion.monitors.travel import Travel
from docking.motion.triggers import Finding, Trigger
from docking.types import AxisState, Feedback
from tests.reference_geometry import AXES, rc3

K = AXES.index("D.Z")
ON = (AxisState.ENABLED,) * 12
HELD = np.where(np.arange(12) == K, 13400.0, 0.0)
FOLLOWER = replace(rc3(d_z_driven=False), held_n=HELD, held_tolerance_n=0.02 * HELD)


def feedback(d_z_n: float, states: tuple[AxisState, ...] = ON, *, d_z_mm: float = 0.0, t_s: float = 0.0) -> Feedback:
    force, position = np.full(12, 1000.0), np.zeros(12)
    force[K], position[K] = d_z_n, d_z_mm
    return Feedback(t_s, position, np.zeros(12), force, states, np.zeros(12))


def judged(*readings: Feedback) -> list[Finding | None]:
    held = HeldForces(FOLLOWER, np.ones(12, dtype=bool), Margins())
    return [held.judge(reading) for reading in readings]


@pytest.mark.parametrize("force_n", [13400.0, 13667.0, 13133.0])
def test_inside_the_tolerance_nothing_is_found(force_n: float) -> None:
    assert judged(*[feedback(force_n + i) for i in (0.0, 0.5, 0.9)]) == [None] * 3


@pytest.mark.parametrize(
    ("force_n", "trigger", "kind", "limit"),
    [(13700.0, Trigger.OVERLOAD, BallForceTrip, 13668.0), (13100.0, Trigger.UNDERLOAD, BallUnloaded, 13132.0)],
)
def test_two_readings_in_a_row_outside_are_found(force_n, trigger, kind, limit) -> None:
    first, same, second, _, third, fourth = judged(
        feedback(force_n),
        feedback(force_n),
        feedback(force_n + 1.0),
        feedback(13400.0),
        feedback(force_n),
        feedback(0.0),
    )
    assert (first, same, third) == (None, None, None), "one reading, however often it is shown, is not enough"
    assert second is not None
    assert fourth is not None
    assert second.trigger is trigger
    assert isinstance(second.error, kind)
    assert (second.error.where, second.error.value, second.error.limit) == ("D.Z", force_n + 1.0, limit)


def test_a_reading_that_is_no_number_is_outside() -> None:
    assert judged(feedback(float("nan")), feedback(float("nan")))[1] is not None


def test_an_axis_that_holds_its_position_is_not_asked() -> None:
    stopping = (*ON[:K], AxisState.STOPPING)
    assert judged(feedback(9000.0, stopping), feedback(9001.0, stopping), feedback(9002.0)) == [None] * 3


def test_an_axis_that_leaves_its_place_runs_away() -> None:
    margins = Margins()
    limits = WatchLimits(0.1, 0.5, 0.1, 1500.0, 300.0, 2.0)
    travel = Travel(FOLLOWER, limits, Timing(), margins)
    at_rest = np.zeros(12)
    for i, d_z_mm in enumerate((0.0, 0.12, 0.24, 0.36, 0.48)):
        assert travel.judge(feedback(0.0, d_z_mm=d_z_mm, t_s=0.01 * i), at_rest, moving=False, led=True) is None
    found = travel.judge(feedback(0.0, d_z_mm=0.6, t_s=0.05), at_rest, moving=False, led=True)
    assert found is not None
    assert found.trigger is Trigger.DRIFT
    assert isinstance(found.error, AxisDrift)
    assert (found.error.where, found.error.value, found.error.limit) == ("D.Z", 0.6, 0.5)
    assert margins.peaks["held_axis"] == pytest.approx(1.2)
