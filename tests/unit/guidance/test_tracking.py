"""A stream: guided by what it knew, found again after a loss, a map that grows or not, another map put in its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.errors import MapFrameDiffers, NotLocalised
from docking.guidance.localiser import Localiser, LocaliseSettings, indexed
from docking.guidance.tracking import Tracker
from tests.support.guided_cell import guided_cell, left_half, picture, view

MAP_ONLY = LocaliseSettings(by_markers=False)


def walk(count: int, start_mm: float = 0.0, step_mm: float = 90.0) -> list[tuple[str, float, np.ndarray, np.ndarray]]:
    """(name, t, picture, true place) along the wall."""
    views = [view(start_mm + step_mm * k, 1000.0, 780.0, 20.0) for k in range(count)]
    return [(f"{k}", k / 10.0, picture(X, seed=k), X.t_mm) for k, X in enumerate(views)]


def test_lost_and_found_again() -> None:
    tracker = Tracker(Localiser(guided_cell().ar_map, settings=MAP_ONLY))
    for name, t_s, image, place in walk(3):
        assert np.linalg.norm(tracker.step(name, t_s, image).X_WC.t_mm - place) < 4.0
    dark = np.zeros_like(image)
    for k in range(2):
        with pytest.raises(NotLocalised):
            tracker.step("dark", 0.3 + k / 10.0, dark)
    elsewhere = view(800.0, 1000.0, 800.0)
    found = tracker.step("again", 0.5, picture(elsewhere))
    assert np.linalg.norm(found.X_WC.t_mm - elsewhere.t_mm) < 4.0
    c = tracker.counts
    assert (c.frames, c.localised, c.losses, c.relocalised) == (6, 4, 1, 1)


def test_read_only_leaves_the_map_and_loses_the_way() -> None:
    tracker = Tracker(Localiser(left_half(), settings=MAP_ONLY))
    before = tracker.localiser.ar_map
    lost = 0
    for name, t_s, image, _ in walk(9, 150.0):
        try:
            tracker.step(name, t_s, image)
        except NotLocalised:
            lost += 1
    assert lost > 0
    assert tracker.localiser.ar_map is before


def test_an_extended_map_stays_in_the_frame_of_the_cell() -> None:
    localiser = Localiser(left_half(), settings=MAP_ONLY)
    known = len(localiser.ar_map.points_mm)
    tracker = Tracker(localiser, read_only=False)
    for name, t_s, image, place in walk(9, 150.0):
        found = tracker.step(name, t_s, image)
        assert np.linalg.norm(found.X_WC.t_mm - place) < 30.0
    assert tracker.counts.localised == 9
    assert tracker.counts.points_added == len(tracker.localiser.ar_map.points_mm) - known > 0
    # What no surveyed circle holds is less certain, and says so.
    assert found.generation > 0.5
    assert (
        found.predicted_error_mm() > 1.2 * localiser.localise(picture(view(100.0, 1000.0, 780.0))).predicted_error_mm()
    )
    # After a loss what tracking has added tells no place, the map as built does.
    with pytest.raises(NotLocalised):
        tracker.step("dark", 1.0, np.zeros_like(image))
    with pytest.raises(NotLocalised, match="added while tracking"):
        tracker.step("there", 1.1, image)
    assert tracker.step("home", 1.2, picture(view(100.0, 1000.0, 780.0))).generation < 0.5


def test_a_fresh_map_takes_over_in_the_same_frame() -> None:
    tracker = Tracker(Localiser(left_half(), settings=MAP_ONLY))
    tracker.step("before", 0.0, picture(view(200.0, 1000.0, 780.0)))
    tracker.swap(indexed(guided_cell().ar_map))
    there = view(700.0, 1000.0, 780.0)
    assert np.linalg.norm(tracker.step("after", 0.5, picture(there)).X_WC.t_mm - there.t_mm) < 4.0


def test_the_camera_of_the_fresh_map_is_used_unless_another_was_stated() -> None:
    """Both maps were adjusted with a camera of their own; the poses of one in the other's are off."""
    ar_map = guided_cell().ar_map
    finer = replace(ar_map, camera=replace(ar_map.camera, fx_px=ar_map.camera.fx_px * 1.002))
    stated = replace(ar_map.camera, fx_px=ar_map.camera.fx_px * 0.999)
    own, given = (Tracker(Localiser(ar_map, camera, MAP_ONLY)) for camera in (None, stated))
    for tracker in (own, given):
        tracker.swap(replace(tracker.localiser.index, ar_map=finer))
    assert own.localiser.camera == finer.camera
    assert given.localiser.camera == stated


def test_a_map_of_another_frame_is_refused() -> None:
    ar_map = guided_cell().ar_map
    tracker = Tracker(Localiser(ar_map, settings=MAP_ONLY))
    layout = ar_map.layout
    assert layout is not None
    moved = replace(layout, circles_mm=layout.circles_mm + 5.0)
    others = (replace(ar_map, frame="free"), replace(ar_map, layout=None), replace(ar_map, layout=moved))
    index = tracker.localiser.index
    for other in others:
        with pytest.raises(MapFrameDiffers):
            tracker.swap(replace(index, ar_map=other))


def test_no_hand_jumps_half_a_metre_in_a_tenth_of_a_second() -> None:
    tracker = Tracker(Localiser(guided_cell().ar_map, settings=MAP_ONLY))
    tracker.step("a", 0.0, picture(view(200.0, 1000.0, 780.0)))
    with pytest.raises(NotLocalised, match="jumped"):
        tracker.step("b", 0.1, picture(view(800.0, 1000.0, 780.0)))
