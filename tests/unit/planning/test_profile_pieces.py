"""Plans cut into straight pieces for drives that ramp by themselves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from docking.errors import StrainForeseen
from docking.planning.profile import ProfileLimits, profile_pieces

LIMITS = ProfileLimits(chord_mm=0.01, ramp_s=0.5, skew_s=0.001, counts_per_mm=10_000.0, residual_mm=0.1)
S = np.linspace(0.0, 1.0, 301)


def turned(angle_deg: float, radius_mm: float = 3000.0) -> np.ndarray:
    """X and Y of a ball at a distance from the pivot, and of one on its other side."""
    angle = np.radians(angle_deg) * S
    x, y = radius_mm * (np.cos(angle) - 1.0), radius_mm * np.sin(angle)
    return np.column_stack((x, y, -x, -y))


def test_a_straight_plan_is_one_piece_in_the_proportion_of_its_ways() -> None:
    way = np.array([30.0, -3.0, 0.3, 0.0])
    law = S**2 * (3.0 - 2.0 * S)
    (piece,) = profile_pieces(law[:, None] * way, np.array([5.0, 5.0, 5.0, 5.0]), LIMITS)
    assert piece.speed_mm_s == pytest.approx(5.0 * np.abs(way) / 30.0)
    assert piece.acceleration_mm_s2 == pytest.approx(piece.speed_mm_s / 0.5)
    assert piece.duration_s == pytest.approx(30.0 / 5.0 + 0.5)
    assert piece.fraction == pytest.approx(law, abs=1e-12)


def test_a_short_piece_is_all_ramp_and_never_faster() -> None:
    (piece,) = profile_pieces(S[:, None] * np.array([0.5, 0.1]), np.array([5.0, 5.0]), LIMITS)
    # Triangular: half the way up, half down, with the acceleration of a long one.
    assert piece.acceleration_mm_s2[0] == pytest.approx(10.0)
    assert piece.speed_mm_s[0] == pytest.approx(np.sqrt(0.5 * 10.0))
    assert piece.duration_s == pytest.approx(2.0 * np.sqrt(0.5 / 10.0))


@pytest.mark.parametrize("angle_deg", [0.2, 0.5, 1.0])
def test_a_turn_is_cut_so_that_no_piece_leaves_the_path(angle_deg: float) -> None:
    rows = turned(angle_deg)
    pieces = profile_pieces(rows, np.full(4, 5.0), LIMITS)
    assert pieces[0].first == 0
    assert pieces[-1].last == len(rows) - 1
    assert all(a.last == b.first and (a.end_mm == b.start_mm).all() for a, b in pairwise(pieces))
    for piece in pieces:
        line = piece.start_mm + piece.fraction[:, None] * (piece.end_mm - piece.start_mm)
        assert np.abs(rows[piece.first : piece.last + 1] - line).max() <= LIMITS.chord_mm
    # Sagitta r a^2 / 8 of n equal pieces.
    sagitta = 3000.0 * np.radians(angle_deg) ** 2 / 8.0
    assert len(pieces) == pytest.approx(np.ceil(np.sqrt(sagitta / LIMITS.chord_mm)), abs=1)


def test_no_axis_is_faster_than_in_its_plan() -> None:
    peak = np.array([1.0, 5.0, 1.0, 5.0])
    for piece in profile_pieces(turned(1.0), peak, LIMITS):
        assert (piece.speed_mm_s <= peak * (1.0 + 1e-12)).all()


def test_what_would_strain_the_part_is_refused_with_the_figure() -> None:
    late = ProfileLimits(0.01, 0.5, 0.05, 10_000.0, 0.1)
    with pytest.raises(StrainForeseen) as caught:
        profile_pieces(S[:, None] * np.array([30.0, 10.0]), np.array([5.0, 5.0]), late)
    assert caught.value.value > 0.25
    coarse = ProfileLimits(0.01, 0.5, 0.001, 20.0, 0.1)
    with pytest.raises(StrainForeseen):
        profile_pieces(S[:, None] * np.array([30.0, 10.0]), np.array([5.0, 5.0]), coarse)


def test_axes_that_stand_all_the_way_make_a_piece_of_nothing() -> None:
    (piece,) = profile_pieces(np.zeros((5, 3)), np.full(3, 1.0), LIMITS)
    assert not piece.speed_mm_s.any()
