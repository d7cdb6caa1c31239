"""The way to the mate: distances to boxes, near misses, the corridor, the order of the stations, coasting drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from docking.errors import ApproachRefused, MateTooNear
from docking.planning import MateSettings, PlanRequest, Scene, correction_to, make_plan, outline_edges
from docking.planning.clearance import nearest
from docking.planning.mate import check_mate
from docking.planning.time_law import quintic
from docking.types import Array, Plan, Pose
from tests.reference_geometry import FACE, GUARDED, rc1

DOCKED = Pose(np.eye(3), np.zeros(3))
MATE = Pose(np.eye(3), FACE)
RING = np.array([[4000.0, 2000 * np.cos(a), 2000 * np.sin(a)] for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)])
BOX = np.array([[[0.0, -2050.0, -2050.0], [3000.0, 2050.0, 2050.0]]])
SETTINGS = MateSettings(
    outline_edges((RING,)), BOX, FACE, np.array([1.0, 0.0, 0.0]), clearance_mm=2.0, contact_mm=0.3, corridor_mm=4.0,
    corridor_length_mm=100.0, coast_s=0.28,
)  # fmt: skip


def standing(gap: float, aside: tuple[float, float] = (0.0, 0.0), turn_z_deg: float = 0.0) -> Pose:
    """The component `gap` before its docked place, shifted sideways and turned about its face."""
    c, s = np.cos(np.radians(turn_z_deg)), np.sin(np.radians(turn_z_deg))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Pose(R, FACE - R @ FACE + np.array([-gap, *aside]))


def plan(start: Pose, goal: Pose, mate: MateSettings = SETTINGS, speed: float = 1.0, **scene: float) -> Plan:
    order = {"standoff_mm": 0.0, "from_standoff_mm": float("inf"), **scene}
    positioners = replace(rc1(), stroke_mm=np.tile([-500.0, 500.0], (12, 1)))
    q = (start.apply(positioners.balls_C_mm) - positioners.origins_W_mm).reshape(-1)
    asked = PlanRequest(
        1, "s", "approach", q, correction_to(start, goal, FACE), speed, 0.01, False,
        Scene(start, MATE, DOCKED, order["standoff_mm"], order["from_standoff_mm"]),
    )  # fmt: skip
    return make_plan(asked, positioners, replace(GUARDED, mate=mate))


def signed_distance_mm(points: Array, box: Array) -> Array:
    """Outside the length to the nearest point of the box, inside minus the depth under the nearest face."""
    inside = np.minimum(points - box[0], box[1] - points).min(axis=1)
    outside = np.linalg.norm(points - np.clip(points, box[0], box[1]), axis=1)
    return np.where(outside > 0.0, outside, -inside)


def brute(edge: Array, boxes: Array, count: int = 20001) -> float:
    points = edge[0] + np.linspace(0, 1, count)[:, None] * (edge[1] - edge[0])
    return float(min(signed_distance_mm(points, box).min() for box in boxes))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 100_000))
def test_the_search_finds_the_least_distance(seed: int) -> None:
    """Edges that pass a corner between their ends, go through, or run along a face."""
    rng = np.random.default_rng(seed)
    edges = rng.uniform(-300, 300, (5, 2, 3))
    low = rng.uniform(-100, 50, (2, 3))
    boxes = np.stack([low, low + rng.uniform(1, 150, (2, 3))], axis=1)
    found = nearest(edges[None], boxes, np.zeros(1))
    true = min(brute(edge, boxes) for edge in edges)
    assert found.excess_mm == pytest.approx(true, abs=0.02)
    assert brute(edges[found.edge], boxes[found.box : found.box + 1]) == pytest.approx(true, abs=0.02)


def test_the_clearance_of_an_approach_is_stated() -> None:
    bounds = plan(standing(100.0), standing(30.0), standoff_mm=30.0, from_standoff_mm=100.0).bounds
    assert bounds is not None
    assert bounds.clearance_asked_mm == pytest.approx(1.7)
    assert 29.0 < bounds.clearance_mm <= 30.0
    assert bounds.clearance_s == pytest.approx(1.0, abs=0.05)
    assert np.isnan(plan(standing(300.0), standing(200.0), replace(SETTINGS, boxes_M_mm=np.zeros((0, 2, 3))),
                         standoff_mm=200.0).bounds.clearance_mm)  # type: ignore[union-attr]  # fmt: skip


@pytest.mark.parametrize(("off", "clear"), [(0.1, True), (-0.1, False)])
def test_a_near_miss_beside_the_way(off: float, clear: bool) -> None:
    """A pillar beside the path, 2 - 0.3 mm +- 0.1 mm from the ring as it passes."""
    edge = float(RING[:, 1].max()) + 1.7 + off
    pillar = np.array([[-200.0, edge, -50.0], [-150.0, edge + 100.0, 50.0]])
    mate = replace(SETTINGS, boxes_M_mm=np.concatenate([BOX, pillar[None]]), corridor_length_mm=10.0)
    if clear:
        bounds = plan(standing(300.0), standing(100.0), mate, 5.0, standoff_mm=100.0).bounds
        assert bounds is not None
        assert bounds.clearance_mm - bounds.clearance_asked_mm == pytest.approx(0.1, abs=0.02)
        return
    with pytest.raises(MateTooNear, match="box 1") as refusal:
        plan(standing(300.0), standing(100.0), mate, 5.0, standoff_mm=100.0)
    assert refusal.value.limit == pytest.approx(1.7)
    assert refusal.value.value == pytest.approx(1.6, abs=0.02)
    assert "s = " in refusal.value.cause
    assert "fit" in refusal.value.cause


@pytest.mark.parametrize(("past", "clear"), [(0.29, True), (0.31, False), (0.4, False)])
def test_contact_is_forgiven_up_to_its_limit(past: float, clear: bool) -> None:
    mate = replace(SETTINGS, coast_s=0.0)
    asked = {"standoff_mm": 0.0, "from_standoff_mm": 3.0}
    if clear:
        plan(standing(3.0), standing(-past), mate, 0.2, **asked)
        return
    with pytest.raises(MateTooNear):
        plan(standing(3.0), standing(-past), mate, 0.2, **asked)


def test_drives_that_lose_their_sync_would_coast_into_the_mate() -> None:
    """0.5 mm/s for 0.5 s is inside the contact allowance, 2.9 mm/s is not: its share that would fit is named."""
    asked = {"standoff_mm": 0.0, "from_standoff_mm": 30.0}
    coasting = replace(SETTINGS, coast_s=0.5)
    plan(standing(30.0), standing(0.0), coasting, 0.5, **asked)
    with pytest.raises(MateTooNear, match="SYNC") as refusal:
        plan(standing(30.0), standing(0.0), coasting, 2.9, **asked)
    assert "% of the speed" in refusal.value.cause
    plan(standing(30.0), standing(0.0), replace(SETTINGS, coast_s=0.0), 2.9, **asked)


@pytest.mark.parametrize(("aside", "fits"), [(3.9, True), (4.1, False)])
def test_inside_the_corridor_only_along_the_insertion(aside: float, fits: bool) -> None:
    asked = {"standoff_mm": 10.0, "from_standoff_mm": 30.0}
    if fits:
        plan(standing(30.0, (aside, 0.0)), standing(10.0), **asked)
        return
    with pytest.raises(ApproachRefused, match="corridor") as refusal:
        plan(standing(30.0, (aside, 0.0)), standing(10.0), **asked)
    assert (refusal.value.value, refusal.value.limit) == (pytest.approx(aside), 4.0)
    assert "s = 0.000" in refusal.value.cause


def test_a_tilt_counts_at_the_rim() -> None:
    """4 mm at 2 m is 0.115 deg."""
    asked = {"standoff_mm": 10.0, "from_standoff_mm": 30.0}
    plan(standing(30.0, turn_z_deg=0.10), standing(10.0), **asked)
    with pytest.raises(ApproachRefused, match="corridor"):
        plan(standing(30.0, turn_z_deg=0.13), standing(10.0), **asked)


def test_outside_the_corridor_the_way_back_is_open() -> None:
    """Aligning where it stands, and going away, are allowed; the same with a closing gap is not."""
    crooked = standing(30.0, (6.0, 0.0))
    plan(crooked, standing(30.0), standoff_mm=30.0, from_standoff_mm=100.0)
    plan(crooked, standing(60.0), standoff_mm=60.0, from_standoff_mm=100.0)
    edge = replace(SETTINGS, corridor_length_mm=30.001)  # left again at once: a single sample lies inside
    plan(crooked, standing(60.0), edge, standoff_mm=60.0, from_standoff_mm=100.0)
    with pytest.raises(ApproachRefused, match="corridor"):
        plan(crooked, standing(20.0), standoff_mm=20.0, from_standoff_mm=100.0)


def test_stations_go_in_order() -> None:
    with pytest.raises(ApproachRefused, match="order") as refusal:
        plan(standing(300.0), standing(0.0), standoff_mm=0.0, from_standoff_mm=3.0)
    assert (refusal.value.value, refusal.value.limit) == (pytest.approx(300.0), pytest.approx(7.0))
    with pytest.raises(ApproachRefused, match="order"):
        plan(standing(100.0), standing(3.0), standoff_mm=30.0, from_standoff_mm=100.0)


def test_a_part_that_stands_too_near_may_only_go_away() -> None:
    mate = replace(SETTINGS, clearance_mm=20.0, coast_s=0.0)
    near = standing(30.0, turn_z_deg=0.8)  # the rim is 2 mm before the mate where 14.7 mm are asked
    free = replace(mate, corridor_length_mm=0.0)
    plan(near, standing(60.0), free, standoff_mm=60.0)
    with pytest.raises(MateTooNear):
        plan(near, standing(29.0, turn_z_deg=0.8), free, standoff_mm=29.0)


@pytest.mark.parametrize(("coast_s", "quick_stop_s"), [(0.5, 0.0), (0.3, 0.4), (0.1, 0.8)])
def test_coasting_goes_on_for_its_time_and_half_the_ramp(coast_s: float, quick_stop_s: float) -> None:
    """gap(t) - v(t) (coast + ramp / 2) where it is least, on the way from 100 to 30 mm in 10 s."""
    law = quintic(10.0)
    scene = Scene(standing(100.0), MATE, DOCKED, 30.0, 100.0)
    correction = correction_to(standing(100.0), standing(30.0), FACE)
    found = check_mate(scene, correction, law, replace(SETTINGS, coast_s=coast_s), quick_stop_s)
    t_s = np.linspace(0.0, 10.0, 20001)
    gap = 100.0 - 70.0 * law.at(t_s)
    assert found.distance_mm == pytest.approx((gap + np.gradient(gap, t_s) * 0.5).min(), abs=0.02)
    assert found.distance_mm < 29.9
