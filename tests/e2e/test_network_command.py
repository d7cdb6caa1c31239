"""`docking network`: point files in, stations and points out; one bad reading named, a wrong call refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.cli import call
from docking.geometry import euler_to_matrix, pose_from_vector
from docking.pose import LASER_TRACKER
from docking.records import POSE_KEYS
from docking.types import Array, Pose

SPOTS = np.array(
    [
        [-6000, -5000, 0], [6000, -5000, 300], [7000, 4000, 0], [-7000, 4000, 900], [0, 6000, 1500],
        [-4000, 0, 2000], [4000, 300, 2200], [0, 0, 100], [2000, -1500, 1000],
    ],
    dtype=float,
)  # fmt: skip
EAST = Pose(euler_to_matrix(0.01, -0.02, 2.1), np.array([500.0, -9000.0, 800.0]))
WEST = Pose(euler_to_matrix(-0.02, 0.01, -1.0), np.array([-800.0, 8000.0, 1500.0]))


def csv(path: Path, xyz: Array, first: int = 1, sigma_mm: float | None = None) -> Path:
    tail = "" if sigma_mm is None else "," + ",".join([str(sigma_mm)] * 3)
    head = "name,x_mm,y_mm,z_mm" + ("" if sigma_mm is None else ",sx_mm,sy_mm,sz_mm")
    rows = [f"P{i + first},{x:.6f},{y:.6f},{z:.6f}{tail}" for i, (x, y, z) in enumerate(xyz)]
    path.write_text("\n".join([head, *rows]) + "\n", "utf-8")
    return path


def readings(station: Pose, seed: int) -> Array:
    at = station.inverse().apply(SPOTS)
    root = np.linalg.cholesky(LASER_TRACKER.covariance(at))
    return np.asarray(at + np.einsum("nij,nj->ni", root, np.random.default_rng(seed).normal(size=at.shape)))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return {
        "ers": csv(tmp_path / "ers.csv", SPOTS[:5], sigma_mm=0.01),
        "east": csv(tmp_path / "east.csv", readings(EAST, 1)),
        "west": csv(tmp_path / "west.csv", readings(WEST, 2)),
    }


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    code = call(["network", *map(str, arguments), "--json"])
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    return code, json.loads(out)


def test_two_stations_in_the_frame_of_the_references(
    capsys: pytest.CaptureFixture[str], files: dict[str, Path]
) -> None:
    code, found = told(capsys, files["east"], files["west"], "--ers", files["ers"])
    assert (code, found["consistent"], found["rejected"]) == (0, True, [])
    for station, true in zip(found["stations"], (EAST, WEST), strict=True):
        X = pose_from_vector([station["pose"][key] for key in POSE_KEYS])
        assert np.allclose(X.matrix(), station["matrix"], atol=1e-9)
        assert np.max(np.abs(X.apply(true.inverse().apply(SPOTS)) - SPOTS)) < 0.1
        assert station["used"] == 9
        assert 0.001 < station["sigma"]["x_mm"] < 0.03
    assert np.array(found["covariance"]).shape == (12, 12)
    assert found["dof"] == 3 * (5 + 9 + 9) - 12 - 27
    assert {p["views"] for p in found["points"]} == {2, 3}
    for point in found["points"]:
        assert np.max(np.abs(np.array(point["xyz_mm"]) - SPOTS[int(point["name"][1:]) - 1])) < 0.1


def test_without_references_the_first_station_is_the_frame(
    capsys: pytest.CaptureFixture[str], files: dict[str, Path]
) -> None:
    _, found = told(capsys, files["east"], files["west"])
    first, second = found["stations"]
    assert first["pose"] == {**first["pose"], "x_mm": 0.0, "alpha_deg": 0.0}
    assert set(first["sigma"].values()) == {0.0}
    expected = EAST.inverse() @ WEST
    assert np.allclose(np.array(second["matrix"])[:3, 3], expected.t_mm, atol=0.5)


def test_the_noise_may_be_told(capsys: pytest.CaptureFixture[str], files: dict[str, Path]) -> None:
    both = files["east"], files["west"]
    _, fine = told(capsys, *both, "--noise", "iso:0.05")
    _, coarse = told(capsys, *both, "--noise", "iso:0.1")
    ratio = coarse["stations"][1]["sigma"]["x_mm"] / fine["stations"][1]["sigma"]["x_mm"]
    assert ratio == pytest.approx(2.0, rel=1e-3)
    code, tiny = told(capsys, *both, "--noise", "iso:0.008")
    assert (code, tiny["error"]["code"]) == (1, 3003)


def test_a_bad_reading_is_named_for_a_person_and_a_page_is_written(
    capsys: pytest.CaptureFixture[str], files: dict[str, Path], tmp_path: Path
) -> None:
    xyz = readings(WEST, 2)
    xyz[2] += [0.0, 0.0, 1.5]
    page = tmp_path / "network.html"
    west = csv(files["west"], xyz)
    assert call(["network", str(files["east"]), str(west), "--ers", str(files["ers"]), "--report", str(page)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"west: P3\s+mis-aimed\s+1\.[45]", out)
    html = page.read_text("utf-8")
    assert html.count("<svg") == 1
    assert "west: P3" in html
    assert "http" not in html


def test_stations_without_common_points_exit_with_1(capsys: pytest.CaptureFixture[str], files: dict[str, Path]) -> None:
    west = csv(files["west"], readings(WEST, 2), first=20)
    code, found = told(capsys, files["east"], west)
    assert (code, found["error"]["code"], found["error"]["where"]) == (1, 3001, "west")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--noise", "iso:0"], "iso:0"),
        (["--noise", "iso:nan"], "iso:nan"),
        (["--noise", "tracker:1,2"], "tracker:1,2"),
        (["--noise", "laser"], "laser"),
        (["--ers", "/nowhere/ers.csv"], "/nowhere/ers.csv"),
        (["--report", "/nowhere/network.html"], "/nowhere/network.html"),
    ],
)
def test_a_wrong_call_is_named(
    capsys: pytest.CaptureFixture[str], files: dict[str, Path], arguments: list[str], said: str
) -> None:
    code, found = told(capsys, files["east"], files["west"], *arguments)
    assert code == 2
    assert said in found["error"]["message"]


def test_stations_of_one_name_and_references_without_sigmas_are_refused(
    capsys: pytest.CaptureFixture[str], files: dict[str, Path], tmp_path: Path
) -> None:
    code, found = told(capsys, files["east"], files["east"])
    assert (code, found["error"]["code"]) == (2, 4004)
    assert "east" in found["error"]["message"]
    bare = csv(tmp_path / "bare.csv", SPOTS[:5])
    code, found = told(capsys, files["east"], "--ers", bare)
    assert (code, found["error"]["code"]) == (1, 3012)
    assert told(capsys)[0] == 2
