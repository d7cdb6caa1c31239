"""`docking fit`: two point files in, one JSON object or a page of text out."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import Any, cast

from docking.errors import BadArgument, PoseError
from docking.geometry import matrix_to_euler
from docking.point_file import read_points
from docking.pose import METHODS, FitSettings, Method, fit_pose, screen
from docking.types import Fit, Pose, Rejection


def _pose_json(X: Pose) -> dict[str, Any]:
    """The pose X_MN as [Luo]'s angles in degrees, mm and a 4x4 matrix (list of rows)."""
    e = matrix_to_euler(X.R)
    x, y, z = (float(v) for v in X.t_mm)
    return {
        "alpha_deg": degrees(e.alpha_rad),
        "beta_deg": degrees(e.beta_rad),
        "gamma_deg": degrees(e.gamma_rad),
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "matrix": [[float(v) for v in row] for row in X.matrix()],
    }


def _rejected_json(rejected: tuple[Rejection, ...]) -> list[dict[str, str]]:
    return [{"name": r.name, "reason": r.reason, "detail": r.detail} for r in rejected]


def _fitted(fit: Fit, dropped: tuple[Rejection, ...]) -> dict[str, Any]:
    residuals = {n: [float(v) for v in r] for n, r in zip(fit.names, fit.residuals_mm, strict=True)}
    return {
        "pose": _pose_json(fit.X_MN),
        "rms_mm": fit.rms_mm,
        "max_mm": fit.max_mm,
        "used": list(fit.names),
        "rejected": _rejected_json(fit.rejected),
        "dropped_readings": _rejected_json(dropped),
        "residuals_mm": residuals,
        "refused": None,
    }


def _refused(error: PoseError) -> dict[str, Any]:
    return {
        "pose": None,
        "rms_mm": None,
        "max_mm": None,
        "used": [],
        "rejected": _rejected_json(error.rejected),
        "dropped_readings": [],
        "residuals_mm": {},
        "refused": error.text(),
    }


def fit_files(nominal_path: str | Path, measured_path: str | Path, method: str = "ml") -> dict[str, Any]:
    """Screen and fit MEASURED to NOMINAL; the JSON object of `docking fit`.

    `pose` is X_MN (nominal into measured coordinates); `residuals_mm` measured minus fitted, passes averaged;
    `used` and `rejected` name the points; `dropped_readings` are single passes left out of a used point; `refused`
    is the reason why no pose is given, else null. Raises FileUnreadable, BadPointFile, BadArgument.
    """
    if method not in METHODS:
        raise BadArgument("--method", f"choose one of {', '.join(METHODS)}", value=method)
    nominal = read_points(Path(nominal_path), "nominal")
    measured = read_points(Path(measured_path), "measured")
    settings = FitSettings(method=cast(Method, method), where="fit")
    try:
        screened = screen(nominal, measured, settings)
        return _fitted(fit_pose(screened, settings), screened.dropped)
    except PoseError as error:
        return _refused(error)


def _rejected_lines(title: str, rejected: list[dict[str, str]]) -> list[str]:
    lines = [f"{title}: {len(rejected)}"] if rejected else []
    return lines + [f"  {r['name']:<16} {r['reason']:<16} {r['detail']}" for r in rejected]


def fit_text(result: dict[str, Any]) -> str:
    """The result of `fit_files` for a person."""
    tail = _rejected_lines("rejected points", result["rejected"])
    tail += _rejected_lines("readings left out", result["dropped_readings"])
    if result["refused"] is not None:
        return "\n".join([f"no pose: {result['refused']}", *tail])
    pose = result["pose"]
    lines = [
        "pose of the nominal in the measured frame, R = Rz(gamma) Ry(beta) Rx(alpha)",
        f"  x {pose['x_mm']:.4f}  y {pose['y_mm']:.4f}  z {pose['z_mm']:.4f} mm",
        f"  alpha {pose['alpha_deg']:.6f}  beta {pose['beta_deg']:.6f}  gamma {pose['gamma_deg']:.6f} deg",
        f"{len(result['used'])} points used, residuals: rms {result['rms_mm']:.4f}, largest {result['max_mm']:.4f} mm",
    ]
    for name, r in result["residuals_mm"].items():
        lines.append(f"  {name:<16} {r[0]:+.4f} {r[1]:+.4f} {r[2]:+.4f} mm")
    return "\n".join([*lines, *tail])
