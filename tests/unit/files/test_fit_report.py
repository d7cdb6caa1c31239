"""`docking fit` as a function: the JSON object and the text."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docking.errors import BadArgument, ConfigError
from docking.fit_options import FitOptions
from docking.fit_report import fit_json, fit_text, run_fit
from docking.geometry import pose_from_vector
from docking.point_file import read_points

J = np.array(
    [[0, 0, 0.5], [3000, 100, 0], [2900, 1500, 200], [-100, 1600, 1000], [1500, 700, 1900], [200, 900, -800.0]]
)
VECTOR = [100.0, -200.0, 300.0, 1.0, -2.0, 30.0]
KEYS = {
    "pose", "rms_mm", "max_mm", "used", "rejected", "dropped_readings", "residuals_mm", "refused",
    "method", "covariance", "sigma", "chi2", "dof", "chi2_p", "redundancy", "scale", "swapped",
    "refused_code", "remedy", "locks_p",
}  # fmt: skip


def fit_files(nominal: Path, measured: Path, method: str = "ml") -> dict[str, Any]:
    return fit_json(run_fit(nominal, measured, FitOptions(method=method)))


def write(path: Path, names: str, xyz: np.ndarray) -> Path:
    rows = "".join(f"{n},{x:.9f},{y:.9f},{z:.9f}\n" for n, (x, y, z) in zip(names, xyz, strict=True))
    path.write_text("name,x_mm,y_mm,z_mm\n" + rows)
    return path


@pytest.mark.parametrize("method", ["ml", "svd", "three-point", "least-squares"])
def test_pose_takes_nominal_into_measured(tmp_path: Path, method: str) -> None:
    p = pose_from_vector(VECTOR).apply(J)
    result = fit_files(write(tmp_path / "n.csv", "ABCDEF", J), write(tmp_path / "m.csv", "FEDCBA", p[::-1]), method)
    pose = result["pose"]
    assert [pose[k] for k in ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")] == pytest.approx(VECTOR)
    assert np.allclose(np.array(pose["matrix"]) @ [*J[1], 1.0], [*p[1], 1.0], atol=1e-6)
    assert set(result) == KEYS
    assert result["used"] == list("ABCDEF")
    assert result["rms_mm"] < 1e-8
    assert result["refused"] is None
    json.dumps(result, allow_nan=False)


def test_residuals_are_measured_minus_fitted_passes_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    p = J + rng.normal(0, 0.1, (2, 6, 3))
    result = fit_files(
        write(tmp_path / "n.csv", "ABCDEF", J), write(tmp_path / "m.csv", "ABCDEF" * 2, p.reshape(-1, 3)), "svd"
    )
    fitted = J @ np.array(result["pose"]["matrix"])[:3, :3].T + np.array(result["pose"]["matrix"])[:3, 3]
    r = p.mean(axis=0) - fitted
    for name, row in zip("ABCDEF", r, strict=True):
        assert result["residuals_mm"][name] == pytest.approx(row, abs=1e-7)
    assert result["rms_mm"] == pytest.approx(np.sqrt(np.mean(np.sum(r**2, axis=1))))
    assert result["max_mm"] == pytest.approx(np.max(np.linalg.norm(r, axis=1)))


def test_rejected_and_unmatched_are_named(tmp_path: Path) -> None:
    p = J.copy()
    p[2] += [5.0, 0.0, 0.0]
    result = fit_files(write(tmp_path / "n.csv", "ABCDEF", J), write(tmp_path / "m.csv", "ABCDEX", p))
    assert {r["name"]: r["reason"] for r in result["rejected"]} == {
        "C": "mis-aimed",
        "F": "unmatched",
        "X": "unmatched",
    }
    assert result["used"] == ["A", "B", "D", "E"]
    text = fit_text(result)
    assert all(word in text for word in ("mis-aimed", "unmatched", "4 points used", "gamma"))


def test_a_refused_fit_says_why_and_keeps_the_json_shape(tmp_path: Path) -> None:
    result = fit_files(write(tmp_path / "n.csv", "ABCDEF", J), write(tmp_path / "m.csv", "ABCDEF", J * 1000))
    assert set(result) == KEYS
    assert result["pose"] is None
    assert "1000" in result["refused"]
    assert fit_text(result).startswith("no pose: ")
    json.dumps(result, allow_nan=False)
    result = fit_files(write(tmp_path / "n.csv", "ABCDEF", J), write(tmp_path / "m.csv", "ABUVWX", J))
    assert {r["reason"] for r in result["rejected"]} == {"unmatched"}
    assert len(result["rejected"]) == 8


def test_unknown_method(tmp_path: Path) -> None:
    n = write(tmp_path / "n.csv", "ABCDEF", J)
    with pytest.raises(BadArgument):
        fit_files(n, n, "magic")


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_by_name(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    for head in (b"", b"name,x_mm,y_mm,z_mm\n"):
        path.write_bytes(head + data)
        with suppress(ConfigError):
            assert np.all(np.isfinite(read_points(path, "measured").xyz_mm))
