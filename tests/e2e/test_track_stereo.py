"""`docking track` on the pixel tracks of a camera pair: what is lost in one camera is occluded and bridged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from docking.cli import call
from docking.recordings import read_recording
from docking.types import Array

PLACES = {"left": (-900.0, -3000.0, 0.0), "right": (900.0, -3000.0, 0.0)}
POINTS = np.array([[0, 0, 0], [400, -200, 150], [-400, 100, -120], [120, 150, 80], [300, 0, -200.0]], dtype=float)
NAMES = ("P1", "P2", "P3", "P4", "P5")
FOCAL, CENTRE = 1500.0, (960.0, 600.0)


def pixel(camera: str, p_W: Array) -> tuple[float, float]:
    """Both look along +Y of W: x right is X, y down is -Z."""
    x, y, z = p_W - np.array(PLACES[camera])
    return CENTRE[0] + FOCAL * x / y, CENTRE[1] - FOCAL * z / y


def write(folder: Path, hidden: tuple[float, float]) -> list[str]:
    """Ten seconds of a straight move of 40 mm; the right camera loses all points for a while."""
    rng = np.random.default_rng(8)
    for name, (x, y, z) in PLACES.items():
        (folder / f"{name}.toml").write_text(
            f"width_px = 1920\nheight_px = 1200\nfx_px = {FOCAL}\nfy_px = {FOCAL}\ncx_px = {CENTRE[0]}\n"
            f"cy_px = {CENTRE[1]}\npixel_sigma = 0.1\npose = [{x}, {y}, {z}, -90.0, 0.0, 0.0]\n"
        )
    tracks, encoders = ["t_s,camera,name,u_px,v_px"], ["t_s,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg"]
    for k in range(501):
        t = k / 50.0
        x = 20.0 * (1.0 - np.cos(np.pi * t / 10.0))
        encoders.append(f"{t:.3f},{1.0005 * x + 0.01 * rng.standard_normal():.4f},0,0,0,0,0")
        for camera in PLACES if k % 2 == 0 else ():
            for name, point in zip(NAMES, POINTS, strict=True):
                u, v = np.array(pixel(camera, np.add(point, (x, 0.0, 0.0)))) + 0.1 * rng.standard_normal(2)
                lost = camera == "right" and hidden[0] <= t < sum(hidden)
                tracks.append(f"{t:.3f},{camera},{name}," + ("nan,nan" if lost else f"{u:.3f},{v:.3f}"))
    nominal = ["name,x_mm,y_mm,z_mm", *(f"{n},{x},{y},{z}" for n, (x, y, z) in zip(NAMES, POINTS, strict=True))]
    files = {"tracks.csv": tracks, "encoders.csv": encoders, "part.csv": nominal}
    for name, lines in files.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    return [str(folder / name) for name in ("left.toml", "right.toml", *files)]


def test_points_lost_in_one_camera_are_bridged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write(tmp_path, (4.0, 2.0))
    assert call(["track", *files, "--occlude", "7:2", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["method"] == "encoders"
    (gap,) = answer["gaps"]
    assert gap["hold_last_mm"] > 4.0
    # Against recorded points that themselves have 0.5 mm along the view; it is the worst of five that counts.
    assert gap["end_error_mm"] < 1.6
    recording = read_recording([Path(f) for f in files])
    seen = recording.seen().all(axis=1)
    assert not seen[(recording.frame_t_s >= 4.0) & (recording.frame_t_s < 6.0)].any()
    assert seen[recording.frame_t_s < 4.0].all()
    cov = recording.cov_of(0)[0]
    assert np.sqrt(cov[1, 1]) > 2.0 * np.sqrt(cov[0, 0])  # along the view
    assert recording.points_W_mm[0, 0, 1] == pytest.approx(0.0, abs=4.0 * float(np.sqrt(cov[1, 1])))
    assert recording.points_W_mm[0, 1, 2] == pytest.approx(150.0, abs=1.0)


def test_a_camera_without_its_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write(tmp_path, (0.0, 0.0))
    assert call(["track", *files[:1], *files[2:]]) == 2
    assert "two cameras" in capsys.readouterr().err
    (tmp_path / "other.toml").write_text((tmp_path / "right.toml").read_text())
    assert call(["track", files[0], str(tmp_path / "other.toml"), *files[2:]]) == 2
    assert "right" in capsys.readouterr().err
    (tmp_path / "other.toml").write_text("fx_px = -1\n")
    assert call(["track", *files, str(tmp_path / "other.toml")]) == 2
    assert "pose" in capsys.readouterr().err
