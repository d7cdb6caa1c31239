"""What a service calls, on rendered pictures of the laboratory cell: devices registered, maps exchanged, streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import DevicePairsDisagree, MapFrameDiffers
from docking.geometry import rotation_angle
from docking.guidance.detection import MarkerDetector
from docking.guidance.guide import Guide
from docking.guidance.images import Picture
from docking.guidance.map_build import Scanned, place
from docking.guidance.map_builder import BuilderSettings
from docking.guidance.map_files import save_map
from docking.guidance.map_methods import MethodSettings
from docking.guidance.posed_map import build_from_poses
from docking.guidance.types import ArMap
from docking.types import Pose
from sim.camera import SimulatedCamera
from sim.scenery import box, wall_scenery, with_patches
from tests.support.guided_cell import CAMERA, LENS, WALL, X_WP, guided_cell, layout_of, left_half, picture, view

X_WD = Pose(Rotation.from_rotvec([0.3, 0.9, -0.2]).as_matrix(), np.array([1200.0, -300.0, 800.0]))
"""The world of the device in the cell."""
STANDS = (view(100.0, 1000.0), view(400.0, 950.0, 800.0, 40.0), view(700.0, 1050.0, 850.0, -30.0), view(850.0, 980.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("guide") / "map"
    save_map(guided_cell().ar_map, path)
    return path


def test_a_device_is_registered_from_its_pictures(folder: Path) -> None:
    """One picture shows nothing, and one of the device's poses is wrong: both are left out."""
    pairs = [(picture(X, seed=k), X_WD.inverse() @ X) for k, X in enumerate(STANDS)]
    slipped = view(300.0, 1000.0, 850.0)
    wrong = Pose(slipped.R, slipped.t_mm + np.array([0.0, 0.0, 300.0]))
    pairs = [*pairs, (picture(slipped), X_WD.inverse() @ wrong), (np.zeros((480, 640), np.uint8), X_WD)]
    found = Guide(folder).register(pairs)
    assert (found.used, found.rejected) == ((0, 1, 2, 3), (4,))
    assert np.linalg.norm(found.X_WD.t_mm - X_WD.t_mm) < 8.0
    assert np.degrees(rotation_angle(found.X_WD.R.T @ X_WD.R)) < 0.3
    # What the device then draws by its own pose is where it belongs in the cell.
    p_W = np.array([400.0, 650.0, 1000.0])
    seen_D = found.X_WD.inverse().apply(p_W)
    assert np.linalg.norm(X_WD.apply(seen_D) - p_W) < 4.0


def test_too_few_pictures_register_nothing(folder: Path) -> None:
    pairs = [(picture(X, seed=k), X_WD.inverse() @ X) for k, X in enumerate(STANDS[:2])]
    with pytest.raises(DevicePairsDisagree):
        Guide(folder).register([*pairs, (np.zeros((480, 640), np.uint8), X_WD)])


def changed_cell() -> tuple[ArMap, SimulatedCamera]:
    """The cell with three boxes put before the wall, mapped again from a scan of its own; and a camera in it."""
    rng = np.random.default_rng(8)
    places = ((150.0, 600.0, 900.0), (520.0, 560.0, 1250.0), (800.0, 620.0, 850.0))
    boxes = [b for p in places for b in box(Pose(np.eye(3), np.array(p)), np.array([160.0, 150.0, 170.0]), rng)]
    scenery = with_patches(wall_scenery(3, WALL, X_WP), boxes)
    camera, layout = SimulatedCamera(scenery.patches, LENS, seed=6), layout_of(scenery, 0.1)
    poses = [
        view(x, z, d, t) for z, d, t in ((980.0, 840.0, 50.0), (1080.0, 900.0, -40.0)) for x in range(30, 980, 150)
    ]
    detector, seen = MarkerDetector.of(layout, CAMERA), []
    free = build_from_poses(
        CAMERA,
        [(Picture(f"{k:04d}", k / 10.0, camera.picture(X)), X) for k, X in enumerate(poses)],
        BuilderSettings(features=1200),
        lambda p: seen.append(tuple(detector.detect(p.image))),
    )
    return place(Scanned(free, tuple(seen), 0.0), layout, "joint", MethodSettings(camera_sigma=None)), camera


def test_a_changed_cell_is_mapped_again_and_streams_go_on_in_the_same_frame(folder: Path, tmp_path: Path) -> None:
    guide = Guide(folder)
    stream = guide.stream()
    before = stream.step("before", 0.0, picture(view(400.0, 1000.0, 850.0)))
    assert np.linalg.norm(before.X_WC.t_mm - view(400.0, 1000.0, 850.0).t_mm) < 4.0
    fresh, camera = changed_cell()
    save_map(fresh, tmp_path / "fresh")
    guide.swap(tmp_path / "fresh")
    truth = view(430.0, 1000.0, 850.0)
    for found in (stream.step("after", 0.2, camera.picture(truth)), guide.localise(camera.picture(truth))):
        assert found.source == "map"
        assert np.linalg.norm(found.X_WC.t_mm - truth.t_mm) < 4.0
    assert len(stream.localiser.ar_map.points_mm) == len(guide.localiser.ar_map.points_mm) == len(fresh.points_mm)


def test_a_map_of_another_place_is_not_taken_over(folder: Path, tmp_path: Path) -> None:
    guide = Guide(folder)
    ar_map = guided_cell().ar_map
    assert ar_map.layout is not None
    shifted = replace(ar_map.layout, circles_mm=ar_map.layout.circles_mm + np.array([0.0, 0.0, 30.0]))
    save_map(replace(ar_map, layout=shifted), tmp_path / "moved")
    localiser = guide.localiser
    with pytest.raises(MapFrameDiffers):
        guide.swap(tmp_path / "moved")
    assert guide.localiser is localiser


def test_where_the_map_ends_markers_carry_the_stream_and_it_says_so(folder: Path) -> None:
    """The left half of the map is known; over the right half the markers alone tell, until the camera comes back."""
    half_folder = folder.parent / "half"
    save_map(left_half(), half_folder)
    stream = Guide(half_folder).stream()
    sources = []
    for k, x_mm in enumerate((100.0, 250.0, 780.0, 850.0, 250.0)):
        truth = view(x_mm, 1000.0, 700.0 if x_mm > 500.0 else 800.0)
        found = stream.step(f"{k}", 1.2 * k, picture(truth, seed=k))
        assert np.linalg.norm(found.X_WC.t_mm - truth.t_mm) < 6.0
        sources.append(found.source)
    assert sources == ["map", "map", "marker", "marker", "map"]
