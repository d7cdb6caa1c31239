"""Several moves back to the stand-off: the chain of the way, and the mate that may stand in it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from docking.errors import ApproachRefused, MateTooNear, PlanStale
from docking.planning import Gone, MateSettings, PlanRequest, Scene, WayBack, correction_to, make_plan, retreat_plans
from docking.planning.mate import gap_mm, off_straight_mm
from docking.types import Array, Plan, Pose
from tests.reference_geometry import FACE, GUARDED, rc1
from tests.unit.planning.test_mate import BOX, DOCKED, MATE, SETTINGS, standing

WIDE = replace(rc1(), stroke_mm=np.tile([-800.0, 800.0], (12, 1)))
SPEEDS = ((300.0, 5.0), (100.0, 5.0), (30.0, 2.0), (10.0, 1.0))
START = standing(312.0, (6.0, -4.0), 0.3)
HOOK = np.array([[-650.0, 2100.0, -200.0], [-610.0, 2300.0, 200.0]])
"""A box of the mate beside the way of the section's front edge, 100 mm clear of it."""


@cache
def gone(
    settings: MateSettings = SETTINGS, start: Pose = START, speeds: tuple = SPEEDS
) -> tuple[tuple[Gone, ...], Array]:
    """Every move of an approach to 10 mm, and where the axes stand after it."""
    here, q, before = start, (start.apply(WIDE.balls_C_mm) - WIDE.origins_W_mm).reshape(-1), float("inf")
    way = []
    for number, (standoff, speed) in enumerate(speeds, 1):
        goal = standing(standoff)
        scene = Scene(here, MATE, DOCKED, standoff, before)
        asked = PlanRequest(
            number, f"{standoff:g}", "approach", q, correction_to(here, goal, FACE), speed, 0.01, False, scene
        )
        plan = make_plan(asked, WIDE, replace(GUARDED, mate=settings))
        way.append(Gone(plan, plan.duration_s, scene, scene))
        here, q, before = goal, plan.q_mm[-1], standoff
    return tuple(way), q


def back(
    moves: int, way: tuple[Gone, ...], q: Array, settings: MateSettings = SETTINGS, **more: float
) -> tuple[Plan, ...]:
    return retreat_plans(way, WayBack(moves, q, 5, **more), WIDE, replace(GUARDED, mate=settings))


def moved(way: tuple[Gone, ...], X_WM: Pose) -> tuple[Gone, ...]:
    """The same way, with the mate, and the place to dock at, moved by `X_WM` of its old place."""
    by = X_WM @ MATE.inverse()
    return tuple(replace(g, now=replace(g.then, X_WM=X_WM, X_WG=by @ g.then.X_WG)) for g in way if g.then is not None)


@pytest.mark.parametrize("moves", [1, 3, 4])
def test_the_moves_are_undone_newest_first_and_end_where_the_first_of_them_began(moves: int) -> None:
    way, q = gone()
    plans = back(moves, way, q)
    assert [p.stage for p in plans] == ["10", "30", "100", "300"][:moves]
    assert [p.plan_id for p in plans] == list(range(5, 5 + moves))
    for plan, step in zip(plans, reversed(way), strict=False):
        np.testing.assert_allclose(plan.q_mm[0], step.plan.q_mm[-1], atol=1e-6)
        np.testing.assert_allclose(plan.q_mm[-1], step.plan.q_mm[0], atol=1e-9)
        assert plan.bounds is not None
        assert plan.bounds.clearance_mm >= plan.bounds.clearance_asked_mm > 0.0


def test_a_move_that_ended_on_its_way_is_gone_back_from_there() -> None:
    way, _ = gone()
    half = replace(way[-1], path_time_s=0.5 * way[-1].plan.duration_s)
    last, before = back(2, (*way[:-1], half), way[-1].plan.q_mm[len(way[-1].plan.q_mm) // 2])
    assert last.displacement_mm[0] == pytest.approx(-10.0, abs=0.1)
    assert before.displacement_mm[0] == pytest.approx(-70.0, abs=0.1)


def test_the_speed_limit_of_the_day_holds_for_the_way_back() -> None:
    way, q = gone()
    slow = back(2, way, q, speed_mm_s=0.5)
    assert all(np.abs(np.diff(p.q_mm, axis=0)).max() / 0.01 <= 0.5 * (1 + 1e-6) for p in slow)


def test_a_part_of_the_mate_in_the_way_is_refused_by_name() -> None:
    """The mate has come 120 mm sideways with a hook beside the way: straight back would end in the hook."""
    settings = replace(SETTINGS, boxes_M_mm=np.concatenate([BOX, (HOOK + np.array([0, -120.0, 0]))[None]]))
    clear = replace(SETTINGS, boxes_M_mm=np.concatenate([BOX, HOOK[None]]))
    short = ((300.0, 5.0), (100.0, 5.0))
    way, q = gone(SETTINGS, standing(620.0), short)
    assert back(2, way, q, clear)[-1].bounds is not None
    with pytest.raises(MateTooNear) as refused:
        back(2, way, q, settings)
    assert refused.value.where == "box 1 of the mate"
    assert len(back(1, way, q, settings)) == 1, "the first of the two is free"


def test_a_mate_that_moved_aside_takes_the_corridor_along() -> None:
    way, q = gone()
    aside = moved(way, Pose(np.eye(3), FACE + np.array([0.0, 6.0, 0.0])))
    with pytest.raises(ApproachRefused) as refused:
        back(1, aside, q)
    assert refused.value.where == "corridor"
    near = moved(way, Pose(np.eye(3), FACE + np.array([0.0, 1.0, 0.0])))
    assert len(back(3, near, q)) == 3


def test_a_mate_that_came_nearer_lets_the_part_go_away_from_it() -> None:
    way, q = gone()
    pressed = moved(way, Pose(np.eye(3), FACE - np.array([9.5, 0.0, 0.0])))
    assert len(back(4, pressed, q)) == 4


def test_what_began_beside_the_corridor_may_end_there_again_and_no_farther() -> None:
    """A first station inside the corridor is left sideways: so it may be reached again, while the mate stands."""
    way, q = gone(SETTINGS, standing(30.0, (5.0, 0.0)), ((30.0, 2.0), (10.0, 1.0)))
    assert off_straight_mm(way[0].then, way[0].plan.correction, SETTINGS) == pytest.approx(5.0, abs=1e-6)
    assert len(back(2, way, q)) == 2
    with pytest.raises(ApproachRefused):
        back(2, moved(way, Pose(np.eye(3), FACE + np.array([0.0, -1.0, 0.0]))), q)


def test_the_gap_is_told_along_the_insertion() -> None:
    scene = Scene(standing(42.0, (3.0, 1.0)), MATE, DOCKED, 0.0)
    assert gap_mm(scene, SETTINGS) == pytest.approx(42.0)


@pytest.mark.parametrize("moves", [0, -1, 5])
def test_no_more_moves_are_undone_than_were_made(moves: int) -> None:
    way, q = gone()
    with pytest.raises(PlanStale, match="4 were made"):
        back(moves, way, q)


def test_a_break_in_the_way_is_refused() -> None:
    way, q = gone()
    with pytest.raises(PlanStale, match="stands"):
        back(2, (*way[:2], way[3]), q)
