"""The frame of a map is as good as its markers hold it: away from them, or against them, less is promised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.guidance.frame_error import DRIFT_SHARE, FrameError
from docking.guidance.map_build import Scanned, place
from docking.guidance.map_methods import MethodSettings
from docking.guidance.types import MapQuality
from tests.support.marked_wall import Wall, marked_wall


@pytest.fixture(scope="module")
def wall() -> Wall:
    return marked_wall()


def row(span_mm: float) -> np.ndarray:
    return np.array([[x, 0.0, 0.0] for x in np.linspace(0.0, span_mm, 9)])


def test_nothing_is_added_at_a_circle_and_more_with_the_distance() -> None:
    frame = FrameError(row(400.0), 0.2)
    assert frame.away_sigma_mm(np.zeros(3)) == 0.0
    near, far = (frame.away_sigma_mm(np.array([400.0 + d, 0.0, 0.0])) for d in (500.0, 2000.0))
    assert near == pytest.approx(500.0 * np.hypot(0.2 / 400.0, DRIFT_SHARE * 5.0 / 9.0))
    assert far > 5.0 * near


def test_markers_that_span_more_hold_the_frame_better() -> None:
    place_mm = np.array([0.0, 0.0, 1000.0])
    wide, narrow = (FrameError(row(span), 0.2).away_sigma_mm(place_mm) for span in (3000.0, 300.0))
    assert wide < 0.5 * narrow


def test_only_the_markers_that_set_the_frame_hold_it(wall: Wall) -> None:
    quality = MapQuality(markers_used=(0, 1), marker_rms_mm=0.3)
    ar_map = replace(wall.free, layout=wall.layout, quality=quality)
    frame = FrameError.of(ar_map)
    assert (frame.circles_mm.shape, frame.rms_mm) == ((8, 3), 0.3)
    # Circles that could not be compared promise nothing that may be drawn.
    assert 2.0 * FrameError.of(replace(ar_map, quality=replace(quality, marker_rms_mm=None))).rms_mm > 10.0
    assert FrameError.of(replace(ar_map, quality=replace(quality, doubt_mm=40.0))).rms_mm == 40.0


@pytest.mark.parametrize("method", ["published", "joint"])
def test_markers_moved_together_are_told_and_nothing_is_promised(wall: Wall, method: str) -> None:
    circles = wall.layout.circles_mm.copy()
    circles[[0, 1]] += (0.0, 60.0, 0.0)
    layout = replace(wall.layout, circles_mm=circles)
    scanned = Scanned(wall.free, wall.sightings, 0.0)
    quality = place(scanned, layout, method, MethodSettings()).quality  # type: ignore[arg-type]
    assert set(quality.markers_rejected) == {0, 1}
    assert quality.doubt_mm == pytest.approx(60.0, abs=6.0)
    assert any("moved together" in notice for notice in quality.notices)


def test_a_joint_map_that_a_wrong_survey_strains_promises_nothing(wall: Wall) -> None:
    """Half of the markers moved by 20 mm: no majority names them, and the map bends to both halves."""
    circles = wall.layout.circles_mm.copy()
    circles[[0, 1, 2]] += (0.0, 20.0, 0.0)
    layout = replace(wall.layout, circles_mm=circles)
    ar_map = place(Scanned(wall.free, wall.sightings, 0.0), layout, "joint", MethodSettings())
    assert not ar_map.quality.markers_rejected
    assert 2.0 * FrameError.of(ar_map).rms_mm > 10.0
    assert any("more than its sigmas allow" in notice for notice in ar_map.quality.notices)
    right = place(Scanned(wall.free, wall.sightings, 0.0), wall.layout, "joint", MethodSettings())
    assert right.quality.doubt_mm == 0.0


def test_one_moved_marker_is_named_and_casts_no_doubt_on_the_others(wall: Wall) -> None:
    circles = wall.layout.circles_mm.copy()
    circles[0] += (0.0, 20.0, 0.0)
    layout = replace(wall.layout, circles_mm=circles)
    quality = place(Scanned(wall.free, wall.sightings, 0.0), layout, "joint", MethodSettings()).quality
    assert set(quality.markers_rejected) == {0}
    assert quality.doubt_mm == 0.0
