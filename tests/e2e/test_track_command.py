"""`docking track`: own CSV, EuRoC and BROAD files, gaps, JSON, page, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from docking.cli import call
from docking.tracking.recording import Recording
from docking.tracking.types import BodyModel
from tests.unit.tracking.moving_body import record, section

KEYS = {"start_s", "length_s", "moving", "end_error_mm", "max_error_mm", "predicted_sd_mm", "hold_last_mm"}
EVERY = ["--occlude-every", "6:1"]


def _csv(path: Path, header: str, rows: object) -> str:
    path.write_text("\n".join([header, *(",".join(str(v) for v in row) for row in rows)]) + "\n")  # type: ignore[attr-defined]
    return str(path)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One waving body with four points, as CSV, EuRoC and BROAD files."""
    folder, body = tmp_path_factory.mktemp("recording"), section(points=4)
    r, _, _ = record(body, 6.5, "mems", 3)
    imu = np.column_stack([r.imu_t_s, r.force_m_s2, r.rate_rad_s])
    points = [
        [repr(t), name, *xyz.tolist()]
        for t, frame in zip(r.frame_t_s.tolist(), r.points_W_mm, strict=True)
        for name, xyz in zip(body.names, frame, strict=True)
    ]
    near = BodyModel("P", ("P",), np.array([[30.0, -20.0, 10.0]]))
    alone, _, _ = record(BodyModel("P", ("P",), np.zeros((1, 3))), 6.5, "mems", 4, true_body=near)
    nominal = [[name, *xyz] for name, xyz in zip(body.names, body.points_B_mm.tolist(), strict=True)]
    return {
        "imu": _csv(folder / "imu.csv", "t_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s", imu),
        "points": _csv(folder / "points.csv", "t_s,name,x_mm,y_mm,z_mm", points),
        "body": _csv(folder / "body.csv", "name,x_mm,y_mm,z_mm", nominal),
        "encoders": _csv(
            folder / "encoders.csv",
            "t_s,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg",
            _pose_rows(r.frame_t_s, r.points_W_mm[:, 0]),
        ),
        **_files_of_others(folder, alone),
    }


