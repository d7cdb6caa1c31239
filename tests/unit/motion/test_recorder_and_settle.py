"""The trace of a move, and the wait for standstill after it."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import numpy as np
import pytest

from docking.errors import NotSettled
from docking.motion.recorder import Recorder
from docking.motion.settle import SettleSettings, settle
from sim.virtual_time import run_virtual
from tests.reference_geometry import AXES, rc1
from tests.support.motion_fakes import read_back, watch_of

SETTINGS = SettleSettings(window_s=1.0, readings=4, tolerance_mm=0.005, timeout_s=20.0)


def recorded(every: int, count: int):
    watch = watch_of(rc1())
    watch.watch_about(np.zeros(12))
    recorder = Recorder(watch, every)
    for i in range(count):
        q = np.arange(12.0) + i
        told = read_back(q, t_s=0.01 * i, following_error_mm=np.full(12, 0.001 * i), force_n=np.full(12, 10.0 * i))
        watch.evaluate(told, q, 0.0, moving=True)
        recorder.add(told, 0.02 * i)
    return recorder.result("done", 0.02 * count, np.arange(12.0), None)


def test_one_row_every_few_cycles_the_first_and_the_last_included():
    result = recorded(every=10, count=95)
    trace = result.trace
    np.testing.assert_allclose(trace.t_s, [*(0.1 * np.arange(10)), 0.94])
    np.testing.assert_allclose(trace.path_time_s, [*(0.2 * np.arange(10)), 1.88])
    assert trace.position_mm.shape == trace.following_error_mm.shape == trace.force_n.shape == (11, 12)
    np.testing.assert_allclose(trace.position_mm[3], np.arange(12.0) + 30)
    np.testing.assert_allclose(trace.force_n[4], 400.0)
    assert trace.residual_mm.shape == trace.internal_force_n.shape == trace.measured_force_n.shape == (11,)
    # The maximum is over all cycles, also those without a row.
    np.testing.assert_allclose(result.max_following_error_mm, 0.094)


def test_a_move_without_a_single_row_still_has_a_trace():
    result = recorded(every=10, count=0)
    assert result.trace.t_s.shape == (0,)
    assert result.trace.position_mm.shape == (0, 12)
    assert (result.result, result.max_residual_mm, result.max_internal_force_n) == ("done", 0.0, 0.0)


def test_a_new_recorder_forgets_the_maxima_of_the_last_move():
    watch = watch_of(rc1())
    watch.max_residual_mm = 3.0
    assert Recorder(watch, 1).result("done", 0.0, np.zeros(12), None).max_residual_mm == 0.0


class Drifting:
    """A motion side whose axes read what `position` says at each time."""

    axes = AXES

    def __init__(self, position) -> None:
        self._position = position

    def feedback(self):
        now_s = asyncio.get_running_loop().time()
        return read_back(self._position(now_s), t_s=now_s)


def settled_at(position, settings=SETTINGS) -> float:
    async def main() -> float:
        return await settle(Drifting(position), settings)

    return run_virtual(main)


def swinging(amplitude_mm: float, until_s: float):
    """C.X swings until a time; everything else stands."""

    def at(t_s: float):
        q = np.zeros(12)
        q[6] = amplitude_mm * np.sin(2.0 * np.pi * 1.3 * t_s) if t_s < until_s else 0.0
        return q

    return at


def test_axes_at_rest_take_the_window_and_one_more_second():
    assert settled_at(lambda t: np.zeros(12)) == pytest.approx(2.0)


def test_rest_counts_only_from_the_last_movement_on():
    assert settled_at(swinging(0.5, 5.0)) >= 5.0 + 1.0
    assert settled_at(swinging(0.5, 5.0)) <= 5.0 + 2.3


def test_movement_inside_the_tolerance_is_rest():
    assert settled_at(swinging(0.002, 100.0)) == pytest.approx(2.0)


def test_an_axis_that_never_rests_is_named():
    with pytest.raises(NotSettled) as refused:
        settled_at(swinging(0.5, 100.0))
    assert refused.value.where == "C.X"
    assert refused.value.value > 0.005
    assert refused.value.limit == 0.005


def test_slow_creep_is_no_rest():
    with pytest.raises(NotSettled) as refused:
        settled_at(lambda t: np.array([0.0] * 11 + [0.03 * t]))
    assert refused.value.where == "D.Z"


def test_a_read_back_that_is_no_number_is_no_rest():
    with pytest.raises(NotSettled) as refused:
        settled_at(lambda t: np.array([0.0, np.nan] + [0.0] * 10))
    assert refused.value.where == "A.Y"


def test_a_read_back_that_is_shown_again_says_nothing():
    """The axes creep, and every read-back is shown for eight looks: seven of them look like rest."""

    class Slow(Drifting):
        def feedback(self):
            now_s = 2.0 * int(asyncio.get_running_loop().time() / 2.0)
            return read_back(self._position(now_s), t_s=now_s)

    async def main() -> None:
        await settle(Slow(lambda t: np.array([0.0] * 11 + [0.03 * t])), SettleSettings(1.0, 4, 0.005, 20.0))

    with pytest.raises(NotSettled):
        run_virtual(main)


def test_the_wait_is_spread_over_the_window():
    times: list[float] = []

    def at(t_s: float):
        times.append(t_s)
        return np.zeros(12)

    settled_at(at, SettleSettings(window_s=0.4, readings=4, tolerance_mm=0.005, timeout_s=5.0))
    assert [b - a for a, b in pairwise(times)] == pytest.approx([0.1] * 4)
