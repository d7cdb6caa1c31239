"""One image in a map: right where it can be, refused with a name where it cannot."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from docking.errors import BadArgument, NotLocalised
from docking.guidance.localiser import Localised, Localiser, LocaliseSettings
from docking.guidance.marker_pose import locate_by_markers
from docking.guidance.types import Image
from docking.types import Array, Pose
from sim.camera import SimulatedCamera
from sim.scenery import WallSize, wall_scenery
from tests.support.guided_cell import CAMERA, LENS, X_WP, guided_cell, picture, view

MAP_ONLY = LocaliseSettings(by_markers=False)
HERE = view(420.0, 1010.0, 800.0, 30.0, 3.0)


@pytest.fixture(scope="module")
def localiser() -> Localiser:
    return Localiser(guided_cell().ar_map, settings=MAP_ONLY)


def drawn_off_mm(found: Localised, true: Pose) -> tuple[Array, Array]:
    """How far points in view are drawn off, across the line of sight, and what was predicted, mm."""
    pixels = np.array([[x, y] for x in (80.0, 320.0, 560.0) for y in (60.0, 240.0, 420.0)])
    rays = np.column_stack([CAMERA.undistort(pixels), np.ones(len(pixels))])
    places = true.apply(rays * found.depth_mm)
    off = found.X_WC.inverse().apply(places) - rays * found.depth_mm
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = off - along * np.sum(off * along, axis=1, keepdims=True)
    return np.linalg.norm(across, axis=1), np.array([found.predicted_error_mm(place) for place in places])


@pytest.mark.parametrize("x_mm", [80.0, 420.0, 820.0])
def test_the_pose_is_right_and_says_how_good_it_is(localiser: Localiser, x_mm: float) -> None:
    true = view(x_mm, 1010.0, 800.0, 30.0, 3.0)
    found = localiser.localise(picture(true))
    assert found.source == "map"
    assert np.linalg.norm(found.X_WC.t_mm - true.t_mm) < 4.0
    off, predicted = drawn_off_mm(found, true)
    assert np.all(off <= predicted)
    assert predicted.max() < 10.0


def test_a_hint_finds_the_same_place(localiser: Localiser) -> None:
    near = view(440.0, 1000.0, 790.0, 30.0, 2.0)
    a, b = localiser.localise(picture(HERE)), localiser.localise(picture(HERE), near)
    assert np.linalg.norm(a.X_WC.t_mm - b.X_WC.t_mm) < 1.0
    wrong = view(-100.0, 900.0, 500.0)
    assert np.linalg.norm(localiser.localise(picture(HERE), wrong).X_WC.t_mm - HERE.t_mm) < 4.0


@pytest.mark.parametrize("share", [0.94, 1.06])
def test_a_picture_of_another_zoom_is_refused_with_its_name(localiser: Localiser, share: float) -> None:
    """Its points fit a place 6 % further away or nearer nearly as well, and say 2 mm of a pose that is 50 mm off."""
    zoomed = replace(CAMERA, fx_px=share * CAMERA.fx_px, fy_px=share * CAMERA.fy_px)
    with pytest.raises(NotLocalised, match="focal length"):
        Localiser(localiser.index, zoomed, MAP_ONLY).localise(picture(HERE))


def other_place() -> Image:
    """Another wall of the same make, with the same markers."""
    patches = wall_scenery(33, WallSize(1600.0, 1000.0, boxes=6, groups=2), X_WP).patches
    return SimulatedCamera(patches, LENS, 4).picture(HERE)


def test_another_place_is_refused(localiser: Localiser) -> None:
    with pytest.raises(NotLocalised):
        localiser.localise(other_place())


def test_blur_is_refused_with_its_name(localiser: Localiser) -> None:
    with pytest.raises(NotLocalised):
        localiser.localise(picture(HERE, blur_px=45.0))
    with pytest.raises(NotLocalised, match="too few features"):
        localiser.localise(cv2.GaussianBlur(picture(HERE), (0, 0), 25.0))


@pytest.mark.parametrize("share", [0.65, 0.8])
def test_a_picture_in_part_hidden_is_right_or_refused(localiser: Localiser, share: float) -> None:
    for x_mm in (80.0, 820.0):
        true = view(x_mm, 1010.0, 800.0, 30.0, 3.0)
        image = picture(true)
        image[:, : int(share * image.shape[1])] = 90
        try:
            found = localiser.localise(image)
        except NotLocalised:
            continue
        off, predicted = drawn_off_mm(found, true)
        assert np.all(off <= np.maximum(predicted, 3.0)), (x_mm, share)


def test_half_hidden_is_still_localised(localiser: Localiser) -> None:
    image = picture(HERE)
    image[:, :320] = 90
    assert np.linalg.norm(localiser.localise(image).X_WC.t_mm - HERE.t_mm) < 6.0


def test_a_pose_that_leaves_a_corner_of_the_picture_uncertain_is_none(localiser: Localiser) -> None:
    reach_mm = localiser.localise(picture(HERE)).corner_error_mm()
    for limit_mm, refused in ((reach_mm / 1.4, False), (reach_mm / 1.6, True)):
        strict = Localiser(localiser.index, settings=LocaliseSettings(by_markers=False, limit_mm=limit_mm))
        if refused:
            with pytest.raises(NotLocalised, match="corners"):
                strict.localise(picture(HERE))
        else:
            assert strict.localise(picture(HERE)).corner_error_mm() == pytest.approx(reach_mm)


def test_a_mirrored_picture_is_refused(localiser: Localiser) -> None:
    with pytest.raises(NotLocalised):
        localiser.localise(np.ascontiguousarray(picture(HERE)[:, ::-1]))


def test_a_picture_of_another_size_is_refused(localiser: Localiser) -> None:
    with pytest.raises(BadArgument):
        localiser.localise(picture(HERE)[:400])


@cache
def bare_wall_map() -> Localiser:
    """A map whose points look like nothing in view: only its markers help."""
    ar_map = guided_cell().ar_map
    strange = np.random.default_rng(1).integers(0, 256, ar_map.descriptors.shape, dtype=np.uint8)
    frames = tuple(replace(f, descriptors=strange[: len(f.descriptors)]) for f in ar_map.keyframes)
    return Localiser(replace(ar_map, keyframes=frames, descriptors=strange))


def test_where_the_map_does_not_help_markers_do_and_it_says_so() -> None:
    true = view(50.0, 1050.0, 550.0)
    found = bare_wall_map().localise(picture(true))
    assert found.source == "marker"
    assert np.linalg.norm(found.X_WC.t_mm - true.t_mm) < 2.0


def test_a_marker_that_was_moved_gives_no_pose() -> None:
    """20 mm: the circles of three markers do not fit one camera any more."""
    localiser = bare_wall_map()
    layout = localiser.ar_map.layout
    assert layout is not None
    moved = layout.circles_mm.copy()
    moved[1] += (20.0, 0.0, 0.0)
    index = replace(localiser.index, ar_map=replace(localiser.ar_map, layout=replace(layout, circles_mm=moved)))
    with pytest.raises(NotLocalised):
        Localiser(index).localise(picture(view(50.0, 1050.0, 550.0)))


def test_one_marker_alone_gives_no_pose() -> None:
    """Its four circles fit wherever it hangs: after a move by 20 mm all would be drawn 20 mm off."""
    layout, image = guided_cell().layout, picture(view(50.0, 1050.0, 550.0))
    fit, sights = locate_by_markers(image, layout, CAMERA)
    assert len(sights) == 12
    assert np.linalg.norm(fit.X_WC.t_mm - view(50.0, 1050.0, 550.0).t_mm) < 2.0
    rows = [k for k, own in enumerate(layout.circles_mm) if np.all(sights.points_mm == own[0], axis=1).any()]
    for row in rows:
        moved = layout.circles_mm[[row]] + (20.0, 0.0, 0.0)
        with pytest.raises(NotLocalised, match=f"marker {layout.ids[row]} alone"):
            locate_by_markers(image, replace(layout, ids=layout.ids[row : row + 1], circles_mm=moved), CAMERA)
    assert len(rows) == 3


def test_a_doubt_about_the_markers_is_one_about_poses_from_them() -> None:
    localiser = bare_wall_map()
    image = picture(view(50.0, 1050.0, 550.0))
    sure = localiser.localise(image)
    assert sure.predicted_error_mm() < 5.0
    quality = replace(localiser.ar_map.quality, doubt_mm=30.0)
    doubtful = Localiser(replace(localiser.index, ar_map=replace(localiser.ar_map, quality=quality))).localise(image)
    assert doubtful.source == "marker"
    assert doubtful.predicted_error_mm() >= 60.0
    # Two metres beside the markers in view the pose says less about a place than among them.
    aside = sure.X_WC.apply(np.array([2000.0, 0.0, sure.depth_mm]))
    assert sure.predicted_error_mm(aside) > 2.0 * sure.predicted_error_mm()


def test_markers_are_not_used_unless_allowed() -> None:
    with pytest.raises(NotLocalised):
        Localiser(bare_wall_map().index, settings=MAP_ONLY).localise(picture(view(50.0, 1050.0, 550.0)))
