"""The map in the cell: three methods on a map without images, and markers that are not where the survey says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2", reason="the extra guidance is not installed")

from docking.errors import BadArgument, MarkersDisagree, MarkersTooFew
from docking.guidance import map_methods
from docking.guidance.bundle import Adjusted, Bundle, adjust
from docking.guidance.detection import MarkerSighting
from docking.guidance.map_build import Method, Scanned, map_json, place
from docking.guidance.map_methods import MethodSettings, method_settings
from docking.guidance.marker_survey import Sightings, register
from docking.guidance.similarity import Similarity, collinear, consistent
from docking.guidance.types import ArMap, MarkerLayout
from docking.types import Array
from tests.support.marked_wall import FREE, Wall, ate_mm, drifted, marked_wall


@pytest.fixture(scope="module")
def wall() -> Wall:
    return drifted(marked_wall(), 0.02)


def _placed(wall: Wall, method: Method, layout: MarkerLayout | None = None, seen: Sightings | None = None) -> ArMap:
    known = layout or wall.layout
    scanned = Scanned(wall.free, seen if seen is not None else wall.sightings, 1.0)
    return place(scanned, known, method, MethodSettings())


def _changed(wall: Wall, change: Callable[[Array], None]) -> MarkerLayout:
    circles = wall.layout.circles_mm.copy()
    change(circles)
    return replace(wall.layout, circles_mm=circles)


def _only(wall: Wall, ids: tuple[int, ...]) -> Sightings:
    return tuple(tuple(s for s in frame if s.marker_id in ids) for frame in wall.sightings)


def test_a_map_without_drift_is_placed_exactly() -> None:
    exact = marked_wall(noise_px=0.0)
    for method in ("published", "joint"):
        placed = _placed(exact, method)
        assert ate_mm(placed, exact.truth) < 1e-3
        assert placed.frame == "cell"
        assert placed.quality.scale == pytest.approx(1.0 / FREE.scale, rel=1e-6)
        assert placed.quality.marker_rms_mm < 1e-3  # type: ignore[operator]


def test_both_methods_take_the_drift_out_and_one_marker_alone_does_not(wall: Wall) -> None:
    ate = {method: ate_mm(_placed(wall, method), wall.truth) for method in ("published", "joint", "single-aruco")}
    assert ate["joint"] < 0.5
    assert ate["published"] < 1.5
    assert ate["single-aruco"] > 6.0 * max(ate["joint"], ate["published"])


def test_published_names_its_reset_key_frames_and_joint_holds_none(wall: Wall) -> None:
    published, joint = _placed(wall, "published"), _placed(wall, "joint")
    assert len(published.quality.reset_keyframes) >= 2
    assert set(published.quality.reset_keyframes) <= {frame.name for frame in published.keyframes}
    assert joint.quality.reset_keyframes == ()
    assert map_json(published)["markers_used"] == [0, 1, 2, 3, 4, 5]


def test_without_a_key_frame_to_reset_published_falls_back_and_says_so(wall: Wall) -> None:
    one = tuple(tuple(s for s in frame if s.marker_id == 3 * (i % 2)) for i, frame in enumerate(wall.sightings))
    placed = _placed(wall, "published", seen=one)
    assert placed.quality.reset_keyframes == ()
    assert any("similarity only" in notice for notice in placed.quality.notices)


def test_few_key_frames_to_reset_are_told(wall: Wall) -> None:
    two = tuple(frame if i in (3, 10) else frame[:1] for i, frame in enumerate(wall.sightings))
    placed = _placed(wall, "published", seen=two)
    assert 0 < len(placed.quality.reset_keyframes) <= 2
    assert any("qualify for a reset: away from them" in notice for notice in placed.quality.notices)


@pytest.mark.parametrize("method", ["published", "joint"])
@pytest.mark.parametrize("marker", range(6))
def test_a_marker_moved_by_20_mm_is_named_and_left_out(wall: Wall, method: Method, marker: int) -> None:
    def moved(circles: Array) -> None:
        circles[marker] += [12.0, -16.0, 0.0]

    placed = _placed(wall, method, _changed(wall, moved))
    assert set(placed.quality.markers_rejected) == {marker}
    assert marker not in placed.quality.markers_used
    assert placed.layout is not None
    assert marker not in placed.layout.ids
    assert any(f"marker {marker} " in notice for notice in placed.quality.notices)
    if method == "joint":
        assert ate_mm(placed, wall.truth) < 1.0


def test_two_markers_that_changed_their_names_are_named(wall: Wall) -> None:
    def swapped(circles: Array) -> None:
        circles[[1, 4]] = circles[[4, 1]]

    placed = _placed(wall, "joint", _changed(wall, swapped))
    assert set(placed.quality.markers_rejected) == {1, 4}
    assert ate_mm(placed, wall.truth) < 1.0


@pytest.mark.parametrize("size_mm", [6.0, 10.0, 100.0])
def test_a_typing_error_in_one_circle_is_named_with_its_circle(wall: Wall, size_mm: float) -> None:
    def typed(circles: Array) -> None:
        circles[2, 1, 0] += size_mm

    placed = _placed(wall, "joint", _changed(wall, typed))
    assert set(placed.quality.markers_rejected) == {2}
    assert "circle 1 " in placed.quality.markers_rejected[2]
    assert ate_mm(placed, wall.truth) < 0.6


def test_of_two_markers_that_disagree_none_is_believed(wall: Wall) -> None:
    def moved(circles: Array) -> None:
        circles[0] += [20.0, 0.0, 0.0]

    with pytest.raises(MarkersDisagree, match="marker"):
        _placed(wall, "joint", _changed(wall, moved), _only(wall, (0, 1)))


def test_a_survey_in_inches_is_refused(wall: Wall) -> None:
    def inches(circles: Array) -> None:
        circles /= 25.4

    # A similarity takes any unit: nothing is wrong with the figure, so the size of the marker itself must tell.
    with pytest.raises(MarkersDisagree, match="unit"):
        _placed(wall, "joint", _changed(wall, inches))


def test_a_marker_that_was_moved_during_the_scan_is_named(wall: Wall) -> None:
    def moved(frame: tuple[MarkerSighting, ...], late: bool) -> tuple[MarkerSighting, ...]:
        return tuple(replace(s, circles_px=s.circles_px + 60.0) if late and s.marker_id == 1 else s for s in frame)

    with_1 = [i for i, frame in enumerate(wall.sightings) if any(s.marker_id == 1 for s in frame)]
    middle = with_1[len(with_1) // 2]
    seen = tuple(moved(frame, i >= middle) for i, frame in enumerate(wall.sightings))
    placed = _placed(wall, "joint", seen=seen)
    assert "not at" in placed.quality.markers_rejected[1] or "one place" in placed.quality.markers_rejected[1]


def test_half_of_the_circles_hidden_changes_little(wall: Wall) -> None:
    rng = np.random.default_rng(0)

    def hidden(s: MarkerSighting) -> MarkerSighting:
        return replace(s, circles_px=np.where(rng.random((4, 1)) < 0.5, np.nan, s.circles_px))

    seen = tuple(tuple(hidden(s) for s in frame) for frame in wall.sightings)
    assert ate_mm(_placed(wall, "joint", seen=seen), wall.truth) < 1.0


@pytest.mark.parametrize("method", ["published", "joint", "single-aruco"])
def test_a_scan_of_another_place_is_refused(wall: Wall, method: Method) -> None:
    with pytest.raises(MarkersTooFew):
        _placed(wall, method, seen=tuple(() for _ in wall.sightings))


def test_circles_in_one_view_or_on_one_line_are_refused(wall: Wall) -> None:
    first = next(i for i, frame in enumerate(wall.sightings) if frame)
    once = tuple(frame if i == first else () for i, frame in enumerate(wall.sightings))
    with pytest.raises(MarkersTooFew):
        _placed(wall, "joint", seen=once)
    line = [[True], [True], [False], [False]]
    two = tuple(
        tuple(replace(s, circles_px=np.where(line, s.circles_px, np.nan)) for s in frame if s.marker_id == 0)
        for frame in wall.sightings
    )
    with pytest.raises(MarkersTooFew):
        _placed(wall, "joint", seen=two)


def test_markers_in_one_corner_of_the_scan_raise_a_doubt(wall: Wall) -> None:
    placed = _placed(wall, "joint", seen=_only(wall, (0, 1)))
    assert any("far from them" in notice for notice in placed.quality.notices)


def test_a_prior_of_the_survey_is_used_as_stated(wall: Wall) -> None:
    sigma = wall.layout.sigma_mm.copy()
    sigma[2] = 50.0

    def moved(circles: Array) -> None:
        circles[2] += [4.0, 0.0, 0.0]

    shifted = _changed(wall, moved)
    firm = ate_mm(_placed(wall, "joint", shifted), wall.truth)
    loose = ate_mm(_placed(wall, "joint", replace(shifted, sigma_mm=sigma)), wall.truth)
    assert loose < 0.5 * firm


def test_survey_and_calibration_enter_with_the_sigmas_that_are_stated(
    wall: Wall, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[Bundle] = []

    def looked_at(bundle: Bundle, iterations: int) -> Adjusted:
        taken.append(bundle)
        return adjust(bundle, iterations)

    monkeypatch.setattr(map_methods, "adjust", looked_at)
    sigma = 0.05 + 0.01 * np.arange(wall.layout.sigma_mm.size).reshape(wall.layout.sigma_mm.shape)
    layout = replace(wall.layout, sigma_mm=sigma)
    _placed(wall, "joint", layout)
    (bundle,) = taken
    known = layout.circles_mm.reshape(-1, 3)
    for place_mm, stated in zip(bundle.prior_points, bundle.prior_sigma, strict=True):
        row = int(np.argmin(np.linalg.norm(known - place_mm, axis=1)))
        assert np.array_equal(stated, sigma.reshape(-1, 3)[row])
    assert len(bundle.prior_rows) == len(known)
    assert tuple(bundle.camera_sigma) == (0.003, 3.0, 3.0, 0.01, 0.01)  # type: ignore[arg-type]
    assert not bundle.held_frames.any()


def test_points_that_reset_key_frames_see_are_triangulated_again(wall: Wall) -> None:
    """Before the last adjustment: those points are 0.9 mm off, with the similarity alone they are 5.5 mm off."""
    true = Similarity(1.0 / FREE.scale, FREE.R.T, -FREE.R.T @ FREE.t_mm / FREE.scale).apply(
        marked_wall().free.points_mm
    )
    placed = place(Scanned(wall.free, wall.sightings, 1.0), wall.layout, "published", MethodSettings(iterations=0))
    seen = np.zeros(len(true), int)
    for frame in wall.free.keyframes:
        if frame.name in placed.quality.reset_keyframes:
            seen[frame.landmarks[frame.landmarks >= 0]] += 1
    off_mm = np.linalg.norm(placed.points_mm - true, axis=1)
    assert np.count_nonzero(seen >= 2) > 50
    assert np.median(off_mm[seen >= 2]) < 2.0
    assert np.median(off_mm[seen < 2]) > 5.0


def test_a_calibration_that_the_pictures_contradict_is_told_and_nothing_is_promised(wall: Wall) -> None:
    camera = wall.free.camera
    zoomed = replace(camera, fx_px=1.06 * camera.fx_px, fy_px=1.06 * camera.fy_px)
    scanned = Scanned(replace(wall.free, camera=zoomed), wall.sightings, 1.0)
    quality = place(scanned, wall.layout, "joint", MethodSettings()).quality
    assert any("contradict the calibration" in notice for notice in quality.notices)
    assert 2.0 * quality.doubt_mm > 10.0
    right = _placed(wall, "joint").quality
    assert right.doubt_mm == 0.0
    assert not any("calibration" in notice for notice in right.notices)


def test_a_marker_moved_by_less_than_drift_casts_a_doubt_on_the_published_map(wall: Wall) -> None:
    """8 mm pass for drift, so the marker stays in and the map leans to it: its circles tell that something is wrong."""

    def moved(circles: Array) -> None:
        circles[1] += [0.0, 8.0, 0.0]

    placed = _placed(wall, "published", _changed(wall, moved))
    assert not placed.quality.markers_rejected
    assert 10.0 < ate_mm(placed, wall.truth) < placed.quality.doubt_mm
    assert any("more than its sigmas allow" in notice for notice in placed.quality.notices)
    assert _placed(wall, "published").quality.doubt_mm == 0.0


def test_a_circle_left_out_is_not_its_whole_marker(wall: Wall) -> None:
    def typed(circles: Array) -> None:
        circles[2, 1, 0] += 100.0

    quality = _placed(wall, "joint", _changed(wall, typed)).quality
    assert 2 in quality.markers_used
    assert any(notice.startswith("marker 2 is used only by its other circles") for notice in quality.notices)


def test_points_on_a_line_and_the_largest_set_that_agrees() -> None:
    rng = np.random.default_rng(3)
    known = rng.normal(0.0, 500.0, (12, 3))
    assert collinear(known[:1] + np.linspace(0.0, 1.0, 5)[:, None] * [1.0, 2.0, 3.0])
    assert not collinear(known)
    points = FREE.apply(known)
    points[[2, 7]] += 40.0
    similarity, agree = consistent(points, known, 5.0)
    assert np.flatnonzero(~agree).tolist() == [2, 7]
    assert similarity.scale * FREE.scale == pytest.approx(1.0, rel=1e-9)


def test_the_similarity_is_right_handed_and_refuses_what_it_cannot_place(wall: Wall) -> None:
    settings = MethodSettings().registration
    registered = register(wall.free, wall.layout, wall.sightings, settings)
    assert np.linalg.det(registered.similarity.R) == pytest.approx(1.0)
    assert registered.markers == (0, 1, 2, 3, 4, 5)


@pytest.mark.parametrize("gate", ["", "500,15", "500,15,5", "nan,15,4", "0,15,4", "a,b,c"])
def test_a_gate_that_makes_no_sense_is_refused(gate: str) -> None:
    with pytest.raises(BadArgument):
        method_settings(gate)
