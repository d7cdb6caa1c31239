"""Stuck axes, jumping encoders, drift at standstill, passive axes, what devices tell: just over and just under."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import AxisAtLimit, AxisDrift, AxisStuck, DriveFault, DriveWarning, EncoderJump, PassiveAxisTrip
from docking.motion.monitors import Timing, Watch
from docking.motion.triggers import Trigger
from docking.types import AxisState, FaultKind
from tests.reference_geometry import AXES, rc1, rc3
from tests.support.motion_fakes import LIMITS, LOAD, read_back

CYCLE_S, LAG_S = 0.01, 0.002
WIDE = replace(LIMITS, following_rest_mm=9.0, following_vmax_mm=9.0, ball_residual_mm=9.0, ball_rms_mm=9.0)
WIDE = replace(WIDE, ball_pair_mm=9.0, internal_force_n=9e9, warp_force_n=9e9)


class Bench:
    """A watch that is fed cycle by cycle; all axes of RC-1 begin at zero."""

    def __init__(self, positioners=None, limits=WIDE):
        self.watch = Watch(positioners or rc1(), LOAD, limits, np.zeros(12, dtype=bool), Timing(CYCLE_S, LAG_S))
        self.watch.watch_about(np.zeros(12))
        self.t_s = 0.0

    def cycle(self, position, command, error=None, *, moving=True, cycles=1, **changes):
        """The finding of the read-back `cycles` cycles later, None when there is none."""
        self.t_s += cycles * CYCLE_S
        fields = {"t_s": self.t_s, "following_error_mm": np.zeros(12) if error is None else error} | changes
        told = read_back(np.array(position, dtype=float), **fields)
        may_stop = AxisState.STOPPING in told.states
        return self.watch.evaluate(told, np.array(command, dtype=float), 10.0, moving=moving, may_stop=may_stop)


def one(row, value):
    """Twelve zeros and one `value`."""
    result = np.zeros(12)
    result[row] = value
    return result


def ramp(bench, speed_mm_s, cycles, start=0.0):
    """Healthy motion of all axes; the last place."""
    for k in range(cycles + 1):
        place = np.full(12, start + speed_mm_s * CYCLE_S * k)
        assert bench.cycle(place, place, np.full(12, speed_mm_s * LAG_S)) is None
    return place


@pytest.mark.parametrize("row", [0, 4, 11])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_axis_that_hangs_back_and_makes_less_than_half_its_step_is_stuck(row, sign):
    speed = sign * 4.0
    for hang, share, trips in ((0.0201, 0.49, True), (0.0199, 0.0, False), (0.0201, 0.51, False), (0.2, 0.51, False)):
        bench = Bench()
        at = ramp(bench, speed, 3)
        step = speed * CYCLE_S
        error = np.full(12, speed * LAG_S) + one(row, sign * hang)
        finding = bench.cycle(at + step - one(row, (1.0 - share) * step), at + step, error)
        assert (finding is not None) == trips, (hang, share)
        if finding is not None:
            assert finding.trigger is Trigger.STUCK
            assert isinstance(finding.error, AxisStuck)
            assert (finding.error.where, finding.error.limit) == (AXES[row], 0.02)
            assert finding.error.value == pytest.approx(hang)


def test_the_lag_of_a_healthy_axis_is_not_counted_and_grows_with_its_speed():
    # 0.024 mm behind: 0.02 mm are the lag at 10 mm/s; at 1 mm/s they would not be.
    for speed, trips in ((10.0, False), (1.0, True)):
        bench = Bench()
        at = ramp(bench, speed, 1)
        found = bench.cycle(at, at + speed * CYCLE_S, np.full(12, 0.024))
        assert (found is not None) == trips


def test_an_axis_that_is_not_asked_to_move_is_not_stuck():
    bench = Bench()
    at = ramp(bench, 4.0, 2)
    error = np.full(12, 4.0 * LAG_S)
    error[5] = 0.05
    command = at + 0.04
    command[5] = at[5]
    assert bench.cycle(command, command, error) is None


def test_a_gap_in_the_read_backs_is_judged_over_its_whole_length():
    bench = Bench(limits=replace(WIDE, missing_cycles=3))
    at = ramp(bench, 4.0, 2)
    ahead = at + 3 * 0.04
    late = one(3, 2.0)
    assert bench.cycle(at, at + 0.04, np.full(12, 0.008), age_cycles=late) is None
    assert bench.cycle(at, at + 0.08, np.full(12, 0.008), age_cycles=late) is None
    # Three cycles' way in one sample: nobody is stuck, no encoder has jumped.
    assert bench.cycle(ahead, ahead, np.full(12, 0.008)) is None
    error = np.full(12, 0.008) + one(7, 0.05)
    found = bench.cycle(ahead + 0.04 - one(7, 0.04), ahead + 0.04, error)
    assert found is not None
    assert (found.trigger, found.error.where) == (Trigger.STUCK, "C.Y")


def test_nan_in_a_following_error_never_passes():
    bench = Bench()
    at = ramp(bench, 4.0, 2)
    found = bench.cycle(at + 0.04, at + 0.04, one(2, np.nan) + 0.008)
    assert found is not None
    assert found.error.where == "A.Z"


@pytest.mark.parametrize(
    ("share", "trigger"),
    [
        (0.19, Trigger.STUCK),
        (0.0, Trigger.STUCK),
        (-0.19, Trigger.STUCK),
        (0.21, None),
        (1.0, None),
        (1.99, None),
        (2.01, Trigger.ENCODER_JUMP),
        (-1.0, Trigger.ENCODER_JUMP),
    ],
)
def test_five_cycles_of_command_must_show_at_the_encoder(share, trigger):
    """A stuck axis whose own following error stays silent; a slipped scale; a turned sign."""
    bench = Bench()
    step = 0.02
    finding = None
    for k in range(9):
        place = np.full(12, step * k)
        command = place.copy()
        place[9] = share * place[9]
        finding = bench.cycle(place, command)
        if finding is not None:
            break
    assert (None if finding is None else finding.trigger) is trigger
    if finding is not None:
        assert k == 5
        assert finding.error.where == "D.X"
        assert "told to move +0.100 mm" in finding.error.text()


def test_command_and_encoder_are_compared_from_a_twentieth_of_a_millimetre_on():
    for step, trips in ((0.0099, False), (0.0101, True)):
        bench = Bench()
        found = [bench.cycle(np.zeros(12), one(6, step * k)) for k in range(6)]
        assert (found[-1] is not None) == trips
        assert found[:-1] == [None] * 5


def test_an_encoder_that_moves_though_its_axis_is_told_nothing_is_not_believed():
    bench = Bench()
    found = [bench.cycle(one(6, 0.0109 * k), np.zeros(12)) for k in range(6)]
    assert found == [None] * 6
    bench = Bench()
    found = [bench.cycle(one(6, 0.0111 * k), np.zeros(12)) for k in range(6)]
    assert found[-1] is not None
    assert found[-1].trigger is Trigger.ENCODER_JUMP


@pytest.mark.parametrize("row", [0, 7])
@pytest.mark.parametrize("jump", [0.201, -0.201, 1.0, np.nan])
def test_an_encoder_faster_than_twice_its_axis_is_not_believed(row, jump):
    for moving in (True, False):
        bench = Bench()
        at = np.full(12, 1.0)
        bench.cycle(at, at, moving=moving)
        found = bench.cycle(at + one(row, jump), at, moving=moving)
        assert found is not None
        assert found.trigger is Trigger.ENCODER_JUMP
        assert isinstance(found.error, EncoderJump)
        assert (found.error.where, found.error.limit) == (AXES[row], pytest.approx(2.0 * 10.0 * CYCLE_S))


def test_an_encoder_may_be_nearly_twice_as_fast_as_its_axis_and_a_gap_gives_it_more_way():
    bench = Bench()
    at = np.full(12, 1.0)
    assert bench.cycle(at, at) is None
    assert bench.cycle(at + one(3, 0.199), at) is None
    assert bench.cycle(at - one(3, 0.199), at, cycles=2) is None
    found = bench.cycle(at + one(3, 0.21), at, cycles=2)
    assert found is not None


def test_after_a_long_silence_at_rest_a_jump_is_still_one():
    bench = Bench()
    at = np.zeros(12)
    told = read_back(at, t_s=0.0)
    assert bench.watch.evaluate(told, at, 0.0, moving=False) is None
    for k in range(1000):
        again = replace(told, t_s=0.01 * k)
        assert bench.watch.evaluate(again, at, 0.0, moving=False) is None
    moved = replace(told, t_s=10.0, position_mm=one(4, 0.21))
    found = bench.watch.evaluate(moved, at, 0.0, moving=False)
    assert found is not None
    assert found.trigger is Trigger.ENCODER_JUMP


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_axis_that_creeps_at_standstill_is_found_at_its_limit(sign):
    bench = Bench()
    at = ramp(bench, 4.0, 3)
    for _ in range(7):
        assert bench.cycle(at, at, moving=False) is None
    found, gone = None, 0.0
    for k in range(60):
        gone = sign * 0.0015 * k
        found = bench.cycle(at + one(8, gone), at, moving=False)
        if found is not None:
            break
    assert found is not None
    assert found.trigger is Trigger.DRIFT
    assert isinstance(found.error, AxisDrift)
    assert (found.error.where, found.error.limit) == ("C.Z", 0.02)
    assert abs(gone) == pytest.approx(0.021)
    assert np.sign(found.error.value) == sign


def test_coming_to_rest_is_no_drift():
    bench = Bench()
    at = ramp(bench, 4.0, 3)
    for k in range(100):
        assert bench.cycle(at + 0.03 * (1.0 - np.exp(-k / 4.0)), at, moving=False) is None
    # A new move and a new standstill have a new hold point.
    ramp(bench, 4.0, 20, start=at[0] + 0.03)
    there = np.full(12, at[0] + 0.83)
    for _ in range(5):
        assert bench.cycle(there, there, moving=False) is None
    assert bench.cycle(there + one(0, 0.0199), there, moving=False) is None
    assert bench.cycle(there + one(0, 0.0201), there, moving=False) is not None


def test_an_axis_that_never_comes_to_rest_has_a_hold_point_all_the_same():
    bench = Bench()
    found = [bench.cycle(one(8, 0.0021 * k), np.zeros(12), moving=False) for k in range(60)]
    first = next(k for k, finding in enumerate(found) if finding is not None)
    assert found[first].trigger is Trigger.DRIFT
    assert first * CYCLE_S == pytest.approx(0.39, abs=0.03)


def test_a_passive_axis_may_go_where_it_likes_at_standstill_but_not_jump():
    bench = Bench(rc3(), replace(WIDE, passive_mm=9.0))
    passive = AXES.index("C.X")
    for k in range(30):
        assert bench.cycle(one(passive, 0.01 * k), np.zeros(12), moving=False) is None
    found = bench.cycle(one(passive, 0.6), np.zeros(12), moving=False)
    assert found is not None
    assert found.trigger is Trigger.ENCODER_JUMP


@pytest.mark.parametrize("name", ["B.X", "C.Y", "D.Y"])
def test_a_passive_axis_must_be_where_the_driven_ones_take_it(name):
    row = AXES.index(name)
    for off, trips in ((0.099, False), (0.101, True), (-0.101, True), (np.nan, True)):
        bench = Bench(rc3())
        found = bench.cycle(one(row, off), np.zeros(12))
        assert (found is not None) == trips
        if found is not None and not np.isnan(off):
            assert found.trigger is Trigger.PASSIVE_AXIS
            assert isinstance(found.error, PassiveAxisTrip)
            assert (found.error.where, found.error.limit) == (name, 0.1)


def test_an_axis_that_holds_a_force_may_come_off_its_place_by_what_axis_directions_do():
    """Its force tells a jam: 0.12 mm over a long approach are no reason to stop, half a millimetre is."""
    held = 13400.0 * (np.arange(12) == AXES.index("D.Z"))
    follower = replace(rc3(d_z_driven=False), held_n=held, held_tolerance_n=0.02 * held)
    for off, trips in ((0.12, False), (-0.4, False), (0.51, True), (np.nan, True)):
        bench, found = Bench(follower), None
        for k in range(1, 101):
            found = bench.cycle(one(AXES.index("D.Z"), off * k / 100), np.zeros(12))
            if found is not None:
                break
        assert (found is not None) == trips, off


def test_a_passive_axis_may_drift_off_its_place_with_way_but_not_for_ever():
    """Half a millimetre beside its place it has come off the part, however slowly; a jam is seen after a tenth."""
    free = np.flatnonzero(~rc3().driven)
    for limits, last in ((WIDE, 0.5), (replace(WIDE, adrift_mm=0.3), 0.3)):
        bench, found = Bench(rc3(), limits), None
        for k in range(200):
            place = np.zeros(12)
            place[free] = 0.1 * k
            beside = np.where(np.arange(12) == AXES.index("C.Y"), 0.005 * k, 0.0)
            found = bench.cycle(place + beside, place)
            if found is not None:
                break
        assert found is not None
        assert found.trigger is Trigger.PASSIVE_AXIS
        assert (found.error.where, found.error.limit) == ("C.Y", last)
        assert 0.005 * k == pytest.approx(last, abs=0.006)


def test_a_plan_that_is_loaded_begins_where_the_following_axes_stand():
    """What they had come off their places by then is in the plan."""
    bench, at = Bench(rc3()), np.zeros(12)
    for k in range(60):
        at = np.full(12, 0.1 * k)
        assert bench.cycle(at + one(AXES.index("C.Y"), 0.005 * k), at) is None
    at = at + one(AXES.index("C.Y"), 0.295)
    bench.watch.watch_about(at)
    assert bench.cycle(at, at, moving=False) is None
    assert bench.cycle(at, at, moving=False) is None


def test_distances_and_rms_of_the_balls_have_limits_of_their_own():
    stretched = np.zeros(12)
    stretched[[0, 9]] = -0.0749, -0.0749  # A and D along X: B and C stay 6 m away
    for limits, trips in (
        (replace(WIDE, ball_pair_mm=0.0748), True),
        (replace(WIDE, ball_pair_mm=0.0750), False),
        (replace(WIDE, ball_rms_mm=0.0374), True),
        (replace(WIDE, ball_rms_mm=0.0375), False),
    ):
        found = Bench(limits=limits).cycle(stretched, np.zeros(12))
        assert (found is not None) == trips
        if found is not None:
            assert found.trigger is Trigger.COUPLING


@pytest.mark.parametrize("row", [0, 10])
def test_a_limit_switch_is_told(row):
    pressed = np.zeros(12, dtype=bool)
    assert Bench().cycle(np.zeros(12), np.zeros(12), at_limit=pressed) is None
    pressed[row] = True
    found = Bench().cycle(np.zeros(12), np.zeros(12), at_limit=pressed)
    assert found is not None
    assert found.trigger is Trigger.LIMIT_SWITCH
    assert isinstance(found.error, AxisAtLimit)
    assert found.error.where == AXES[row]


@pytest.mark.parametrize("kind", list(FaultKind))
def test_each_kind_of_fault_has_its_trigger(kind):
    bench, told = Bench(), {"fault": ("D.Y", 0x7305, "encoder"), "fault_kind": kind}
    found = bench.cycle(np.zeros(12), np.zeros(12), **told)
    if kind is FaultKind.DRIVE_WARNING:
        # Only the next read-back tells that the drive goes on.
        assert found is None
        found = bench.cycle(np.zeros(12), np.zeros(12), **told)
    assert found is not None
    assert found.trigger.name == kind.name
    expected = DriveWarning if kind is FaultKind.DRIVE_WARNING else DriveFault
    assert isinstance(found.error, expected)
    assert (found.error.where, found.error.value, found.error.cause) == ("D.Y", 0x7305, "encoder")


def test_an_emergency_of_a_drive_that_stops_is_no_warning():
    bench = Bench()
    fault = ("D.Y", 0x2310, "overcurrent")
    assert bench.cycle(np.zeros(12), np.zeros(12), fault=fault, fault_kind=FaultKind.DRIVE_WARNING) is None
    found = bench.cycle(np.zeros(12), np.zeros(12), fault=fault, fault_kind=FaultKind.DRIVE_FAULT)
    assert found is not None
    assert found.trigger is Trigger.DRIVE_FAULT


def test_a_warning_at_rest_is_told_though_nothing_else_changes():
    bench = Bench()
    told = read_back(np.zeros(12), fault=("D.Y", 0x7305, "encoder"), fault_kind=FaultKind.DRIVE_WARNING)
    at = np.zeros(12)
    assert bench.watch.evaluate(told, at, 0.0, moving=False) is None
    found = bench.watch.evaluate(replace(told, t_s=0.01), at, 0.0, moving=False)
    assert found is not None
    assert found.trigger is Trigger.DRIVE_WARNING


def test_a_warning_hides_nothing_worse():
    bench = Bench(limits=replace(WIDE, ball_residual_mm=0.1))
    told = {"fault": ("D.Y", 0x7305, "encoder"), "fault_kind": FaultKind.DRIVE_WARNING}
    squeezed = one(0, 0.5)
    found = bench.cycle(squeezed, np.zeros(12), **told)
    assert found is not None
    assert found.trigger is Trigger.COUPLING


def test_axes_that_ramp_down_by_themselves_are_not_measured_by_a_command_they_ignore():
    bench = Bench()
    at = ramp(bench, 4.0, 8)
    states = (AxisState.STOPPING,) * 12
    for k in range(10):
        assert bench.cycle(at, at + 0.04 * (k + 1), np.full(12, 0.3), states=states) is None
    found = bench.cycle(at + one(0, 0.3), at + 0.44, states=states)
    assert found is not None
    assert found.trigger is Trigger.ENCODER_JUMP


def test_margins_tell_how_near_each_monitor_came():
    bench = Bench(limits=LIMITS)
    at = ramp(bench, 4.0, 3)
    bench.cycle(at + 0.04, at + 0.04, np.full(12, 0.008) + one(3, 0.01))
    margins = bench.watch.margins()
    assert margins["stuck"] == pytest.approx(0.5)
    assert margins["encoder_jump"] == pytest.approx(0.2)
    assert margins["following_error"] == pytest.approx(0.018 / 0.5)
    assert margins["ball_residual"] < 1e-9
    assert all(0.0 <= value <= 1.0 for value in margins.values())
    bench.cycle(at + 0.08, at + 0.08, np.full(12, 0.9))
    assert bench.watch.margins()["following_error"] == pytest.approx(1.8)
    bench.cycle(at + 0.12, at + 0.12, np.full(12, 0.7))
    assert bench.watch.margins()["following_error"] == pytest.approx(1.8)


@pytest.mark.parametrize("speed", [0.05, 0.15, -0.1])
def test_an_axis_that_creeps_in_a_hold_has_drifted_and_is_not_stuck(speed):
    """The move goes on, its commands stand: after 0.02 mm the axis is told to move without a command."""
    bench = Bench()
    at = ramp(bench, 4.0, 5)
    finding, cycle = None, 0
    while finding is None and cycle < 100:
        cycle += 1
        creep = one(7, speed * CYCLE_S * max(0, cycle - 40))
        finding = bench.cycle(at + creep, at, -creep)
    assert finding is not None
    assert finding.trigger is Trigger.DRIFT
    assert isinstance(finding.error, AxisDrift)
    assert (finding.error.where, finding.error.limit) == ("C.Y", 0.02)
    assert 0.02 < abs(finding.error.value) <= 0.02 + 1.5 * abs(speed) * CYCLE_S


def test_a_hold_begins_anew_after_every_command():
    """What an axis gave way before it was told to go on is no drift of the next hold."""
    bench = Bench()
    at = ramp(bench, 4.0, 5)
    off = np.zeros(12)
    for _ in range(3):
        for k in range(50):
            off = one(7, off[7] + (0.0003 if k > 10 else 0.0))
            assert bench.cycle(at + off, at, -off) is None
        at, off = at + 0.04, np.zeros(12)
        assert bench.cycle(at, at, np.full(12, 0.008)) is None


def test_a_hold_of_ten_seconds_of_healthy_axes_is_no_drift():
    bench, rng = Bench(), np.random.default_rng(3)
    at = ramp(bench, 4.0, 5)
    for _ in range(1000):
        assert bench.cycle(at + rng.uniform(-0.001, 0.001, 12), at) is None
