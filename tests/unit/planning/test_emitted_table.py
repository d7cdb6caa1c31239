"""The last look at a plan: the table that is sent, against every limit of every axis, whatever the pacing believed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from docking.errors import AxisLimitExceeded
from docking.planning.path import RigidPath, rigid_path
from docking.planning.preflight import check_chord, check_table, segments_needed
from docking.types import Array, Correction
from tests.reference_geometry import AXES, FACE, rc1, rc3

PERIOD_S = 0.01
U = np.linspace(0.0, 1.0, 201)
S = 10.0 * U**3 - 15.0 * U**4 + 6.0 * U**5
LIMITS = ("v_mm_s", "a_mm_s2", "j_mm_s3")


def peak(order: int) -> float:
    """Largest difference of the table's own shape, at rest before and after, per period."""
    padded = np.concatenate([np.zeros(3), S, np.ones(3)])
    return float(np.abs(np.diff(padded, order + 1)).max() / PERIOD_S ** (order + 1))


def table(axis: str, size_mm: float) -> Array:
    return np.outer(S, np.where(np.array(AXES) == axis, size_mm, 0.0))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("axis", ["A.X", "D.Z", "C.Y"])
def test_a_thousandth_over_a_limit_is_refused_and_what_would_fit_fits(order: int, axis: str) -> None:
    """C.Y has no power in RC-3: it must be able to go along."""
    limit = (10.0, 10.0, 50.0)[order]
    wide = {name: np.full(12, 1e9) for name in LIMITS}
    positioners = replace(rc3(), **{**wide, LIMITS[order]: np.full(12, limit)})
    size = limit / peak(order)
    speeds = check_table(S, table(axis, 0.999 * size), PERIOD_S, positioners)
    assert speeds[AXES.index(axis)] == pytest.approx(0.999 * size * peak(0))
    with pytest.raises(AxisLimitExceeded) as refusal:
        check_table(S, table(axis, 1.21 * size), PERIOD_S, positioners)
    error = refusal.value
    assert (error.where, error.limit) == (axis, limit)
    assert error.value == pytest.approx(1.21 * limit)
    share = float(re.findall(r"(\d+) % of the speed would fit", error.cause)[0]) / 100.0
    assert share == pytest.approx(1.21 ** (-1.0 / (order + 1)), abs=0.006)
    with pytest.raises(AxisLimitExceeded, match="of the set-points near s = "):
        check_table(S, table(axis, 1.001 * size), PERIOD_S, positioners)


def test_a_start_or_an_end_that_is_not_at_rest_is_a_jerk() -> None:
    whole = table("B.Y", 5.0)
    check_table(S, whole, PERIOD_S, rc1())
    for cut in (slice(40, None), slice(None, 160)):
        with pytest.raises(AxisLimitExceeded, match=r"B\.Y"):
            check_table(S[cut], whole[cut], PERIOD_S, rc1())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_no_number_is_no_set_point(bad: float) -> None:
    whole = table("B.Y", 5.0)
    whole[100, 4] = bad
    with pytest.raises(AxisLimitExceeded), np.errstate(invalid="ignore"):
        check_table(S, whole, PERIOD_S, rc1())


def turning(degrees: float) -> RigidPath:
    return rigid_path(rc1(), np.zeros(12), Correction(FACE, np.radians([0.0, 0.0, degrees]), np.zeros(3)))


def test_too_few_rows_for_a_turn_are_refused_with_how_many_would_do() -> None:
    """RC-1, yaw: L = 7 m across the axis, 1 deg in one piece is 0.27 mm off (L theta^2 / 8); 0.02 mm take four."""
    path = turning(1.0)
    assert check_chord(path, np.linspace(0.0, 1.0, 5), 0.02) == pytest.approx(0.27 / 16.0, rel=0.05)
    with pytest.raises(AxisLimitExceeded, match="4 even turns are needed") as refusal:
        check_chord(path, np.linspace(0.0, 1.0, 4), 0.02)
    assert refusal.value.value == pytest.approx(0.27 / 9.0, rel=0.05)
    with pytest.raises(AxisLimitExceeded):
        check_chord(path, np.array([0.0, 0.6, 0.7, 0.8, 0.9, 1.0]), 0.02)
    assert segments_needed(turning(0.0), 0.02) == 1
