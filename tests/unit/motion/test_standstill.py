"""When axes that ramp down by themselves count as at rest."""

from __future__ import annotations

import numpy as np

from docking.motion.standstill import REST_CYCLES, Standstill
from tests.support.motion_fakes import read_back

Q = np.zeros(12)


def ages(row, value):
    return np.where(np.arange(12) == row, float(value), 0.0)


def cycles_until_rest(changes, gone=(), step_mm=0.0):
    """In how many cycles of read-backs alike the axes are seen at rest; None after ten."""
    stand = Standstill()
    stand.begin()
    for cycle in range(10):
        before, now = (read_back(Q + step_mm * k, **changes) for k in (cycle, cycle + 1))
        if stand.seen(before, now, gone):
            return cycle + 1
    return None


def test_axes_stand_after_some_cycles_without_motion():
    assert cycles_until_rest({}) == REST_CYCLES
    assert cycles_until_rest({}, step_mm=0.0019) == REST_CYCLES
    assert cycles_until_rest({}, step_mm=0.0021) is None
    assert cycles_until_rest({}, step_mm=np.nan) is None
    assert not Standstill().seen(None, read_back(Q))


def test_an_axis_that_is_not_heard_is_not_known_to_stand_unless_it_has_no_torque():
    assert cycles_until_rest({"age_cycles": ages(4, 2)}) == REST_CYCLES
    silent = {"age_cycles": ages(4, 3)}
    assert cycles_until_rest(silent) is None
    assert cycles_until_rest(silent, gone=(5,)) is None
    assert cycles_until_rest(silent, gone=(4,)) == REST_CYCLES
    assert cycles_until_rest(silent, gone=(4,), step_mm=0.01) is None, "the others count as ever"


def test_motion_in_between_begins_the_count_anew():
    stand, still, moved = Standstill(), read_back(Q), read_back(Q + 0.1)
    assert [stand.seen(still, still) for _ in range(REST_CYCLES - 1)] == [False] * (REST_CYCLES - 1)
    assert not stand.seen(still, moved)
    assert [stand.seen(moved, moved) for _ in range(REST_CYCLES)][-1]
