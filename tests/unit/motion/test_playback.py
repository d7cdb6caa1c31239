"""Path time: whatever holds, resumes and stops do to it, the set-points stay on one rigid path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.motion.playback import Playback
from docking.types import Array, Plan
from tests.support.planned_moves import Site, a_plan, lab_site, rc1_site
from tests.support.rigid_figure import distance_gap_mm, path_gap_mm, rigid_gap_mm, sockets_mm

CYCLE_S = 0.01
SITES = {"rc1": rc1_site, "lab": lab_site}
SEEDS = range(8)


@pytest.fixture(params=SITES, ids=str)
def site(request) -> Site:
    return SITES[request.param]()


def played(plan: Plan, verbs: dict[int, float], limit: int = 100_000) -> tuple[Array, Array]:
    """Set-points (n, m) and rates (n,) of a run in which `verbs` turns the rate at the cycles it names."""
    playback = Playback(plan)
    setpoints, rates = [], []
    for cycle in range(limit):
        if cycle in verbs:
            playback.turn_to(verbs[cycle])
        setpoints.append(playback.advance(CYCLE_S))
        rates.append(playback.rate)
        if playback.at_end or (playback.standing and cycle >= max(verbs, default=0)):
            return np.array(setpoints), np.array(rates)
    raise AssertionError("the run does not end")


def random_verbs(plan: Plan, seed: int, *, stop: bool) -> dict[int, float]:
    """Some holds and resumes at random cycles, some of them inside the ramps of others; the last is a stop or a go."""
    rng = np.random.default_rng(seed)
    cycles = sorted(rng.choice(len(plan.t_s) - 2, size=8, replace=False).tolist())
    cycles[3] = cycles[2] + 1 + int(rng.integers(0, 4))
    verbs = {int(cycle): float(i % 2) for i, cycle in enumerate(cycles)}
    verbs[max(verbs) + 3] = 0.0 if stop else 1.0
    return verbs


@pytest.mark.parametrize("stop", [False, True], ids=["to the end", "stopped"])
@pytest.mark.parametrize("seed", SEEDS)
def test_every_set_point_is_on_the_rigid_path(site, seed, stop):
    plan = a_plan(site, seed)
    setpoints, _ = played(plan, random_verbs(plan, seed, stop=stop))
    where = site.positioners.origins_W_mm, site.positioners.axes_W
    start, figures = sockets_mm(*where, plan.q_mm[0])[0], sockets_mm(*where, setpoints)
    assert distance_gap_mm(start, figures).max() <= 1e-6
    assert rigid_gap_mm(start, figures).max() <= 1e-6
    # A rigid figure could still be somewhere else: it is on the way that was planned. Chord heights of a table with
    # 100 rows a second are far below a micrometre.
    assert path_gap_mm(plan.q_mm, setpoints[:: max(1, len(setpoints) // 200)]).max() <= 1e-4


@pytest.mark.parametrize("seed", SEEDS)
def test_the_rate_changes_no_faster_than_the_plan_allows(site, seed):
    plan = a_plan(site, seed)
    _, rates = played(plan, random_verbs(plan, seed, stop=False))
    slope = np.diff(np.concatenate([[1.0], rates])) / CYCLE_S
    assert np.abs(slope).max() <= plan.rate_slew_per_s * (1.0 + 1e-9)
    assert rates.min() >= 0.0
    assert rates.max() <= 1.0
    hold = played(plan, {len(plan.t_s) // 2: 0.0})[1]
    steepest = np.abs(np.diff(hold)).max() / CYCLE_S
    # The cubic is used, not dawdled along: its steepest slope comes near the limit.
    assert steepest >= 0.8 * min(plan.rate_slew_per_s, 1.0 / CYCLE_S / 4.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_axes_stay_inside_speed_and_acceleration(site, seed):
    plan = a_plan(site, seed)
    setpoints, _ = played(plan, random_verbs(plan, seed, stop=True))
    at_rest = np.concatenate([[plan.q_mm[0]] * 2, setpoints, [setpoints[-1]] * 2])
    speed = np.abs(np.diff(at_rest, axis=0)) / CYCLE_S
    bend = np.abs(np.diff(at_rest, 2, axis=0)) / CYCLE_S**2
    assert (speed.max(axis=0) <= site.positioners.v_mm_s * (1.0 + 1e-6)).all()
    assert (bend.max(axis=0) <= site.positioners.a_mm_s2 * (1.0 + 1e-3)).all()


def test_an_undisturbed_run_plays_the_rows_themselves(site):
    plan = a_plan(site, 3)
    setpoints, _ = played(plan, {})
    np.testing.assert_array_equal(setpoints, plan.q_mm[1 : len(setpoints) + 1])
    np.testing.assert_array_equal(setpoints[-1], plan.q_mm[-1])


def test_a_held_run_ends_exactly_at_the_goal(site):
    plan = a_plan(site, 4)
    middle = len(plan.t_s) // 2
    setpoints, _ = played(plan, {middle: 0.0, middle + 300: 1.0})
    assert len(setpoints) == pytest.approx(len(plan.q_mm) + 300, abs=2)
    np.testing.assert_array_equal(setpoints[-1], plan.q_mm[-1])


def test_a_hold_stands_still_until_it_is_resumed(site):
    plan = a_plan(site, 5)
    playback = Playback(plan)
    for _ in range(len(plan.t_s) // 3):
        playback.advance(CYCLE_S)
    playback.turn_to(0.0)
    ramp_s = 1.5 / plan.rate_slew_per_s
    for _ in range(int(ramp_s / CYCLE_S) + 2):
        playback.advance(CYCLE_S)
    assert playback.standing
    stood = playback.path_time_s
    for _ in range(50):
        np.testing.assert_array_equal(playback.advance(CYCLE_S), playback.setpoint_at(stood))
    playback.turn_to(1.0)
    assert not playback.standing
    playback.advance(CYCLE_S)
    assert playback.path_time_s > stood


def test_the_way_of_a_stop_is_half_its_ramp(site):
    plan = a_plan(site, 6)
    playback = Playback(plan)
    while playback.path_time_s < 0.4 * plan.duration_s:
        playback.advance(CYCLE_S)
    begun = playback.path_time_s
    playback.turn_to(0.0)
    while not playback.standing:
        playback.advance(CYCLE_S)
    ramp_s = 1.5 / plan.rate_slew_per_s
    assert playback.path_time_s - begun == pytest.approx(0.5 * ramp_s, abs=CYCLE_S)


def test_between_rows_the_part_is_as_rigid_as_on_them():
    """Every twentieth row of a turning table: half way between two of them straight axes squeeze the figure, the
    set-points hardly do."""
    site = rc1_site()
    plan, step = a_plan(site, 5), 20
    q_mm = plan.q_mm[::step]
    period_s = step * plan.period_s
    playback = Playback(
        replace(plan, t_s=period_s * np.arange(len(q_mm)), s=plan.s[::step], q_mm=q_mm, period_s=period_s)
    )
    where = site.positioners.origins_W_mm, site.positioners.axes_W
    start = sockets_mm(*where, plan.q_mm[0])[0]
    at_s = period_s * (np.arange(1, len(q_mm) - 2) + 0.5)
    chords, points = (
        rigid_gap_mm(start, sockets_mm(*where, np.array([place(t) for t in at_s]))).max()
        for place in (playback.chord_at, playback.setpoint_at)
    )
    print(f"{chords:.1e} mm on chords, {points:.1e} mm between rows")
    assert chords > 5e-6
    assert points < 0.2 * chords


def test_a_hold_does_not_soften_a_harder_stop():
    plan = a_plan(lab_site(), 3)
    runs = []
    for held in (False, True):
        playback = Playback(plan)
        for _ in range(len(plan.t_s) // 2):
            playback.advance(CYCLE_S)
        playback.stop_straight(20.0)
        playback.advance(CYCLE_S)
        if held:
            playback.hold()
        rates = [playback.rate]
        while not playback.standing:
            playback.advance(CYCLE_S)
            rates.append(playback.rate)
        runs.append(rates)
    assert runs[0] == runs[1] == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.0], abs=1e-9)


def test_waiting_begins_at_rest():
    plan = a_plan(lab_site(), 1)
    playback = Playback(plan)
    playback.wait()
    assert playback.standing
    np.testing.assert_array_equal(playback.advance(CYCLE_S), plan.q_mm[0])
    playback.turn_to(1.0)
    playback.advance(CYCLE_S)
    assert 0.0 < playback.path_time_s < CYCLE_S


def test_nothing_lies_beyond_the_ends_of_the_table():
    plan = a_plan(lab_site(), 2)
    playback = Playback(plan)
    np.testing.assert_array_equal(playback.setpoint_at(-1.0), plan.q_mm[0])
    np.testing.assert_array_equal(playback.setpoint_at(plan.duration_s + 1.0), plan.q_mm[-1])
    np.testing.assert_array_equal(playback.chord_at(-1.0), plan.q_mm[0])
    np.testing.assert_array_equal(playback.chord_at(plan.duration_s + 1.0), plan.q_mm[-1])


def test_chords_join_the_rows_straight_and_leave_the_figure_by_the_stated_bound():
    site = lab_site("lab-modbus")
    plan = a_plan(site, 5, period_s=0.1, queued=True)
    playback = Playback(plan)
    half = playback.chord_at(10.5 * plan.period_s)
    np.testing.assert_allclose(half, 0.5 * (plan.q_mm[10] + plan.q_mm[11]), atol=1e-12)
    where = site.positioners.origins_W_mm, site.positioners.axes_W
    times = np.linspace(0.0, plan.duration_s, 997)
    figures = sockets_mm(*where, np.array([playback.chord_at(t) for t in times]))
    start = sockets_mm(*where, plan.q_mm[0])[0]
    assert 0.0 < plan.chord_error_mm <= site.settings.chord_error_mm
    assert distance_gap_mm(start, figures).max() <= plan.chord_error_mm + 1e-9


def test_the_speed_of_the_table_scales_with_the_rate():
    plan = a_plan(lab_site(), 9)
    playback = Playback(plan)
    middle = 0.5 * plan.duration_s
    row = int(middle / plan.period_s)
    full = np.abs(plan.q_mm[row + 1] - plan.q_mm[row]) / plan.period_s
    np.testing.assert_allclose(playback.speed_at(middle), full, rtol=1e-12)
    playback.rate = 0.25
    np.testing.assert_allclose(playback.speed_at(middle), 0.25 * full, rtol=1e-12)
