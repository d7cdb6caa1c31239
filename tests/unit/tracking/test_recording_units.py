"""Recordings in other units than their headers say, or on two clocks: refused, with what was found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from docking.errors import BadArgument, BadRecording
from docking.recordings import read_recording
from docking.track_report import gaps_of
from docking.tracking.follow import FollowSettings, follow
from docking.types import Array

IMU = "t_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s"
NOMINAL = np.array([[10.0, 20.0, 30.0], [900.0, 0.0, 0.0], [0.0, 700.0, 0.0]])


def files(folder: Path, imu: Array, points_mm: Array = NOMINAL) -> list[Path]:
    """A body of three points at rest for 2 s, and the inertial samples."""
    paths = [folder / name for name in ("imu.csv", "points.csv", "part.csv")]
    np.savetxt(paths[0], imu, delimiter=",", header=IMU, comments="")
    rows = [f"{t:.2f},P{k},{x},{y},{z}" for t in np.arange(0, 2, 0.1) for k, (x, y, z) in enumerate(points_mm)]
    paths[1].write_text("\n".join(["t_s,name,x_mm,y_mm,z_mm", *rows]))
    nominal = [f"P{k},{x},{y},{z}" for k, (x, y, z) in enumerate(NOMINAL)]
    paths[2].write_text("\n".join(["name,x_mm,y_mm,z_mm", *nominal]))
    return paths


def samples() -> Array:
    t = np.arange(0.0, 2.0, 0.01)
    return np.column_stack([t, np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], (len(t), 1))])


def test_right_units_are_read(tmp_path: Path) -> None:
    assert len(read_recording(files(tmp_path, samples())).frame_t_s) == 20


@pytest.mark.parametrize(
    ("column", "factor", "said"),
    [(3, 1 / 9.81, "with gravity"), (3, 0.0, "gravity"), (0, 1000.0, "times are in s")],
)
def test_other_units_are_refused(tmp_path: Path, column: int, factor: float, said: str) -> None:
    imu = samples()
    imu[:, column] *= factor
    with pytest.raises(BadRecording, match=said):
        read_recording(files(tmp_path, imu))


def test_rates_in_degrees_and_another_clock_and_metres_are_refused(tmp_path: Path) -> None:
    fast, elsewhere = samples(), samples()
    fast[:, 4] = 20.0
    elsewhere[:, 0] += 1e6
    for imu, said in ((fast, "rad/s"), (elsewhere, "one clock")):
        with pytest.raises(BadRecording, match=said):
            read_recording(files(tmp_path, imu))
    with pytest.raises(BadRecording, match="span"):
        read_recording(files(tmp_path, samples(), NOMINAL / 1000.0))


def test_a_gap_that_the_recording_does_not_hold_is_refused(tmp_path: Path) -> None:
    recording = read_recording(files(tmp_path, samples()))
    assert len(gaps_of(recording, {"occlude": ("0.5:1",)})) == 1
    with pytest.raises(BadArgument):
        gaps_of(recording, {"occlude": ("1.5:1",)})


def test_frames_without_a_point_or_in_other_units_of_time_and_read_backs_of_another_clock_are_refused(
    tmp_path: Path,
) -> None:
    with pytest.raises(BadRecording, match="no frame shows a point"):
        read_recording(files(tmp_path, samples(), np.zeros((3, 3))))
    paths = files(tmp_path, samples())
    rows = paths[1].read_text().splitlines()
    later = [f"{1e5 * float(t)},{rest}" for t, _, rest in (row.partition(",") for row in rows[1:])]
    paths[1].write_text("\n".join([rows[0], *later]))
    with pytest.raises(BadRecording, match="times are in s"):
        read_recording(paths)
    paths = files(tmp_path, samples())
    encoders = tmp_path / "encoders.csv"
    encoders.write_text("t_s,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n700,0,0,0,0,0,0\n700.1,0,0,0,0,0,0\n")
    with pytest.raises(BadRecording, match="one clock"):
        read_recording([*paths, encoders])


@pytest.mark.parametrize("turned", [(0.0, 0.0, -9.81), (9.81, 0.0, 0.0)])
def test_a_specific_force_that_does_not_point_up_is_refused(tmp_path: Path, turned: tuple[float, ...]) -> None:
    imu = samples()
    settings = FollowSettings("repaired", time_offset=False)
    imu[:, 1:] += np.random.default_rng(1).normal(0.0, 0.01, (len(imu), 6))
    assert follow(read_recording(files(tmp_path, imu)), [], settings).alarms == []
    imu[:, 1:4] += np.array(turned) - [0.0, 0.0, 9.81]
    with pytest.raises(BadArgument, match="does not point up"):
        follow(read_recording(files(tmp_path, imu)), [], settings)
