"""From a run's journal to the operator's picture: the commands, on a rendered picture of the laboratory cell."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

import sim
from docking.cli import call
from docking.guidance import opencv as opencv_module
from docking.guidance.map_files import save_map
from docking.guidance.trajectory import Trajectory, write_tum
from docking.guide_scene import Source, build_scene, open_source
from docking.journal import verify
from docking.types import Pose
from sim.camera import SimulatedCamera
from sim.scenery import looking
from tests.support.guided_cell import LENS, UP, guided_cell, picture, view, with_component

CELLS = Path(sim.__file__).parent / "cells"
INSTRUCTIONS = """
[[instructions]]
name = "fit-bracket"
order = 1
text_en = "Fit the bracket"
text_zh = "安装支架"
tool = "torque wrench 12 Nm"
frame = "component"
pose = [300.0, 0.0, 170.0, 0.0, 0.0, 0.0]
mesh = "bracket.stl"

[[instructions]]
name = "check-gap"
order = 2
text_en = "Check the gap"
text_zh = "检查间隙"
frame = "cell"
pose = [500.0, 0.0, 1000.0, 0.0, 0.0, 0.0]
"""
BRACKET = """solid bracket
facet normal 0 0 1 outer loop vertex 0 0 0 vertex 80 0 0 vertex 0 80 0 endloop endfacet
facet normal 0 1 0 outer loop vertex 0 0 0 vertex 80 0 0 vertex 0 0 60 endloop endfacet
endsolid bracket
"""


class Bench(NamedTuple):
    """Files of one dry run with instructions, a map and a picture."""

    folder: Path
    journal: Path
    ar_map: Path
    photo: Path


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("guide")
    for name in ("lab-can.toml", "lab-can.job.toml", "lab-can.sim.toml"):
        shutil.copy(CELLS / name, folder / name)
    (folder / "bracket.stl").write_text(BRACKET)
    job = folder / "lab-can.job.toml"
    job.write_text(job.read_text("utf-8") + INSTRUCTIONS, "utf-8")
    journal = folder / "run.jsonl"
    assert call(["dry-run", str(folder / "lab-can.toml"), "--journal", str(journal), "--json"]) == 0
    save_map(guided_cell().ar_map, folder / "map")
    source = open_source(journal, None)
    fit = source.last("fit", what="component")
    assert fit is not None
    X_WC = np.array(fit["body"]["X"])
    scenery = with_component(Pose(X_WC[:3, :3], X_WC[:3, 3]), np.array([900.0, 500.0, 340.0]))
    eye = looking(np.array([400.0, 200.0, 1050.0]), np.array([700.0, -900.0, 1500.0]), 2.0, UP)
    cv2.imwrite(str(folder / "photo.png"), SimulatedCamera(scenery.patches, LENS, 7).picture(eye))
    return Bench(folder, journal, folder / "map", folder / "photo.png")


def until(bench: Bench, kind: str, stage: str = "") -> Source:
    """The journal as it was when the first record of a kind (and stage) had been written."""
    whole = open_source(bench.journal, None)
    last = next(r["seq"] for r in whole.records if r["kind"] == kind and stage in ("", r["body"].get("stage")))
    return Source(whole.records[: last + 1], whole.job, whole.job_path)


def test_overlay_draws_the_state_of_the_run(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOCKING_LANGUAGE", "en")
    out = tmp_path / "seen.png"
    command = ["guide", "overlay", str(bench.ar_map), str(bench.photo), "--journal", str(bench.journal)]
    assert call([*command, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["drawn"] == 1
    assert said["poses"][0]["source"] == "map"
    assert said["poses"][0]["predicted_error_mm"] < 10.0
    drawn, before = cv2.imread(str(out)), cv2.imread(str(bench.photo))
    assert np.mean(np.any(drawn != before, axis=2)) > 0.02
    assert call([*command, "--out", str(tmp_path / "none.png"), "--limit-mm", "0.5", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == 3032
    assert not (tmp_path / "none.png").exists()


def test_a_video_carries_the_refusal_of_what_is_not_localised(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    shutil.copy(bench.photo, folder / "0.png")
    cv2.imwrite(str(folder / "1.png"), np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8))
    out = tmp_path / "seen.mp4"
    command = ["guide", "overlay", str(bench.ar_map), str(folder), "--journal", str(bench.journal), "--out", str(out)]
    assert call([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["frames"], said["drawn"]) == (2, 1)
    assert out.stat().st_size > 1000


def test_a_video_keeps_its_speed(bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (640, 480))
    for _ in range(2):
        writer.write(cv2.imread(str(bench.photo)))
    writer.release()
    out = tmp_path / "seen.avi"
    command = ["guide", "overlay", str(bench.ar_map), str(tmp_path / "walk.avi"), "--journal", str(bench.journal)]
    assert call([*command, "--out", str(out), "--json"]) == 0
    seen = cv2.VideoCapture(str(out))
    assert seen.get(cv2.CAP_PROP_FPS) == pytest.approx(25.0)
    assert call([*command, "--out", str(tmp_path / "walk.avi"), "--json"]) == 2
    assert call([*command, "--out", str(out), "--fps", "0", "--json"]) == 2
    capsys.readouterr()


def test_a_picture_of_another_place_is_refused_and_no_file_written(bench: Bench, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "x.png"), np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8))
    command = ["guide", "overlay", str(bench.ar_map), str(tmp_path / "x.png"), "--journal", str(bench.journal)]
    assert call([*command, "--out", str(tmp_path / "y.png"), "--json"]) == 1
    assert not (tmp_path / "y.png").exists()


def test_deviations_point_home_and_arrows_are_those_of_the_plan(bench: Bench) -> None:
    source = until(bench, "plan", "align")
    scene = build_scene(source, "en")
    features = [m for m in scene.marks if m.kind == "feature"]
    assert len(features) == 4
    assert f"Arrows of features are {features[0].magnified:g} times their length" in [text for text, _ in scene.head]
    assert all(m.tone == "bad" and "OUT OF" in m.words for m in features)
    fit, goal = source.last("fit", what="component"), source.last("goal")
    assert fit is not None
    assert goal is not None
    goal_t, now = np.array(goal["body"]["X_WC"]), np.array(fit["body"]["X"])
    for mark, ball in zip([m for m in scene.marks if m.kind == "move"], source.job.component.balls, strict=True):
        p = np.array([*ball.xyz_mm, 1.0])
        assert mark.vector_mm is not None
        # The plan of `align` ends before the goal, along the docking axis: across it the arrows lead home.
        assert np.allclose(mark.vector_mm[1:], ((goal_t - now) @ p)[1:3], atol=0.05)
    deviation = next(m for m in features if m.words.startswith("upper-right"))
    record = source.last("features")
    assert record is not None
    assert deviation.vector_mm is not None
    assert np.allclose(deviation.vector_mm, -np.array(record["body"]["error_mm"][0]))


def test_within_tolerance_is_green_and_says_so(bench: Bench) -> None:
    scene = build_scene(open_source(bench.journal, None), "en")
    assert all(m.tone in ("good", "close") for m in scene.marks if m.kind == "feature")
    rejected = [m for m in scene.marks if m.kind == "target" and m.tone == "bad"]
    assert all("left out" in m.words for m in rejected)


def test_after_a_move_that_did_not_end_the_component_is_not_drawn(bench: Bench) -> None:
    unknown = build_scene(until(bench, "intent"), "en")
    assert any("POSITION UNKNOWN" in text for text, _ in unknown.head)
    assert not any(m.kind == "feature" for m in unknown.marks)
    moved = build_scene(until(bench, "moved"), "en")
    plan = until(bench, "moved").last("plan")
    assert plan is not None
    assert any("not measured again" in text for text, _ in moved.head)


def test_the_age_is_said(bench: Bench) -> None:
    source = open_source(bench.journal, None)
    fit = source.last("fit", what="component")
    assert fit is not None
    taken = datetime.fromisoformat(fit["t_wall"])
    for later, words in (
        (timedelta(seconds=42), "42 s ago"),
        (timedelta(minutes=30), "30 min ago"),
        (timedelta(hours=5), "5.0 h"),
    ):
        assert any(words in text for text, _ in build_scene(source, "en", (taken + later).astimezone(UTC)).head)


def test_steps_are_ticked_off_in_order_and_journaled(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOCKING_LANGUAGE", "en")
    journal = tmp_path / "run.jsonl"
    shutil.copy(bench.journal, journal)
    before = verify(journal).count
    steps = ["guide", "steps", str(journal), "--json"]
    assert call([*steps, "--done", "check-gap", "--by", "A. Smith"]) == 2  # not the next one
    assert call([*steps, "--done", "fit-bracket"]) == 2  # nobody says so
    capsys.readouterr()
    assert call([*steps, "--done", "fit-bracket", "--by", "A. Smith"]) == 0
    assert [row["state"] for row in json.loads(capsys.readouterr().out)["steps"]] == ["done", "next"]
    assert verify(journal).count == before + 1
    scene = build_scene(open_source(journal, None), "zh")
    assert [part.tone for part in scene.parts] == ["good", "next"]
    assert scene.parts[0].mesh is not None
    assert any("检查间隙" in text for text, _ in scene.steps)
    assert call([*steps, "--undo", "check-gap", "--by", "A. Smith"]) == 2  # it is not done
    capsys.readouterr()
    assert call([*steps, "--undo", "fit-bracket", "--by", "A. Smith"]) == 0
    assert [row["state"] for row in json.loads(capsys.readouterr().out)["steps"]] == ["next", "later"]


def test_a_job_changed_since_the_run_is_refused(bench: Bench, tmp_path: Path) -> None:
    for name in ("lab-can.toml", "lab-can.job.toml"):
        shutil.copy(bench.folder / name, tmp_path / name)
    job = tmp_path / "lab-can.job.toml"
    job.write_text(job.read_text("utf-8") + "# later\n", "utf-8")
    assert call(["guide", "steps", str(bench.journal), "--job", str(job), "--json"]) == 2


def test_localise_and_evaluate_a_folder(bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk = [view(200.0 + 70.0 * k, 1000.0, 800.0, 20.0) for k in range(4)]
    (tmp_path / "walk").mkdir()
    for k, X in enumerate(walk):
        cv2.imwrite(str(tmp_path / "walk" / f"{k}.png"), picture(X, seed=k))
    write_tum(Trajectory.of([(k / 10.0, X) for k, X in enumerate(walk)]), tmp_path / "truth.tum")
    found = tmp_path / "found.tum"
    command = ["guide", "localise", str(bench.ar_map), str(tmp_path / "walk"), "--tum", str(found), "--source", "map"]
    assert call([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["sources"] == {"map": 4, "marker": 0}
    assert call(["guide", "evaluate", str(found), "--truth", str(tmp_path / "truth.tum"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["frames"], figures["localised"]) == (4, 4)
    assert figures["ate_rmse_m"] < 3e-3


def test_without_opencv_the_command_says_how_to_get_it(
    bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(opencv_module, "import_module", missing)
    opencv_module.opencv.cache_clear()
    try:
        assert call(["guide", "localise", str(bench.ar_map), str(bench.photo), "--json"]) == 2
    finally:
        opencv_module.opencv.cache_clear()
    assert "pip install" in json.dumps(json.loads(capsys.readouterr().out))
