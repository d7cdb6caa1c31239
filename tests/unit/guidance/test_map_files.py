"""What is read and written: calibration, marker file, map folder, COLMAP model. Bad files name what is wrong."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.errors import BadMarkerFile, ConfigInvalid, ExtraMissing, FileUnreadable
from docking.guidance import opencv as extra
from docking.guidance.colmap_files import read_model, write_model
from docking.guidance.input_files import SURVEY_SIGMA_MM, read_camera, read_layout
from docking.guidance.map_files import load_map, save_map
from docking.guidance.types import ArMap, Camera, MapQuality
from tests.support.marked_wall import Wall, marked_wall
from tests.support.shared_data import shared_data

HEADER = "# DICT_4X4_50, ArUco side 50 mm, circles radius 9 mm at (+-42, +-42) mm\nmarker_id,circle,x_mm,y_mm,z_mm"
ROWS = "\n".join(f"{m},{c},{m * 100 + c},{c * 2.5},-1e-1" for m in (3, 8) for c in range(4))


@pytest.fixture(scope="module")
def wall() -> Wall:
    return marked_wall(4, 200)


def test_the_marker_file_of_the_scene_is_read() -> None:
    layout = read_layout(shared_data("ar_scene", "markers.csv"))
    assert layout.ids == tuple(range(9))
    assert layout.circles_mm[4, 2].tolist() == [2055.5751, 501.9547, 0.1121]
    assert (layout.dictionary, layout.side_mm, layout.circle_radius_mm) == ("DICT_4X4_50", 50.0, 9.0)
    assert layout.circle_offset_mm == 42.0
    assert np.all(layout.sigma_mm == SURVEY_SIGMA_MM)


def test_the_calibration_of_the_scene_is_read_and_every_coefficient(tmp_path: Path) -> None:
    camera = read_camera(shared_data("ar_scene", "camera.toml"))
    assert (camera.fx_px, camera.cx_px, camera.cy_px, camera.k1) == (800.8, 480.0, 359.0, 0.0)
    other = replace(camera, k1=-0.012, p2=1e-4, k3=0.5)
    text = shared_data("ar_scene", "camera.toml").read_text("utf-8")
    kept = [line for line in text.splitlines() if not line.startswith("distortion")]
    (tmp_path / "c.toml").write_text("\n".join([*kept, "distortion = [-0.012, 0.0, 0.0, 1e-4, 0.5]"]))
    assert read_camera(tmp_path / "c.toml") == other


def test_sigmas_of_the_survey_are_read(tmp_path: Path) -> None:
    rows = "\n".join(f"{row},0.1,0.2,0.3" for row in ROWS.splitlines())
    (tmp_path / "m.csv").write_text(f"{HEADER},sx_mm,sy_mm,sz_mm\n{rows}\n")
    layout = read_layout(tmp_path / "m.csv")
    assert layout.ids == (3, 8)
    assert layout.sigma_mm[1, 2].tolist() == [0.1, 0.2, 0.3]
    assert layout.index(8) == 1
    assert layout.index(5) is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ROWS, "description"),
        (f"{HEADER}\n{ROWS}\n3,0,1,1,1", "line 11"),
        (f"{HEADER}\n" + "\n".join(ROWS.splitlines()[1:]), "3/0"),
        (f"{HEADER}\n{ROWS}".replace("8,2", "8,7"), "line 9"),
        (f"{HEADER}\n{ROWS}".replace("801", "nan"), "line 8"),
        (f"{HEADER}\n{ROWS}".replace("801", "x"), "line 8"),
        (f"{HEADER},sigma\n{ROWS}", "header"),
        (HEADER, "missing"),
    ],
)
def test_a_bad_marker_file_names_what_is_wrong(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(BadMarkerFile, match=says):
        read_layout(tmp_path / "m.csv")


def test_a_bad_calibration_names_every_fault(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("width_px = 960\nfx_px = -1\nfoo = 2\ndistortion = [1.0]\n")
    with pytest.raises(ConfigInvalid) as error:
        read_camera(tmp_path / "c.toml")
    told = " ".join(error.value.problems)
    assert all(word in told for word in ("height_px", "fx_px", "foo", "distortion"))
    with pytest.raises(FileUnreadable):
        read_camera(tmp_path / "absent.toml")


def test_a_lens_projects_and_undistorts_as_opencv_does() -> None:
    cv2 = pytest.importorskip("cv2", reason="the extra guidance is not installed")
    camera = Camera(960, 720, 800.0, 790.0, 470.0, 350.0, -0.2, 0.05, 0.002, -0.001, 0.01)
    points = np.random.default_rng(0).uniform((-300.0, -200.0, 500.0), (300.0, 200.0, 900.0), (50, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    assert np.allclose(camera.project(points), theirs[:, 0], atol=1e-9)
    assert np.allclose(camera.undistort(theirs[:, 0]), points[:, :2] / points[:, 2:], atol=1e-6)
    assert np.isnan(camera.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()


def _same(a: ArMap, b: ArMap) -> None:
    assert (a.frame, a.camera, a.quality) == (b.frame, b.camera, b.quality)
    for mine, other in zip(a.keyframes, b.keyframes, strict=True):
        assert (mine.name, mine.t_s) == (other.name, other.t_s)
        assert np.allclose(mine.X_WC.matrix(), other.X_WC.matrix(), atol=1e-9)
        assert np.array_equal(mine.landmarks, other.landmarks)
        assert np.array_equal(mine.descriptors, other.descriptors)
    for x, y in zip(a.observations(), b.observations(), strict=True):
        assert np.array_equal(x, y)
    assert np.array_equal(a.points_mm, b.points_mm)


def test_what_lies_beside_the_picture_does_not_fold_back_into_it() -> None:
    """Beyond r = 0.93 this polynomial falls again: (1.5, 0, 1) would land at pixel 289, in the middle of the left."""
    lens = Camera(960, 720, 700.0, 700.0, 479.5, 359.5, k1=0.15, k2=-0.3)
    beside = np.array([[1.5, 0.0, 1.0], [-1.5, 0.2, 1.0], [0.0, 3.0, 1.0]])
    assert np.isnan(lens.project(beside)).all()
    assert np.isfinite(lens.project([[0.68, 0.51, 1.0], [0.9, 0.0, 1.0]])).all()
    slope = lens.to_pixels(np.array([[lens.widest, 0.0], [lens.widest - 1e-4, 0.0]]))
    assert slope[0, 0] == pytest.approx(slope[1, 0], abs=1e-4)
    assert replace(lens, k1=0.1, k2=0.0).widest == np.inf
    assert np.isfinite(replace(lens, k1=0.0, k2=0.0).project(beside)).all()


def test_a_map_comes_back_from_its_folder(wall: Wall, tmp_path: Path) -> None:
    quality = MapQuality("joint", (0, 2), {5: "moved"}, ("0001.png",), 1.5, 0.1, 0.8, 2.0, 0.3, ("look",))
    ar_map = replace(wall.free, layout=wall.layout, quality=quality)
    save_map(ar_map, tmp_path / "map")
    again = load_map(tmp_path / "map")
    _same(ar_map, again)
    assert again.layout is not None
    assert np.array_equal(again.layout.circles_mm, wall.layout.circles_mm)


def test_a_folder_that_is_no_whole_map_is_refused(wall: Wall, tmp_path: Path) -> None:
    with pytest.raises(FileUnreadable):
        load_map(tmp_path)
    save_map(wall.free, tmp_path)
    head = json.loads((tmp_path / "map.json").read_text())
    for broken in ({**head, "format": 9}, {**head, "keyframes": head["keyframes"][1:]}, {"format": 1}):
        (tmp_path / "map.json").write_text(json.dumps(broken))
        with pytest.raises(ConfigInvalid):
            load_map(tmp_path)
    (tmp_path / "map.json").write_text(json.dumps(head))
    (tmp_path / "map.npz").write_bytes((tmp_path / "map.npz").read_bytes()[:5000])
    with pytest.raises((ConfigInvalid, FileUnreadable)):
        load_map(tmp_path)


def test_a_colmap_model_counts_pixels_from_the_corner(wall: Wall, tmp_path: Path) -> None:
    camera = replace(wall.free.camera, k1=-0.01, p1=0.001)
    write_model(replace(wall.free, camera=camera), tmp_path)
    fields = (tmp_path / "cameras.txt").read_text().split()
    assert fields[:4] == ["1", "OPENCV", "960", "720"]
    assert float(fields[6]) == camera.cx_px + 0.5
    model = read_model(tmp_path)
    assert model.camera == camera
    for frame in wall.free.keyframes:
        assert np.allclose(model.poses[frame.name].matrix(), frame.X_WC.matrix(), atol=1e-8)
    first = wall.free.keyframes[0]
    lines = [line for line in (tmp_path / "images.txt").read_text().splitlines() if not line.startswith("#")]
    u, v, point = (float(text) for text in lines[1].split()[:3])
    assert (u, v) == pytest.approx(first.keypoints_px[0] + 0.5, abs=1e-4)
    assert point == (first.landmarks[0] + 1 if first.landmarks[0] >= 0 else -1)


def test_a_binary_colmap_model_is_read(tmp_path: Path) -> None:
    camera = struct.pack("<QiiQQ4d", 1, 7, 2, 960, 720, 800.0, 480.5, 360.5, -0.01)
    q, t = Rotation.from_rotvec([0.1, -0.2, 0.3]), [1.0, 2.0, 3.0]
    x, y, z, w = q.as_quat()
    image = struct.pack("<i7di", 4, w, x, y, z, *t, 7) + b"a.jpg\0" + struct.pack("<Q2dq", 1, 5.0, 6.0, -1)
    (tmp_path / "cameras.bin").write_bytes(camera)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2) + image + image.replace(b"a.jpg", b"b.jpg"))
    model = read_model(tmp_path)
    assert model.camera == Camera(960, 720, 800.0, 800.0, 480.0, 360.0, -0.01)
    assert list(model.poses) == ["a.jpg", "b.jpg"]
    assert np.allclose(model.poses["b.jpg"].inverse().t_mm, t)
    assert np.allclose(model.poses["b.jpg"].R, q.as_matrix().T)
    for broken in (b"", camera[:20], camera.replace(struct.pack("<ii", 7, 2), struct.pack("<ii", 7, 5))):
        (tmp_path / "cameras.bin").write_bytes(broken)
        with pytest.raises(ConfigInvalid):
            read_model(tmp_path)


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(extra, "import_module", missing)
    with pytest.raises(ExtraMissing) as error:
        extra.opencv.__wrapped__()
    assert ".[guidance]" in error.value.text()
    assert ".[guidance]" in error.value.text("zh")