def _files_of_others(folder: Path, r: Recording) -> dict[str, str]:
    """A single point as EuRoC and BROAD write it."""
    q = Rotation.from_matrix(r.attitude_WB).as_quat()[:, [3, 0, 1, 2]]
    place = r.points_W_mm[:, 0] / 1000.0
    ns, imu_ns = ((t * 1e9).astype(np.int64) + 10**18 for t in (r.frame_t_s, r.imu_t_s))
    every = np.searchsorted(r.frame_t_s, r.imu_t_s).clip(max=len(place) - 1)
    data = {
        "imu_gyr": r.rate_rad_s,
        "imu_acc": r.force_m_s2,
        "opt_quat": q[every],
        "opt_pos": np.column_stack([np.interp(r.imu_t_s, r.frame_t_s, place[:, k]) for k in range(3)]),
        "movement": np.ones((len(every), 1), dtype=np.uint8),
        "sampling_rate": np.array([[200.0]]),
    }
    savemat(folder / "trial.mat", data)
    rates = ",".join(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz")
    forces = ",".join(f"a_RS_S_{axis} [m s^-2]" for axis in "xyz")
    places = ", ".join(f"p_RS_R_{axis} [m]" for axis in "xyz")
    turns = ", ".join(f"q_RS_{axis} []" for axis in "wxyz")
    imu_rows = zip(imu_ns, *r.rate_rad_s.T, *r.force_m_s2.T, strict=True)
    return {
        "euroc_imu": _csv(folder / "data.csv", f"#timestamp [ns],{rates},{forces}", imu_rows),
        "euroc_pose": _csv(folder / "pose.csv", f"#timestamp, {places}, {turns}", zip(ns, *place.T, *q.T, strict=True)),
        "broad": str(folder / "trial.mat"),
    }


def _pose_rows(t: np.ndarray, place: np.ndarray) -> list[list[float]]:  # type: ignore[type-arg]
    """Read-backs that follow one point with a shift and a scale of 1.001."""
    return [[float(k), *(1.001 * p + 4.0).tolist(), 0.0, 0.0, 0.0] for k, p in zip(t, place, strict=True)]


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    assert call(["track", *arguments, "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_several_points_by_own_files(files: dict[str, str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page = tmp_path / "track.html"
    got = answer(
        capsys, files["imu"], files["points"], files["body"], "--grade", "mems", "--occlude", "5:1", "--plot", str(page)
    )
    (gap,) = got["gaps"]  # type: ignore[misc]
    assert set(gap) == KEYS
    assert got["method"] == "ins"
    assert gap["moving"] is True
    assert gap["end_error_mm"] < 25.0 < gap["hold_last_mm"]
    assert got["median_end_error_mm"] == got["p90_end_error_mm"] == gap["end_error_mm"]
    text = page.read_text("utf-8")
    assert text.count("<svg") == 2
    assert "http://" not in text.replace("http://www.w3.org", "")


@pytest.mark.parametrize("method", ["published", "repaired", "ins", "ins-smoothed"])
@pytest.mark.parametrize("source", ["broad", "euroc"])
def test_files_of_others(files: dict[str, str], capsys: pytest.CaptureFixture[str], method: str, source: str) -> None:
    named = [files["broad"]] if source == "broad" else [files["euroc_imu"], files["euroc_pose"]]
    got = answer(capsys, *named, *EVERY, "--method", method, "--grade", "mems")
    assert got["method"] == method
    (gap,) = got["gaps"]  # type: ignore[misc]
    if method.startswith("ins"):
        assert gap["end_error_mm"] < 0.6 * gap["hold_last_mm"]


def test_encoders_and_auto(files: dict[str, str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rows = Path(files["points"]).read_text().splitlines()
    one = tmp_path / "one.csv"
    one.write_text("\n".join([rows[0], *(row for row in rows if ",T1," in row)]))
    got = answer(capsys, str(one), files["encoders"], *EVERY)
    assert got["method"] == "encoders"
    (gap,) = got["gaps"]  # type: ignore[misc]
    assert gap["end_error_mm"] < 5.0


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["{imu}"], 4021),
        (["{points}", "{body}"], 4004),
        (["{points}", "{imu}"], 4021),
        (["{imu}", "{imu}"], 4021),
        (["{broad}", "--occlude", "x:3"], 4004),
        (["{broad}", "--occlude", "99:3"], 4004),
        (["{broad}", "--occlude", "1:3", "--occlude", "2:1"], 4004),
        (["{broad}", "--occlude-every", "3:10"], 4004),
        (["{broad}", "--sigma-mm", "-1"], 4004),
        (["{broad}", "--method", "encoders"], 4004),
        (["/nowhere/trial.mat"], 4001),
        (["{bad}"], 4021),
        (["{junk}"], 4021),
        (["{one}", "{imu}", "--method", "ins"], 3058),
    ],
)
def test_what_is_refused_is_named(
    files: dict[str, str], capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], code: int
) -> None:
    bad, junk, one = tmp_path / "bad.csv", tmp_path / "junk.mat", tmp_path / "one.csv"
    bad.write_text("t_s,qw,qx,qy,qz\n0,1,0,zero,0\n")
    junk.write_bytes(b"no matlab file at all")
    one.write_text("t_s,name,x_mm,y_mm,z_mm\n" + "\n".join(f"{0.02 * k},P,1,2,3.{k}" for k in range(200)))
    named = [a.format(bad=bad, junk=junk, one=one, **files) for a in arguments]
    assert call(["track", *named, "--json"]) in (1, 2)
    assert json.loads(capsys.readouterr().out)["error"]["code"] == code
