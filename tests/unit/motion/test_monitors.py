"""Every limit trips just over its value, not just under it, on NaN always, and names what it is about."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import (
    AxisNotEnabled,
    ConsistencyTrip,
    DriveFault,
    FeedbackMissing,
    FollowingErrorTrip,
    InternalForceTrip,
    WarpTrip,
)
from docking.motion.triggers import Trigger
from docking.types import AxisState, FaultKind
from tests.reference_geometry import AXES, rc1
from tests.support.motion_fakes import LIMITS, read_back, watch_of
from tests.support.planned_moves import lab_site
from tests.support.rigid_figure import sockets_mm

Q = np.zeros(12)
WIDE = replace(LIMITS, following_rest_mm=9.0, following_vmax_mm=9.0, ball_residual_mm=9.0, internal_force_n=9e9)
WIDE = replace(WIDE, warp_force_n=9e9, ball_rms_mm=9.0, ball_pair_mm=9.0)
K = 20000.0
"""Stiffness of every axis of RC-1, N/mm."""


def rc1_watch(limits=LIMITS):
    """RC-1 with axes along W: what a pattern of deviations means there can be told by hand."""
    watch = watch_of(rc1(), limits)
    watch.watch_about(Q)
    return watch


def judge(watch, feedback, q_ref_mm, speed_mm_s, may_stop=False):
    """The error of what the watch finds, or None."""
    finding = watch.evaluate(feedback, q_ref_mm, speed_mm_s, moving=True, may_stop=may_stop)
    return None if finding is None else finding.error


def pattern(axis: int, a: float, b: float, c: float, d: float):
    """Deviations (12,) of axis 0, 1, 2 of the four positioners."""
    q = np.zeros(12)
    q[axis::3] = (a, b, c, d)
    return q


def test_a_healthy_read_back_trips_nothing():
    watch = rc1_watch()
    assert judge(watch, read_back(Q), Q, 0.0) is None
    assert (watch.max_residual_mm, watch.max_internal_force_n) == (0.0, 0.0)


@pytest.mark.parametrize("row", range(12))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_following_error_at_rest(row, sign):
    errors = np.zeros(12)
    errors[row] = sign * 0.0999
    assert judge(rc1_watch(), read_back(Q, following_error_mm=errors), Q, 0.0) is None
    errors[row] = sign * 0.1001
    trip = judge(rc1_watch(), read_back(Q, following_error_mm=errors), Q, 0.0)
    assert isinstance(trip, FollowingErrorTrip)
    assert trip.where == AXES[row]
    assert trip.value == pytest.approx(sign * 0.1001)
    assert trip.limit == pytest.approx(0.1)


@pytest.mark.parametrize(("speed", "limit"), [(10.0, 0.5), (5.0, 0.3), (0.0, 0.1)])
def test_following_error_is_allowed_to_grow_with_the_speed_of_its_own_axis(speed, limit):
    speeds = np.zeros(12)
    speeds[4] = speed
    errors = np.zeros(12)
    errors[4] = limit - 0.001
    assert judge(rc1_watch(), read_back(Q, following_error_mm=errors), Q, speeds) is None
    errors[4] = limit + 0.001
    trip = judge(rc1_watch(), read_back(Q, following_error_mm=errors), Q, speeds)
    assert isinstance(trip, FollowingErrorTrip)
    assert trip.where == "B.Y"
    speeds[:] = (10.0,) * 12
    speeds[4] = speed
    assert isinstance(judge(rc1_watch(), read_back(Q, following_error_mm=errors), Q, speeds), FollowingErrorTrip)


def test_a_passive_axis_has_no_set_point_to_follow():
    driven = np.ones(12, dtype=bool)
    driven[3] = False
    watch = watch_of(rc1(driven=driven))
    watch.watch_about(Q)
    errors = np.zeros(12)
    errors[3] = 5.0
    assert judge(watch, read_back(Q, following_error_mm=errors), Q, 0.0) is None


@pytest.mark.parametrize("row", range(12))
def test_nan_in_any_following_error_trips(row):
    errors = np.zeros(12)
    errors[row] = np.nan
    trip = judge(rc1_watch(WIDE), read_back(Q, following_error_mm=errors), Q, 0.0)
    assert isinstance(trip, FollowingErrorTrip)
    assert trip.where == AXES[row]


@pytest.mark.parametrize("row", range(12))
def test_nan_in_any_position_trips(row):
    position = np.zeros(12)
    position[row] = np.nan
    assert isinstance(judge(rc1_watch(WIDE), read_back(position), Q, 0.0), ConsistencyTrip)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_stretched_figure_trips_on_its_residual(axis):
    # A and B lie at -3000 and 3000 along X, D and C likewise; A, D and B, C at -1800 and 1800 along Y.
    stretch = (-1.0, 1.0, 1.0, -1.0) if axis == 0 else (-1.0, -1.0, 1.0, 1.0)
    watch = rc1_watch(replace(WIDE, ball_residual_mm=0.1))
    assert judge(watch, read_back(pattern(axis, *np.multiply(0.0999, stretch))), Q, 0.0) is None
    assert watch.residual_mm == pytest.approx(0.0999, rel=1e-9)
    trip = judge(watch, read_back(pattern(axis, *np.multiply(0.1001, stretch))), Q, 0.0)
    assert isinstance(trip, ConsistencyTrip)
    assert trip.value == pytest.approx(0.1001, rel=1e-9)
    assert trip.limit == pytest.approx(0.1)


def test_a_stretched_figure_trips_on_the_force_that_it_means():
    watch = rc1_watch(replace(WIDE, internal_force_n=1500.0))
    under, over = 0.99 * 1500.0 / K, 1.01 * 1500.0 / K
    assert judge(watch, read_back(pattern(0, -under, under, under, -under)), Q, 0.0) is None
    trip = judge(watch, read_back(pattern(0, -over, over, over, -over)), Q, 0.0)
    assert isinstance(trip, InternalForceTrip)
    assert trip.value == pytest.approx(1.01 * 1500.0, rel=1e-6)
    assert watch.max_internal_force_n == pytest.approx(1.01 * 1500.0, rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_twisted_table_trips_on_warp(sign):
    watch = rc1_watch(replace(WIDE, warp_force_n=300.0))
    under, over = sign * 0.99 * 300.0 / K, sign * 1.01 * 300.0 / K
    assert judge(watch, read_back(pattern(2, under, -under, under, -under)), Q, 0.0) is None
    trip = judge(watch, read_back(pattern(2, over, -over, over, -over)), Q, 0.0)
    assert isinstance(trip, WarpTrip)
    assert abs(trip.value) == pytest.approx(1.01 * 300.0, rel=1e-6)


def test_deviations_that_move_the_whole_figure_are_no_coupling():
    watch = rc1_watch(replace(WIDE, ball_residual_mm=1e-3, ball_pair_mm=1e-3, internal_force_n=1.0, warp_force_n=1.0))
    assert judge(watch, read_back(np.tile([0.7, -0.4, 0.9], 4)), Q, 0.0) is None
    watch.watch_about(Q)
    assert judge(watch, read_back(pattern(2, -0.03, 0.03, 0.03, -0.03)), Q, 0.0) is None


def test_the_figure_is_judged_against_the_reference_it_belongs_to():
    watch = rc1_watch(replace(WIDE, ball_residual_mm=0.1))
    there = pattern(0, -3.0, 3.0, 3.0, -3.0)
    assert judge(watch, read_back(there), there, 0.0) is None
    watch.watch_about(Q)
    assert isinstance(judge(watch, read_back(there), Q, 0.0), ConsistencyTrip)


def test_one_axis_out_in_a_crooked_cell_leaves_what_a_rigid_fit_leaves():
    positioners = lab_site().positioners
    watch = watch_of(positioners, WIDE)
    watch.watch_about(Q)
    where = positioners.origins_W_mm, positioners.axes_W
    start = sockets_mm(*where, Q)[0]
    out = np.zeros(12)
    out[7] = 0.05
    off = (sockets_mm(*where, out)[0] - start).reshape(-1)
    arms = start - start.mean(axis=0)
    moves = [np.tile(unit, (4, 1)) for unit in np.eye(3)] + [np.cross(unit, arms) for unit in np.eye(3)]
    rigid = np.array([move.reshape(-1) for move in moves]).T
    left = off - rigid @ np.linalg.lstsq(rigid, off, rcond=None)[0]
    judge(watch, read_back(out), Q, 0.0)
    assert watch.residual_mm == pytest.approx(np.linalg.norm(left.reshape(4, 3), axis=1).max(), rel=1e-6)
    assert 0.01 < watch.residual_mm < 0.05


def test_two_read_backs_missed_in_a_row_trip_where_two_are_the_limit():
    age = np.zeros(12)
    age[8] = 1.0
    assert judge(rc1_watch(), read_back(Q, age_cycles=age), Q, 0.0) is None
    age[8] = 2.0
    trip = judge(rc1_watch(), read_back(Q, age_cycles=age), Q, 0.0)
    assert isinstance(trip, FeedbackMissing)
    assert (trip.where, trip.value, trip.limit) == ("C.Z", 2.0, 2)
    age[8] = np.nan
    trip = judge(rc1_watch(WIDE), read_back(Q, age_cycles=age), Q, 0.0)
    assert isinstance(trip, FeedbackMissing)
    assert trip.where == "C.Z"


def test_a_fault_of_a_drive_comes_before_what_follows_from_it():
    errors = np.full(12, 9.0)
    told = read_back(Q, fault=("D.Y", 0x7305, "encoder"), following_error_mm=errors)
    trip = judge(rc1_watch(), told, Q, 0.0)
    assert isinstance(trip, DriveFault)
    assert (trip.where, trip.value, trip.cause) == ("D.Y", 0x7305, "encoder")


@pytest.mark.parametrize("state", [s for s in AxisState if s is not AxisState.ENABLED])
@pytest.mark.parametrize("row", [0, 7])
def test_a_driven_axis_that_is_not_enabled_trips(row, state):
    states = [AxisState.ENABLED] * 12
    states[row] = state
    watch = rc1_watch()
    told = read_back(Q, states=tuple(states))
    trip = judge(watch, told, Q, 0.0)
    assert isinstance(trip, AxisNotEnabled)
    assert (trip.where, trip.value, trip.limit) == (AXES[row], state.value, "enabled")
    stopping = state is AxisState.STOPPING
    assert (judge(watch, told, Q, 0.0, may_stop=True) is None) == stopping
    # What was let pass once is judged again when no stop is under way.
    assert isinstance(judge(watch, told, Q, 0.0), AxisNotEnabled)
    late = np.zeros(12)
    late[3] = 1.0
    assert isinstance(judge(watch, read_back(Q, states=tuple(states), age_cycles=late), Q, 0.0), AxisNotEnabled)


def test_a_passive_axis_is_never_enabled():
    driven = np.ones(12, dtype=bool)
    driven[3] = False
    watch = watch_of(rc1(driven=driven))
    watch.watch_about(Q)
    states = [AxisState.ENABLED] * 12
    states[3] = AxisState.DISABLED
    assert judge(watch, read_back(Q, states=tuple(states)), Q, 0.0) is None


def test_maxima_are_kept_until_the_next_move():
    watch = rc1_watch()
    judge(watch, read_back(pattern(0, -0.02, 0.02, 0.02, -0.02), following_error_mm=np.full(12, -0.05)), Q, 0.0)
    judge(watch, read_back(Q), Q, 0.0)
    assert watch.max_residual_mm == pytest.approx(0.02)
    assert watch.max_internal_force_n == pytest.approx(0.02 * K)
    np.testing.assert_allclose(watch.max_following_mm, 0.05)
    watch.reset_maxima()
    assert (watch.max_residual_mm, watch.max_internal_force_n) == (0.0, 0.0)
    np.testing.assert_array_equal(watch.max_following_mm, 0.0)


@pytest.mark.parametrize("row", [0, 7, 11])
def test_a_coupling_trip_names_the_axis_that_is_out_of_its_place(row):
    out = np.zeros(12)
    out[row] = -0.5
    trip = judge(rc1_watch(), read_back(out), Q, 0.0)
    assert AXES[row] in trip.text()
    assert "-0.500 mm" in trip.text()


def test_one_silent_axis_is_told_from_a_silent_bus():
    age = np.full(12, 2.0)
    finding = rc1_watch().evaluate(read_back(Q, age_cycles=age), Q, 0.0, moving=True)
    assert finding is not None
    assert finding.trigger is Trigger.ALL_MISSING
    age[3] = 1.0
    finding = rc1_watch().evaluate(read_back(Q, age_cycles=age), Q, 0.0, moving=True)
    assert finding is not None
    assert finding.trigger is Trigger.FEEDBACK_MISSING


def test_an_axis_that_went_off_is_told_with_what_its_drive_said():
    off = (*[AxisState.ENABLED] * 5, AxisState.STOPPING, *[AxisState.ENABLED] * 6)
    said = {"states": off, "fault": ("B.Z", 0x8700, "SYNC lost"), "fault_kind": FaultKind.DRIVE_WARNING}
    trip = judge(rc1_watch(), read_back(Q, **said), Q, 0.0)
    assert isinstance(trip, AxisNotEnabled)
    assert "SYNC lost (8700h)" in trip.text()
    other = judge(rc1_watch(), read_back(Q, **(said | {"fault": ("A.X", 0x8700, "SYNC lost")})), Q, 0.0)
    assert other is not None
    assert "SYNC" not in other.text()


def test_a_late_read_back_is_no_squeezed_part_but_is_told_with_what_else_trips():
    watch = rc1_watch(replace(LIMITS, missing_cycles=3))
    moved = np.full(12, 0.3)
    moved[4] = 0.0
    age = np.zeros(12)
    age[4] = 2.0
    assert isinstance(judge(watch, read_back(moved), Q, 0.0), ConsistencyTrip)
    assert judge(watch, read_back(moved, age_cycles=age), Q, 0.0) is None
    behind = np.zeros(12)
    behind[1] = 0.2
    trip = judge(watch, read_back(moved, age_cycles=age, following_error_mm=behind), Q, 0.0)
    assert isinstance(trip, FollowingErrorTrip)
    assert trip.where == "A.Y"
    assert "B.Y has not reported for 2 cycles" in trip.text()


def test_the_figure_is_left_unjudged_for_two_cycles_in_a_row_at_most():
    watch = rc1_watch(replace(LIMITS, missing_cycles=20))
    squeezed = np.full(12, 0.3)
    squeezed[4] = 0.0
    age = np.zeros(12)
    age[4] = 1.0
    late, fresh = read_back(squeezed, age_cycles=age), read_back(Q)
    for _ in range(3):
        assert [judge(watch, late, Q, 0.0) for _ in range(2)] == [None, None]
        assert judge(watch, fresh, Q, 0.0) is None
    assert [judge(watch, late, Q, 0.0) for _ in range(2)] == [None, None]
    trip = judge(watch, late, Q, 0.0)
    assert isinstance(trip, ConsistencyTrip)
    assert "B.Y has not reported for 1 cycles" in trip.text()
    # All late alike: the figure as it was, somewhere along the path.
    watch = rc1_watch(replace(LIMITS, missing_cycles=20))
    behind = read_back(np.tile([-0.3, 0.1, 0.2], 4), age_cycles=np.ones(12))
    assert [judge(watch, behind, Q, 0.0) for _ in range(10)] == [None] * 10
