"""The way back: on the executed path, to its start, through the same limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.errors import PlanStale, StrokeExceeded
from docking.kinematics import Positioners
from docking.planning import Gone, PlanRequest, WayBack, make_plan, position_at, retreat_plans
from docking.planning.path import rigid_path
from docking.types import Array, Correction, Plan
from tests.reference_geometry import GUARDED, crooked_axes, rc1, rc3
from tests.support.rigid_figure import rigid_gap_mm, sockets_mm


def wide(seed: int) -> Positioners:
    """RC-1 with crooked axes and strokes that never bind."""
    return replace(rc1(crooked_axes(seed)), stroke_mm=np.tile([-500.0, 500.0], (12, 1)))


def executed(seed: int, queued: bool = False) -> Plan:
    rng = np.random.default_rng(seed)
    correction = Correction(rng.uniform(-4000, 4000, 3), np.radians(rng.uniform(-0.6, 0.6, 3)), rng.uniform(-15, 15, 3))
    asked = PlanRequest(
        seed, "align", "align", rng.uniform(-5, 5, 12), correction, 3.0, 0.1 if queued else 0.01, queued
    )
    return make_plan(asked, wide(seed), GUARDED)


def back_along(way: list[tuple[Plan, float]], stood: Array, positioners: Positioners, plan_id: int) -> Plan:
    """The last move of `way` gone back."""
    (back,) = retreat_plans([Gone(*step) for step in way], WayBack(1, stood, plan_id), positioners, GUARDED)
    return back


def off_the_path(plan: Plan, seed: int, rows: Array) -> float:
    """Largest distance of any row from the executed path, each at its nearest place on it."""
    path = rigid_path(wide(seed), plan.q_mm[0], plan.correction)
    k = int(np.argmax(np.abs(plan.displacement_mm)))
    worst = 0.0
    for row in rows:
        s = 0.5
        for _ in range(30):  # Newton on the axis that moves most
            at, slope = path.axes_mm(np.array([s]))[0, k], path.axis_derivative(np.array([s]), 1)[0, k]
            s -= (at - row[k]) / slope
        worst = max(worst, float(np.abs(path.axes_mm(np.array([s]))[0] - row).max()))
    return worst


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.floats(0.02, 1.0), st.booleans())
def test_it_ends_where_the_move_began_and_never_leaves_its_path(seed: int, share: float, queued: bool) -> None:
    plan, positioners = executed(seed, queued), wide(seed)
    reached_s = share * plan.duration_s
    stood = position_at(plan, reached_s)
    back = back_along([(plan, reached_s)], stood, positioners, 7)
    np.testing.assert_allclose(back.q_mm[-1], plan.q_mm[0], atol=1e-9, rtol=0.0)
    np.testing.assert_allclose(back.q_mm[0], stood, atol=2e-3 if queued else 1e-5, rtol=0.0)
    assert off_the_path(plan, seed, back.q_mm[:: max(1, len(back.q_mm) // 40)]) <= 1e-9
    figure = sockets_mm(positioners.origins_W_mm, positioners.axes_W, back.q_mm)
    assert rigid_gap_mm(figure[0], figure).max() <= 1e-7
    assert (back.kind, back.stage, back.plan_id, back.s[0], back.s[-1]) == ("retreat", plan.stage, 7, 0.0, 1.0)
    speed = np.abs(np.diff(back.q_mm, axis=0)).max(axis=0) / back.period_s
    assert np.all(speed <= positioners.v_mm_s)
    assert back.bounds is not None
    assert back.bounds.jam_n.max() <= GUARDED.jam.force_n


def test_it_is_not_faster_than_it_came() -> None:
    asked = PlanRequest(
        1,
        "dock",
        "approach",
        np.zeros(12),
        Correction(np.zeros(3), np.zeros(3), np.array([3.0, 0, 0])),
        0.2,
        0.01,
        False,
    )
    plan = make_plan(asked, rc1(), GUARDED)
    back = back_along([(plan, plan.duration_s)], plan.q_mm[-1], rc1(), 2)
    assert np.abs(np.diff(back.q_mm, axis=0)).max() / 0.01 <= 0.2 * (1 + 1e-6)
    assert back.duration_s == pytest.approx(plan.duration_s, rel=0.01)
    np.testing.assert_allclose(back.displacement_mm, -plan.displacement_mm, atol=1e-9)


def test_passive_axes_begin_where_they_are() -> None:
    asked = PlanRequest(
        1, "s", "align", np.zeros(12), Correction(np.zeros(3), np.radians([0, 0, 0.3]), np.array([5.0, 2, 1])), 2.0,
        0.01, False,
    )  # fmt: skip
    plan = make_plan(asked, rc3(), GUARDED)
    slipped = np.where(rc3().driven, 0.0, 0.01)
    back = back_along([(plan, plan.duration_s)], plan.q_mm[-1] + slipped, rc3(), 2)
    np.testing.assert_allclose(back.q_mm[0], plan.q_mm[-1] + slipped, atol=1e-9)
    np.testing.assert_allclose(back.q_mm[-1], plan.q_mm[0] + slipped, atol=1e-9)


def test_what_cannot_be_gone_back_is_refused() -> None:
    plan = executed(5)
    positioners = wide(5)
    end = plan.q_mm[-1]
    moved = end + 0.03 * np.eye(12)[4]
    for way, stood in (
        ([], end),
        ([(plan, 0.0)], plan.q_mm[0]),
        ([(plan, plan.duration_s)], moved),
        ([(plan, plan.duration_s)], np.full(12, np.nan)),
        ([(replace(plan, kind="relief"), plan.duration_s)], end),
    ):
        with pytest.raises(PlanStale):
            back_along(way, stood, positioners, 2)
    short = replace(positioners, stroke_mm=np.tile([-3.0, 3.0], (12, 1)))
    with pytest.raises(StrokeExceeded):
        back_along([(plan, plan.duration_s)], end, short, 2)
