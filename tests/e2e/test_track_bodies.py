"""`docking track` on two bodies joined by a hinge: pose of each, relative pose, joint angle with its uncertainty."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.cli import call

BASE = {"b1": (0, 0, 0), "b2": (600, 0, 0), "b3": (0, 400, 0), "b4": (600, 400, 50), "b5": (300, 200, 200)}
ARM = {"a1": (700, 0, 0), "a2": (1100, 50, 0), "a3": (700, 300, 20), "a4": (1100, 300, 150), "a5": (900, 150, -80)}
HINGE = np.array([650.0, 0.0, 0.0])
SIGMA_MM = 0.05


def angle_deg(t: float) -> float:
    return 12.0 * float(np.sin(0.6 * t))


def write(folder: Path) -> list[str]:
    """Ten seconds at 20 Hz: the base drifts and turns, the arm turns about Y through the hinge besides."""
    rng = np.random.default_rng(3)
    points = ["t_s,name,x_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm"]
    encoders = ["t_s,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg"]
    for k in range(201):
        t = k / 20.0
        turn, shift = Rotation.from_euler("z", 3.0 * np.sin(0.2 * t), degrees=True), np.array([2.0 * t, 0.0, 1.0])
        hinge = Rotation.from_euler("y", angle_deg(t), degrees=True)
        encoders.append(f"{t},{shift[0]},0,1.0,0,0,{3.0 * np.sin(0.2 * t)}")
        for body in (BASE, ARM):
            for name, p in body.items():
                place = hinge.apply(np.array(p) - HINGE) + HINGE if body is ARM else np.array(p, dtype=float)
                seen = turn.apply(place) + shift + SIGMA_MM * rng.standard_normal(3)
                points.append(
                    f"{t},{name}," + ",".join(f"{v:.4f}" for v in seen) + f",{SIGMA_MM},{SIGMA_MM},{SIGMA_MM}"
                )
    nominal = {
        name: ["name,x_mm,y_mm,z_mm", *(f"{n},{x},{y},{z}" for n, (x, y, z) in body.items())]
        for name, body in (("base.csv", BASE), ("arm.csv", ARM))
    }
    files = {**nominal, "points.csv": points, "base.encoders.csv": encoders}
    for name, lines in files.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    return [str(folder / name) for name in files]


def test_the_angle_of_the_joint_is_found_with_an_honest_sd(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    files, page = write(tmp_path), tmp_path / "page.html"
    assert call(["track", *files, "--joint", "base:arm:0,1,0", "--occlude", "4:1", "--plot", str(page), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    base, arm = answer["bodies"]
    assert (base["name"], base["method"], arm["name"], arm["method"]) == ("base", "encoders", "arm", "image")
    assert len(base["t_s"]) == 201
    assert len(arm["t_s"]) == 181  # nothing bridges the gap of the arm
    (joint,) = answer["joints"]
    t, found, sd = (np.array(joint[key]) for key in ("t_s", "angle_deg", "angle_sd_deg"))
    assert len(t) == 181
    error = found - np.array([angle_deg(v) for v in t])
    assert np.abs(error).max() < 0.05
    assert 0.7 < np.sqrt(np.mean((error / sd) ** 2)) < 1.3
    assert np.max(joint["off_axis_deg"]) < 6.0 * np.max(joint["off_axis_sd_deg"])
    relative = np.array(joint["pose"])
    swung = Rotation.from_euler("y", angle_deg(t[50]), degrees=True)
    np.testing.assert_allclose(relative[50, :3], HINGE - swung.apply(HINGE), atol=0.5)
    assert "hinge base:arm" in page.read_text().lower()


def test_bodies_that_are_not_there_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write(tmp_path)
    assert call(["track", *files, "--joint", "base:leg:0,1,0"]) == 2
    assert "base, arm" in capsys.readouterr().err
    assert call(["track", *files, "--joint", "base:arm:0,0,0"]) == 2
    assert "AX,AY,AZ" in capsys.readouterr().err
    assert call(["track", *files]) == 0
    assert "nothing bridges" in capsys.readouterr().out
    text = (tmp_path / "arm.csv").read_text().replace("a5", "b5")
    (tmp_path / "arm.csv").write_text(text)
    assert call(["track", *files]) == 2
    assert "b5" in capsys.readouterr().err
