"""What load cells show against what is expected: tare, attitude, two samples in a row, lost contact, silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import BallForceTrip, BallUnloaded, LoadCellSilent, MeasuredForceTrip, MeasuredWarpTrip
from docking.motion.monitors import Watch
from docking.motion.triggers import Trigger
from tests.reference_geometry import AXES, BALLS, rc1
from tests.support.motion_fakes import LIMITS, LOAD, read_back

WIDE = replace(LIMITS, ball_residual_mm=9.0, ball_rms_mm=9.0, ball_pair_mm=9.0, internal_force_n=9e9, warp_force_n=9e9)
WIDE = replace(WIDE, overload=2.9, underload=0.01, measured_force_n=9e9, measured_warp_n=9e9)
WIDE = replace(WIDE, measured_whole_force_n=9e9, measured_whole_warp_n=9e9)
Q = np.zeros(12)
WEIGHT_N = 6000.0 * 9.80665
SAMPLE_S = 0.1
WARP = np.array([1.0, -1.0, 1.0, -1.0])


def z_loads_n(com_x_mm, com_y_mm):
    """Vertical reactions (4,) of RC-1 by the two lever rules of a rectangle on equal springs."""
    x, y = com_x_mm / 3000.0 / 4.0, com_y_mm / 1800.0 / 4.0
    return WEIGHT_N * np.array([0.25 - x - y, 0.25 + x - y, 0.25 + x + y, 0.25 - x + y])


def resting():
    """Load-cell readings (12,) of RC-1, level and free of strain."""
    force = np.zeros(12)
    force[2::3] = z_loads_n(600.0, 200.0)
    return force


def plus(row, value):
    force = resting()
    force[row] += value
    return force


class Bench:
    """A watch that gets one sample of the load cells after another."""

    def __init__(self, limits=WIDE, fitted=None, force=None, relief=False):
        cells = np.ones(12, dtype=bool) if fitted is None else fitted
        self.watch = Watch(rc1(), LOAD, limits, cells)
        self.watch.watch_about(Q)
        self.t_s = 0.0
        for _ in range(4):
            self.sample(resting() if force is None else force, moving=False)
        self.watch.watch_about(Q, relief=relief)

    def sample(self, force, *, moving=True, q=Q, after_s=SAMPLE_S):
        self.t_s += after_s
        told = read_back(q, t_s=self.t_s, force_n=np.array(force, dtype=float))
        return self.watch.evaluate(told, q, 10.0, moving=moving)

    def twice(self, force, **how):
        """The finding of the second of two like samples; the first never is one."""
        assert self.sample(force, **how) is None
        return self.sample(force, **how)


def test_the_weight_of_the_part_is_expected():
    bench = Bench(replace(WIDE, measured_force_n=1.0, measured_whole_force_n=1.0, measured_whole_warp_n=1.0))
    assert bench.twice(resting()) is None
    assert bench.watch.measured_force_n == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("row", [0, 5, 10])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_that_comes_during_the_move_trips(row, sign):
    limits = replace(WIDE, measured_force_n=500.0)
    assert Bench(limits).twice(plus(row, sign * 499.0)) is None
    found = Bench(limits).twice(plus(row, sign * 501.0))
    assert found is not None
    assert found.trigger is Trigger.MEASURED_FORCE
    assert isinstance(found.error, MeasuredForceTrip)
    assert (found.error.value, found.error.limit) == (pytest.approx(501.0), 500.0)


def test_what_was_there_when_the_move_was_loaded_is_tared_up_to_the_limit_of_the_whole():
    limits = replace(WIDE, measured_force_n=500.0, measured_whole_force_n=800.0)
    strained = plus(3, 790.0)
    bench = Bench(limits, force=strained)
    assert bench.twice(strained) is None
    assert bench.watch.measured_force_n == pytest.approx(0.0, abs=1e-6)
    found = bench.twice(plus(3, 801.0))
    assert found is not None
    assert (found.trigger, found.error.value) == (Trigger.MEASURED_FORCE, pytest.approx(801.0))


def test_a_relief_begins_with_a_strained_part_and_only_what_is_added_counts():
    limits = replace(WIDE, measured_force_n=500.0, measured_whole_force_n=800.0, measured_whole_warp_n=300.0)
    strained = plus(2, 6000.0)
    assert Bench(limits, force=strained).twice(strained) is not None
    bench = Bench(limits, force=strained, relief=True)
    assert bench.twice(strained) is None
    found = bench.twice(plus(2, 6501.0))
    assert found is not None
    assert found.trigger is Trigger.MEASURED_FORCE


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_warp_has_its_own_limit(sign):
    for warp, trips in ((299.0, False), (301.0, True)):
        bench = Bench(replace(WIDE, measured_warp_n=300.0))
        force = resting()
        force[2::3] += sign * warp * WARP
        found = bench.twice(force)
        assert (found is not None) == trips
        if found is not None:
            assert found.trigger is Trigger.MEASURED_WARP
            assert isinstance(found.error, MeasuredWarpTrip)
            assert found.error.value == pytest.approx(301.0)


def test_a_tilt_loads_no_warp():
    bench = Bench(replace(WIDE, measured_warp_n=1.0))
    force = resting()
    force[2::3] += 400.0 * np.array([1.0, 1.0, -1.0, -1.0])
    assert bench.twice(force) is None


def test_one_sample_is_none_and_a_sample_that_comes_in_two_parts_is_one():
    bench = Bench(replace(WIDE, measured_force_n=500.0, standing_force_n=9e9))
    spike = plus(4, 5000.0)
    for _ in range(3):
        assert bench.sample(spike) is None
        assert bench.sample(resting()) is None
    assert bench.sample(spike) is None
    # The cells of one SYNC, some of them a cycle later than the others: the reading that stays is no second sample.
    assert bench.sample(spike.copy(), after_s=0.01) is None
    assert bench.sample(spike) is not None


def test_a_sample_that_is_shown_again_counts_once():
    bench = Bench(replace(WIDE, measured_force_n=500.0))
    told = read_back(Q, t_s=10.0, force_n=plus(4, 5000.0))
    for k in range(20):
        assert bench.watch.evaluate(replace(told, t_s=10.0 + 0.01 * k), Q, 10.0, moving=True) is None


def test_a_finding_lasts_as_long_as_its_cause():
    bench = Bench(replace(WIDE, measured_force_n=500.0))
    bad = plus(4, 5000.0)
    assert bench.twice(bad) is not None
    again = read_back(Q, t_s=bench.t_s + 0.01, force_n=bench.watch._loads._seen)
    assert bench.watch.evaluate(again, Q, 10.0, moving=True) is not None
    assert bench.sample(resting()) is None


def test_a_strain_at_rest_stops_nothing():
    bench = Bench(replace(WIDE, measured_force_n=500.0, measured_whole_force_n=500.0))
    for _ in range(3):
        assert bench.sample(plus(4, 5000.0), moving=False) is None
    assert bench.watch.measured_force_n == pytest.approx(5000.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_attitude_changes_what_is_expected(axis):
    """Turned by 1 deg the centre of mass, 1.2 m above the balls, moves by 21 mm: 200 N from one side to the other."""
    turn = Rotation.from_rotvec(np.radians(1.0) * np.eye(3)[axis]).as_matrix()
    balls = BALLS @ turn.T
    q = (balls - BALLS).reshape(-1)
    com = turn @ LOAD.com_C_mm
    # Least-norm reactions to the weight, from scratch: f = J (J^T J)^-1 times minus the wrench.
    rows = [np.hstack([np.eye(3), -np.cross(np.eye(3), b)]) for b in balls]
    jac = np.vstack(rows)
    weight = np.array([0.0, 0.0, -WEIGHT_N])
    wrench = np.hstack([weight, np.cross(com, weight)])
    turned = -jac @ np.linalg.solve(jac.T @ jac, wrench)
    assert np.abs(turned - resting()).max() > 100.0
    bench = Bench(replace(WIDE, measured_force_n=10.0))
    assert bench.twice(turned, q=q) is None
    assert bench.watch.measured_force_n < 5.0
    still = Bench(replace(WIDE, measured_force_n=10.0))
    assert still.twice(resting(), q=q) is not None


@pytest.mark.parametrize(
    ("share", "trigger"),
    [
        (1.099, None),
        (1.101, Trigger.OVERLOAD),
        (0.501, None),
        (0.499, Trigger.UNDERLOAD),
        (-0.5, Trigger.UNDERLOAD),
    ],
)
@pytest.mark.parametrize("ball", [1, 3])
@pytest.mark.parametrize("moving", [True, False])
def test_each_ball_carries_about_its_share(share, trigger, ball, moving):
    bench = Bench(replace(WIDE, overload=1.1, underload=0.5))
    force = resting()
    expected = force[3 * ball + 2]
    force[3 * ball + 2] = share * expected
    found = bench.twice(force, moving=moving)
    if trigger is Trigger.OVERLOAD and not moving:
        trigger = None  # a strained part may stand so: a relief begins from there
    assert (None if found is None else found.trigger) is trigger
    if found is not None:
        assert isinstance(found.error, BallForceTrip if trigger is Trigger.OVERLOAD else BallUnloaded)
        assert found.error.where == "ABCD"[ball]
        assert found.error.value == pytest.approx(share * expected)
        assert f"{expected:.0f} N are expected" in found.error.text()


@pytest.mark.parametrize(("row", "rated"), [(0, 10000.0), (4, 10000.0), (8, 50000.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_axis_carries_more_than_its_rating(row, rated, sign):
    limits = replace(WIDE, overload=1e6, underload=-1e6)
    force = resting()
    force[row] = sign * 1.0999 * rated
    assert Bench(limits).twice(force) is None
    force[row] = sign * 1.1001 * rated
    found = Bench(limits).twice(force)
    assert found is not None
    assert found.trigger is Trigger.OVERLOAD
    assert (found.error.where, found.error.limit) == (AXES[row], pytest.approx(1.1 * rated))


@pytest.mark.parametrize("row", range(12))
@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_cell_that_does_not_report_is_told_at_once(row, moving, value):
    found = Bench().sample(plus(row, value), moving=moving)
    assert found is not None
    assert found.trigger is Trigger.FORCE_MISSING
    assert isinstance(found.error, LoadCellSilent)
    assert found.error.where == AXES[row]


def test_positioners_without_a_cell_are_left_out():
    fitted = np.array([True] * 9 + [False] * 3)
    force = np.where(fitted, resting(), np.nan)
    limits = replace(LIMITS, measured_force_n=500.0)
    bench = Bench(limits, fitted, force)
    assert bench.twice(force) is None
    force[3] += 501.0
    found = bench.twice(force)
    assert found is not None
    assert found.trigger is Trigger.MEASURED_FORCE
    none = np.zeros(12, dtype=bool)
    bench = Bench(limits, none, np.full(12, np.nan))
    assert bench.twice(np.full(12, np.nan)) is None
    assert np.isnan(bench.watch.measured_force_n)


# at rest -----------------------------------------------------------------------------------------------------------
def strained(limits, force, *, relief=False):
    """What is said before a move about a part that shows `force` at rest."""
    bench = Bench(limits, force=force, relief=relief)
    told = read_back(Q, t_s=bench.t_s, force_n=force)
    return bench.watch.strained_before(told)


def twisted(force_n):
    """Load cells of a part whose vertical axes press against each other with `force_n` each."""
    force = resting()
    force[2::3] += force_n * WARP
    return force


@pytest.mark.parametrize(
    ("limits", "trigger", "kind"),
    [
        ({"measured_whole_force_n": 1000.0}, Trigger.MEASURED_FORCE, MeasuredForceTrip),
        ({"measured_whole_warp_n": 1000.0}, Trigger.MEASURED_WARP, MeasuredWarpTrip),
    ],
)
def test_a_strained_part_is_not_moved_but_by_a_relief(limits, trigger, kind):
    limits = replace(WIDE, overload=9.0, underload=0.01, **limits)
    at_limit = 1000.0 if trigger is Trigger.MEASURED_FORCE else 1000.0 / strained_warp_of_one(limits)
    assert strained(limits, twisted(0.99 * at_limit)) is None
    found = strained(limits, twisted(1.01 * at_limit))
    assert found is not None
    assert found.trigger is trigger
    assert isinstance(found.error, kind)
    assert found.error.limit == 1000.0
    assert found.error.value == pytest.approx(1010.0)
    assert "docking relieve" in found.error.text()
    assert strained(limits, twisted(1.01 * at_limit), relief=True) is None


def strained_warp_of_one(limits):
    """Warp that one newton at every vertical axis, with its sign, makes."""
    bench = Bench(replace(limits, measured_whole_warp_n=9e9), force=twisted(1.0))
    bench.sample(twisted(1.0), moving=False)
    return bench.watch._loads.whole_warp_n


def test_a_ball_that_carries_too_much_is_not_moved_either():
    limits = replace(WIDE, overload=1.1, underload=0.5)
    share = z_loads_n(600.0, 200.0)
    assert strained(limits, plus(2, 0.09 * share[0])) is None
    found = strained(limits, plus(2, 0.11 * share[0]))
    assert found is not None
    assert (found.trigger, found.error.where) == (Trigger.OVERLOAD, "A")
    assert "docking relieve" in found.error.text()
    assert strained(limits, plus(2, 0.11 * share[0]), relief=True) is None


def test_a_force_that_changes_between_load_and_start_is_told():
    bench = Bench(replace(WIDE, standing_force_n=200.0))

    def changed(force):
        return bench.watch.changed_at_rest(read_back(Q, t_s=bench.t_s, force_n=force))

    assert changed(resting()) is None
    assert changed(plus(3, 199.0)) is None
    for force in (plus(3, 201.0), plus(3, -201.0), twisted(201.0)):
        found = changed(force)
        assert found is not None
        assert isinstance(found.error, MeasuredForceTrip)
        assert (found.error.limit, "measure again" in found.error.text()) == (200.0, True)
    assert changed(plus(3, np.nan)) is not None
    # Once the part moves there is nothing to compare with: the limits of the move count.
    bench.sample(resting(), q=Q, after_s=0.01)
    assert changed(plus(3, 201.0)) is None


@pytest.mark.parametrize(("change_n", "trips"), [(199.0, False), (201.0, True), (-201.0, True)])
def test_a_force_that_changes_in_a_hold_is_told_by_its_second_sample(change_n, trips):
    """What the move itself has brought since it was loaded is no change."""
    bench = Bench(replace(WIDE, standing_force_n=200.0))
    begun = plus(4, 900.0)
    for k in range(5):
        assert bench.sample(begun, q=np.full(12, 0.1 * k)) is None
    held = np.full(12, 0.4)
    for _ in range(5):
        assert bench.sample(begun, q=held) is None
    assert bench.sample(plus(4, 900.0 + change_n), q=held) is None
    found = bench.sample(plus(4, 900.0 + change_n), q=held)
    assert (found is not None) == trips
    if found is not None:
        assert found.trigger is Trigger.MEASURED_FORCE
        assert found.error.value == pytest.approx(abs(change_n))
