"""The commands about markers and maps as a user types them, on a short video."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("cv2", reason="the extra guidance is not installed")

from docking.cli import call
from docking.guidance.images import pictures
from docking.guidance.map_files import load_map
from docking.guidance.opencv import opencv
from docking.guidance.trajectory import read_tum
from tests.support.shared_data import shared_data

SCENE = shared_data("ar_scene")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.6 s about the first three markers, 10 frames/s."""
    cv2 = opencv()
    path = tmp_path_factory.mktemp("video") / "scan.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (960, 720))
    for file in sorted((SCENE / "scan").iterdir())[20:36]:
        writer.write(cv2.imread(str(file)))
    writer.release()
    return path


def _build(video: Path, out: Path, *options: str) -> int:
    files = ["--camera", str(SCENE / "camera.toml"), "--markers", str(SCENE / "markers.csv"), "--out", str(out)]
    return call(["guide", "build-map", str(video), *files, *options])


def test_a_map_is_built_from_a_video_and_exported(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _build(video, tmp_path / "map", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    wanted = "keyframes points markers_used reset_keyframes scale marker_rms_mm reprojection_rms_px build_s optimise_s"
    assert set(wanted.split()) <= set(told)
    assert told["markers_used"] == [0, 1, 2]
    assert told["marker_rms_mm"] < 0.5
    ar_map = load_map(tmp_path / "map")
    assert (ar_map.frame, len(ar_map.keyframes)) == ("cell", told["keyframes"])
    assert ar_map.keyframes[0].name.startswith("scan-0000")
    assert call(["guide", "export", str(tmp_path / "map"), "--tum", str(tmp_path / "k.tum"), "--json"]) == 0
    assert len(read_tum(tmp_path / "k.tum")) == told["keyframes"]


def test_a_gate_that_nothing_passes_is_refused_and_one_that_resets_nothing_exits_with_3(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _build(video, tmp_path / "a", "--method", "published", "--gate", "100,15,4", "--json") == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == 3041
    assert not (tmp_path / "a").exists()
    # At 468 mm one marker alone passes in two key-frames: enough for a similarity, for a reset of none.
    assert _build(video, tmp_path / "b", "--method", "published", "--gate", "468,15,4") == 3
    assert "similarity only" in capsys.readouterr().out
    assert load_map(tmp_path / "b").quality.reset_keyframes == ()


def test_what_is_no_scan_and_no_gate_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "not.mp4").write_bytes(b"nothing")
    assert _build(tmp_path / "not.mp4", tmp_path / "map", "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == 4001
    assert _build(tmp_path, tmp_path / "map", "--json") == 2
    assert _build(tmp_path, tmp_path / "map", "--gate", "near", "--json") == 2
    assert call(["guide", "export", str(tmp_path), "--json"]) == 2


def test_a_video_that_was_cut_off_is_refused_and_not_taken_for_a_short_one(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = video.read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) // 2])
    assert _build(tmp_path / "cut.avi", tmp_path / "map", "--json") == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == 4001
    assert "of 16 pictures" in error["message"]
    assert not (tmp_path / "map").exists()


def test_a_folder_without_a_map_names_the_file_that_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(["guide", "export", str(tmp_path), "--tum", str(tmp_path / "k.tum"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["where"] == str(tmp_path / "map.json")


def test_markers_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["guide", "markers", "--out", str(tmp_path / "m.pdf"), "--ids", "0-2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"files": [str(tmp_path / "m.pdf")], "markers": [0, 1, 2]}
    assert (tmp_path / "m.pdf").read_bytes().startswith(b"%PDF")


def test_pictures_of_a_video_carry_its_times(video: Path) -> None:
    times = [picture.t_s for picture in pictures(video)]
    assert times == pytest.approx([0.1 * k for k in range(16)])
