"""A job made of the surveyed coordinates of a real barrel (clas12_svt) docks in the laboratory cell."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.assemble import RunRequest, dry_run
from tests.support.shared_data import shared_data

ROOT = Path(__file__).parents[2]
SURVEY = shared_data("clas12_svt", "survey_measured_reformat.dat")
CELL = ROOT / "sim" / "cells" / "lab-can.toml"
LAB_JOB = ROOT / "sim" / "cells" / "lab-can.job.toml"


def barrel() -> dict[str, tuple[float, float, float]]:
    """Surveyed fiducials in a component frame whose X is the barrel's axis: x = z, y = x, z = y."""
    rows = [line.split() for line in SURVEY.read_text("utf-8").splitlines()]
    return {r[0]: (float(r[3]), float(r[1]), float(r[2])) for r in rows if len(r) == 4}


def spread(names: list[str], points: dict[str, tuple[float, float, float]], count: int) -> list[str]:
    """Farthest-point choice, so that the targets hold the pose."""
    xyz = np.array([points[n] for n in names])
    chosen = [0]
    while len(chosen) < count:
        gaps = np.min(np.linalg.norm(xyz[:, None] - xyz[chosen], axis=2), axis=1)
        chosen.append(int(np.argmax(gaps)))
    return [names[i] for i in chosen]


def written(value: Any) -> str:
    """Plain TOML of nested dictionaries and lists, inline below the top level."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {written(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(written(v) for v in value) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    return repr(value)


def barrel_job() -> dict[str, Any]:
    points = barrel()
    face_x = max(p[0] for p in points.values())
    face = sorted(n for n, p in points.items() if p[0] > face_x - 2.0)
    features = spread(face, points, 4)
    rest = [n for n in sorted(points) if n not in face]
    targets = spread(rest, points, 12)
    checks = spread([n for n in rest if n not in targets], points, 4)
    job = tomllib.loads(LAB_JOB.read_text("utf-8"))
    job["part_number"] = "SVT-BARREL"
    job["mate"]["pose"][0] = face_x
    part = job["component"]
    part["docking_face_mm"] = [face_x, 0.0, 0.0]

    def nest(name: str) -> dict[str, Any]:
        return {"name": name, "xyz_mm": list(points[name]), "sigma_mm": 0.005}

    part["targets"], part["check_points"] = [nest(n) for n in targets], [nest(n) for n in checks]
    part["features"] = [
        {
            "name": n,
            "xyz_mm": list(points[n]),
            "mate_xyz_mm": [points[n][0] - face_x, points[n][1], points[n][2]],
            "sigma_mm": 0.005,
            "mate_sigma_mm": 0.005,
            "tolerance_mm": 0.1,
        }
        for n in features
    ]
    return job


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_job_of_real_coordinates_docks(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "barrel.job.toml"
    path.write_text("\n".join(f"{key} = {written(value)}" for key, value in barrel_job().items()) + "\n", "utf-8")
    summary = dry_run(RunRequest(CELL, path, seed, None, None, "en"), lambda text: None)
    assert summary["outcome"] == "docked", summary["alarms"]
    assert summary["true_max_feature_error_mm"] <= 0.1
    assert summary["max_feature_error_mm"] + 2.0 * summary["feature_sigma_mm"] <= 0.1
