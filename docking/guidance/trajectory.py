"""Trajectories of a camera in the cell, and how far one is from another: the absolute trajectory error (ATE).

Files are in the format of the TUM RGB-D set, one pose a line: `t_s x y z qx qy qz qw`, metres, camera in world, camera
axes x right, y down, z forward. Inside the program lengths are mm.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from docking.errors import BadTrajectory, DegenerateTrajectory, FileUnreadable, FileUnwritable
from docking.types import Array, Pose

Rows = NDArray[np.intp]
Alignment = Literal["none", "se3", "sim3"]
MM_PER_M = 1000.0
MAX_TIME_DIFFERENCE_S = 0.01
"""Largest difference of two time stamps that count as the same moment."""
_QUATERNION_SLACK = 1e-2


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses X_WK of a camera K: `t_s` (n,), rotations `R` (n, 3, 3), positions `t_mm` (n, 3)."""

    t_s: Array
    R: Array
    t_mm: Array

    def __len__(self) -> int:
        return len(self.t_s)

    @staticmethod
    def of(stamped: list[tuple[float, Pose]]) -> Trajectory:
        """The trajectory of poses X_WK with their times in s, put in the order of time."""
        stamped = sorted(stamped, key=lambda pair: pair[0])
        times = np.array([t_s for t_s, _ in stamped], dtype=np.float64)
        rotations = np.array([X.R for _, X in stamped], dtype=np.float64).reshape(-1, 3, 3)
        positions = np.array([X.t_mm for _, X in stamped], dtype=np.float64).reshape(-1, 3)
        return Trajectory(times, rotations, positions)

    def pose(self, k: int) -> Pose:
        """The k-th pose X_WK."""
        return Pose(self.R[k], self.t_mm[k])


@dataclass(frozen=True)
class TrajectoryError:
    """ATE of `localised` moments: distances of the positions in m; `frames` poses of the truth, `poses` judged.

    `scale` is that of the alignment (1 without).
    """

    align: Alignment
    ate_rmse_m: float
    median_m: float
    max_m: float
    frames: int
    poses: int
    localised: int
    scale: float


