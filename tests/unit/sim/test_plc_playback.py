"""Playback of the segment queue: along the chords, whatever the rate does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.plc.playback import Playback

KNOTS = [(0.0, 10.0, -1.0), (1.0, 10.5, -1.0), (3.0, 9.5, -2.0), (3.5, 9.0, -4.0)]


def queue(ramp_s: float = 0.2) -> Playback:
    playback = Playback(16)
    playback.ramp_s = ramp_s
    playback.period_s = 0.1
    for i, knot in enumerate(KNOTS):
        playback.push(knot, i == len(KNOTS) - 1)
    return playback


def test_full_rate_follows_the_table_and_ends_on_its_last_knot() -> None:
    playback = queue()
    playback.start(1.0, 1.0, 0.0)
    playback.advance(0.05)
    assert playback.point() == pytest.approx((0.5, 10.25, -1.0))
    playback.advance(0.10)
    assert playback.point() == pytest.approx((2.0, 10.0, -1.5))
    assert (playback.play_seq, playback.fraction) == (2, pytest.approx(0.5))
    for _ in range(20):
        playback.advance(0.01)
    assert playback.at_end
    assert playback.point() == KNOTS[-1]


def test_stop_ramp_takes_half_the_ramp_of_path_time() -> None:
    playback = queue(ramp_s=0.2)
    playback.start(1.0, 1.0, 0.0)
    playback.advance(0.05)
    playback.stop()
    for _ in range(30):
        playback.advance(0.01)
    assert playback.rate == 0.0
    path_s = (playback.play_seq - 1 + playback.fraction) * 0.1
    assert path_s == pytest.approx(0.05 + 0.2 / 2.0, abs=1e-12)


@pytest.mark.parametrize("rate", [1.0, 0.35])
def test_a_quick_stop_takes_its_own_ramp_at_any_rate_and_makes_a_begun_one_steeper(rate: float) -> None:
    for begun in (False, True):
        playback = queue(ramp_s=0.2)
        playback.quick_ramp_s = 0.04
        playback.start(rate, rate, 0.0)
        playback.advance(0.02)
        before_s = path_s = 0.02 * rate
        if begun:
            playback.stop()
            playback.advance(0.01)
            path_s = before_s + 0.01 * (rate - 0.025)
        now = playback.rate
        assert now == pytest.approx(rate - 0.05 * begun)
        playback.stop(quick=True)
        playback.stop()
        scans = 0
        while playback.rate > 0.0:
            playback.advance(0.01)
            scans += 1
        assert scans == int(np.ceil(now * 4.0 - 1e-9)), "an ordinary stop makes a quick one no flatter"
        at_s = (playback.play_seq - 1 + playback.fraction) * 0.1
        assert at_s == pytest.approx(path_s + 0.5 * now * now * 0.04, abs=1e-12)


def test_late_start_edge_costs_exactly_its_skew() -> None:
    early, late = queue(), queue()
    early.start(1.0, 1.0, 0.0)
    late.start(1.0, 1.0, 0.0007)
    for playback in (early, late):
        for _ in range(7):
            playback.advance(0.01)
    assert early.fraction - late.fraction == pytest.approx(0.007, abs=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["stop", "go", "wait"]), st.integers(1, 12)), min_size=1, max_size=8),
    st.floats(0.05, 1.0),
)
def test_any_mix_of_stops_and_restarts_stays_on_the_chords(acts: list[tuple[str, int]], ramp_s: float) -> None:
    playback = queue(ramp_s)
    playback.start(1.0, 1.0, 0.0)
    times = np.arange(4) * 0.1
    before_s = 0.0
    for act, scans in acts:
        if act == "stop":
            playback.stop()
        elif act == "go" and playback.rate == 0.0:
            playback.start(0.0, 1.0, 0.0)
        for _ in range(scans):
            playback.advance(0.01)
            path_s = (playback.play_seq - 1 + playback.fraction) * 0.1
            wanted = [np.interp(path_s, times, column) for column in np.array(KNOTS).T]
            assert playback.point() == pytest.approx(wanted, abs=1e-9)
            assert before_s - 1e-12 <= path_s <= before_s + 0.01 + 1e-12
            before_s = path_s
