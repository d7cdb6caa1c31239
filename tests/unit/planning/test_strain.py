"""What devices add to a rigid plan, against closed formulas; reactions at many poses against those at one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import StrainForeseen
from docking.geometry import exp_so3
from docking.kinematics import Positioners, reaction_extremes
from docking.planning import JamSettings, PlanRequest, PlanSettings, make_plan
from docking.planning.attitudes import reactions_along
from docking.types import Correction, Plan, PlanBounds, Pose
from tests.reference_geometry import FACE, SETTINGS, rc1, rc3, with_com


def bounds(shift: tuple[float, float, float], turn_deg: float, settings: PlanSettings, period_s: float) -> PlanBounds:
    return planned(shift, turn_deg, settings, period_s).bounds  # type: ignore[return-value]


def planned(shift: tuple[float, float, float], turn_deg: float, settings: PlanSettings, period_s: float) -> Plan:
    correction = Correction(FACE, np.radians([0.0, 0.0, turn_deg]), np.array(shift))
    wide = replace(rc1(), stroke_mm=np.tile([-5000.0, 5000.0], (12, 1)))
    asked = PlanRequest(1, "s", "align", np.zeros(12), correction, 50.0, period_s, True)
    return make_plan(asked, wide, settings)


def test_the_chord_squeezes_half_its_distance_error() -> None:
    """L theta^2 / 8 is the change of the longest distance; each of its balls moves by half of that."""
    plan = planned((0, 0, 0), 2.0, SETTINGS, 0.1)
    assert plan.bounds is not None
    assert plan.bounds.residual_mm == pytest.approx(0.5 * plan.chord_error_mm, rel=0.02)
    assert plan.bounds.force_n == pytest.approx(20000.0 * plan.bounds.residual_mm, rel=0.01)
    straight = bounds((-50, 0, 0), 0.0, SETTINGS, 0.1)
    assert straight.residual_mm < 1e-9
    assert straight.warp_n < 1e-5


def test_a_late_positioner_is_its_speed_times_its_skew_behind() -> None:
    """Two of four positioners half a skew early, two late: every axis is v skew / 2 off."""
    skewed = replace(SETTINGS, start_skew_s=0.004, sync_error_mm=1.0)
    found = bounds((0, 0, 40), 0.0, skewed, 0.1)
    speed = found.peak_mm_s[2]
    assert found.force_n == pytest.approx(20000.0 * speed * 0.002, rel=0.02)
    assert found.warp_n == pytest.approx(20000.0 * speed * 0.002, rel=0.02)
    drifting = replace(skewed, clock_ppm=50.0)
    later = bounds((0, 0, 40), 0.0, drifting, 0.1)
    assert later.force_n / found.force_n == pytest.approx(1.0 + 1e-4 * found.duration_s / 0.004, rel=0.02)


@pytest.mark.parametrize(
    ("limits", "what"), [({"force_n": 400.0, "warp_n": 1e9}, "internal force in N"), ({"warp_n": 200.0}, "warp in N")]
)
def test_a_plan_that_its_own_bus_would_strain_is_refused(limits: dict[str, float], what: str) -> None:
    jam = JamSettings(**{"residual_mm": 1e9, "force_n": 1e9, "stuck_mm": 1e-3, "reaction_s": 0.0} | limits)
    tight = replace(SETTINGS, start_skew_s=0.01, sync_error_mm=1.0, jam=jam)
    with pytest.raises(StrainForeseen, match=what) as refusal:
        bounds((0, 0, 40), 0.0, tight, 0.1)
    assert "would fit" in refusal.value.cause


@pytest.mark.parametrize("positioners", [rc1(), rc3(), replace(rc3(d_z_driven=False), held_n=13400.0 * np.eye(12)[11],
                                                               held_tolerance_n=268.0 * np.eye(12)[11])])  # fmt: skip
def test_reactions_at_many_poses_are_those_at_each(positioners: Positioners) -> None:
    load = replace(with_com([600.0, 200.0, 50.0], 40.0).load, mass_tolerance_kg=60.0)
    rng = np.random.default_rng(3)
    poses = [Pose(exp_so3(rng.uniform(-0.05, 0.05, 3)), rng.uniform(-100, 100, 3)) for _ in range(6)]
    upward, along = reactions_along(
        np.array([X.R for X in poses]), np.array([X.t_mm for X in poses]), positioners, load
    )
    for i, X in enumerate(poses):
        one = reaction_extremes(positioners, X, load)
        np.testing.assert_allclose(upward[i], one.least_up_n, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(along[i], one.peak_axis_n, rtol=1e-9, atol=1e-6)