def read_tum(path: Path) -> Trajectory:
    """A trajectory file. Raises FileUnreadable, BadTrajectory naming the line."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise BadTrajectory(str(path), "not a text file", value=f"byte {error.start}") from error
    rows = [_numbers(path, k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not rows:
        raise BadTrajectory(str(path), "there is no pose in it", value="the file")
    table = np.array(sorted(rows))
    return Trajectory(table[:, 0], Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4] * MM_PER_M)


def _numbers(path: Path, number: int, line: str) -> list[float]:
    fields = line.replace(",", " ").split()
    try:
        values = [float(field) for field in fields]
    except ValueError:
        values = []
    if len(values) != 8 or not np.all(np.isfinite(values)):
        raise BadTrajectory(str(path), "eight finite numbers are needed", value=f"line {number}: {line[:60]!r}")
    if not abs(float(np.linalg.norm(values[4:])) - 1.0) <= _QUATERNION_SLACK:
        raise BadTrajectory(str(path), "the quaternion is not of length 1", value=f"line {number}")
    return values


def write_tum(trajectory: Trajectory, path: Path, comment: str = "t_s x_m y_m z_m qx qy qz qw: camera in cell") -> None:
    """Write a trajectory file; w of every quaternion is not negative. Raises FileUnwritable."""
    lines = [f"# {comment}"]
    for t_s, R, t_mm in zip(trajectory.t_s, trajectory.R, trajectory.t_mm, strict=True):
        quaternion = Rotation.from_matrix(R).as_quat(canonical=True)
        numbers = " ".join(f"{value:.9f}" for value in (*(t_mm / MM_PER_M), *quaternion))
        lines.append(f"{t_s:.6f} {numbers}")
    try:
        path.write_text("\n".join(lines) + "\n", "utf-8")
    except OSError as error:
        raise FileUnwritable(str(path), error.strerror or str(error)) from error


def same_moments(judged: Trajectory, truth: Trajectory) -> tuple[Rows, Rows]:
    """Rows of `judged` and of `truth` that belong together: for every pose of the shorter one, the nearest in time.

    Pairs further apart than MAX_TIME_DIFFERENCE_S are no pairs. The tool evo has the same rule.
    """
    swap = len(truth) > len(judged)
    short, long = (judged, truth) if swap else (truth, judged)
    nearest = _nearest(long.t_s, short.t_s)
    near = np.abs(long.t_s[nearest] - short.t_s) <= MAX_TIME_DIFFERENCE_S
    rows_short, rows_long = np.flatnonzero(near), nearest[near]
    return (rows_short, rows_long) if swap else (rows_long, rows_short)


def _nearest(sorted_s: Array, wanted_s: Array) -> Rows:
    """Index (m,) of the entry of `sorted_s` that is nearest to each of `wanted_s` (m,)."""
    right = np.clip(np.searchsorted(sorted_s, wanted_s), 1, max(1, len(sorted_s) - 1))
    right = np.minimum(right, len(sorted_s) - 1)
    left = np.maximum(right - 1, 0)
    result: Rows = np.where(np.abs(sorted_s[left] - wanted_s) <= np.abs(sorted_s[right] - wanted_s), left, right)
    return result


def trajectory_error(judged: Trajectory, truth: Trajectory, align: Alignment = "none") -> TrajectoryError:
    """ATE of `judged` against `truth`; `align` fits a rigid motion (se3) or a similarity (sim3) first.

    Raises DegenerateTrajectory when no moment is common, or too few for the alignment.
    """
    rows, truth_rows = same_moments(judged, truth)
    p, q = judged.t_mm[rows], truth.t_mm[truth_rows]
    if len(p) == 0:
        raise DegenerateTrajectory("trajectory", "no two time stamps agree", value=0, limit=1)
    if align != "none" and len(p) < 3:
        raise DegenerateTrajectory("trajectory", "too few common moments to align", value=len(p), limit=3)
    scale, R, t = (1.0, np.eye(3), np.zeros(3)) if align == "none" else _umeyama(p, q, with_scale=align == "sim3")
    error_m = np.linalg.norm(scale * p @ R.T + t - q, axis=1) / MM_PER_M
    rmse = float(np.sqrt(np.mean(error_m**2)))
    median, largest = float(np.median(error_m)), float(np.max(error_m))
    return TrajectoryError(align, rmse, median, largest, len(truth), len(judged), len(np.unique(truth_rows)), scale)


def _umeyama(p: Array, q: Array, *, with_scale: bool) -> tuple[float, Array, Array]:
    """Scale s, rotation R, shift t that minimise `sum |s R p + t - q|^2` (Umeyama 1991); p, q are (n, 3)."""
    p0, q0 = p.mean(axis=0), q.mean(axis=0)
    u, d, vt = np.linalg.svd((q - q0).T @ (p - p0) / len(p))
    if not d[1] > 1e-9 * d[0]:
        raise DegenerateTrajectory(
            "trajectory", "the path is a straight line and cannot be aligned", value=len(p), limit=3
        )
    signs = np.array([1.0, 1.0, 1.0 if np.linalg.det(u @ vt) > 0.0 else -1.0])
    R = (u * signs) @ vt
    scale = float(d @ signs / np.mean(np.sum((p - p0) ** 2, axis=1))) if with_scale else 1.0
    return scale, R, q0 - scale * R @ p0


def error_text(error: TrajectoryError) -> str:
    """The figures for a person, the alignment first."""
    how = {"none": "not aligned", "se3": "aligned (SE3)", "sim3": f"aligned (Sim3, scale {error.scale:.6f})"}[
        error.align
    ]
    return (
        f"{how}: ATE rmse {error.ate_rmse_m:.6f} m, median {error.median_m:.6f} m, max {error.max_m:.6f} m; "
        f"{error.localised} common moments of {error.poses} poses and {error.frames} true ones"
    )


def error_json(error: TrajectoryError) -> dict[str, Any]:
    """The figures as JSON; `ate_rmse_m`, `median` and `max` in m."""
    figures = asdict(error)
    figures["median"], figures["max"] = figures.pop("median_m"), figures.pop("max_m")
    return figures
