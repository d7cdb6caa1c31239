"""How each limit sets the pace: docs/mechanics.md (36), and turns so large that the curvature of the path counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import PlanInputInvalid
from docking.planning import PlanRequest, make_plan
from docking.planning.jam import jam_bound
from docking.planning.pace import PaceLimits, fastest_law, motion_along
from docking.planning.path import rigid_path
from docking.planning.time_law import quintic
from docking.types import Correction
from tests.reference_geometry import FACE, SETTINGS, rc1


def test_stretches_of_the_quintic_are_the_formula() -> None:
    """T = max(1.875 g / v, sqrt(5.7735 g / a), cbrt(60 g / j)) for a straight move of g mm."""
    path = rigid_path(rc1(), np.zeros(12), Correction(FACE, np.zeros(3), np.array([-100.0, 0.0, 0.0])))
    jam = jam_bound(rc1(), np.zeros(12), SETTINGS.jam, SETTINGS.load.up)
    limits = PaceLimits(rc1(), (4.0, 8.0), 0.01, False, replace(SETTINGS, start_skew_s=0.01, sync_error_mm=0.02), jam)
    found = {name: factor for factor, name in limits.stretches(path, quintic()) if "jammed" not in name}
    assert found == {
        "stage speed": pytest.approx(1.875 * 100 / 4),
        "lateness": pytest.approx(1.875 * 100 / 8),
        "start skew of the bus": pytest.approx(1.875 * 100 * 0.01 / 0.02),
        "A.X speed": pytest.approx(1.875 * 100 / 10),
        "A.X acceleration": pytest.approx(np.sqrt(10 / np.sqrt(3) * 100 / (0.5 * 10)), rel=1e-4),
        "A.X jerk": pytest.approx(np.cbrt(60 * 100 / 50)),
    }


@pytest.mark.parametrize(
    ("v", "a", "j", "share"),
    [(1e4, 100.0, 1e6, 1.0), (1e4, 1e5, 100.0, 1.0), (150.0, 40.0, 80.0, 1.0), (1e4, 100.0, 1e6, 0.5)],
)
@pytest.mark.parametrize("radius_mm", [0.0, 4000.0])
def test_a_quarter_turn_stays_inside_its_limits_and_uses_them(
    v: float, a: float, j: float, share: float, radius_mm: float
) -> None:
    """Centripetal acceleration and the jerk of turning count as much as those along the path."""
    positioners = replace(
        rc1(),
        stroke_mm=np.tile([-2e4, 2e4], (12, 1)),
        v_mm_s=np.full(12, v),
        a_mm_s2=np.full(12, a),
        j_mm_s3=np.full(12, j),
        swivel_rad=np.full(4, 3.0),
    )
    turn = Correction(np.array([radius_mm, 0.0, 0.0]), np.radians([0.0, 0.0, 90.0]), np.zeros(3))
    settings = replace(SETTINGS, acceleration_share=share)
    plan = make_plan(PlanRequest(1, "s", "k", np.zeros(12), turn, 1e4, 0.01, False), positioners, settings)
    q = np.vstack([np.tile(plan.q_mm[0], (3, 1)), plan.q_mm, np.tile(plan.q_mm[-1], (3, 1))])
    use = [np.abs(np.diff(q, n, axis=0)).max() / 0.01**n / limit for n, limit in ((1, v), (2, share * a), (3, j))]
    assert max(use) <= 1.0 + 1e-6
    assert max(use) >= 0.97


def test_motion_along_a_turn_is_what_the_table_does() -> None:
    turn = Correction(np.zeros(3), np.radians([10.0, -20.0, 60.0]), np.array([500.0, 0.0, 0.0]))
    path = rigid_path(rc1(), np.zeros(12), turn)
    limits = PaceLimits(
        rc1(), (50.0, 60.0), 0.01, False, SETTINGS, jam_bound(rc1(), np.zeros(12), SETTINGS.jam, SETTINGS.load.up)
    )
    for law in (quintic(20.0), fastest_law(path, limits)[0]):
        motion = motion_along(path, law)
        step = 0.004
        t = np.arange(0.0, law.duration_s, step)
        q = path.axes_mm(law.at(t))
        for order, stated in ((1, motion.speed), (2, motion.acceleration)):
            true = np.abs(np.diff(q, order, axis=0)).max(axis=0) / step**order
            np.testing.assert_allclose(stated.max(axis=0), true, rtol=2e-3)
        coarse = q[::4]
        jerk = np.abs(np.diff(coarse, 3, axis=0)).max(axis=0) / (4 * step) ** 3
        np.testing.assert_allclose(motion.jerk.max(axis=0), jerk, rtol=2e-2)


@pytest.mark.parametrize(("late", "fastest", "name"), [(0.5, 0.5, "lateness"), (5.0, 2.0, "stage speed")])
def test_late_cycles_that_slow_a_move_are_what_sets_its_speed(late: float, fastest: float, name: str) -> None:
    shift = Correction(FACE, np.zeros(3), np.array([-20.0, 0.0, 0.0]))
    plan = make_plan(PlanRequest(1, "s", "k", np.zeros(12), shift, 2.0, 0.01, False, None, late), rc1(), SETTINGS)
    assert plan.speed_limited_by == name
    assert plan.bounds is not None
    assert plan.bounds.peak_mm_s.max() == pytest.approx(fastest, rel=0.01)


@pytest.mark.parametrize("late", [0.0, -1.0, float("nan")])
def test_a_speed_of_late_cycles_that_is_none_is_refused(late: float) -> None:
    shift = Correction(FACE, np.zeros(3), np.array([-20.0, 0.0, 0.0]))
    with pytest.raises(PlanInputInvalid):
        make_plan(PlanRequest(1, "s", "k", np.zeros(12), shift, 2.0, 0.01, False, None, late), rc1(), SETTINGS)
