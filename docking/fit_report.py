"""`docking fit`: two point files in, one JSON object or a page of text out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import PoseError
from docking.fit_options import FitOptions, expansion_from, prepared, settings_from
from docking.geometry import matrix_to_euler, skew
from docking.noise_spec import noise_known
from docking.point_file import read_points, read_weights
from docking.pose import FitSettings, fit_pose, screen
from docking.pose.locks import turning_axes
from docking.pose.quantiles import chi2_tail, fisher_tail
from docking.pose.snooping import SMALLEST_SIGMA_MM
from docking.types import Array, Fit, Points, Pose, Rejection, Screened

SIGMAS = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")
_DOUBTFUL = 1e-3
_EXPECTED = "as the sigmas let expect"
_TOO_SMALL = "less than the sigmas let expect: they may be stated too large, and what they hide is not seen"
_TOO_LARGE = "MORE THAN THE SIGMAS LET EXPECT: noise, locks or nominal are wrong, or the part is not rigid"
_EMPTY: dict[str, Any] = {
    "pose": None,
    "rms_mm": None,
    "max_mm": None,
    "used": [],
    "rejected": [],
    "dropped_readings": [],
    "residuals_mm": {},
    "refused": None,
    "refused_code": None,
    "remedy": None,
    "method": None,
    "covariance": None,
    "sigma": None,
    "chi2": None,
    "dof": None,
    "chi2_p": None,
    "locks_p": None,
    "redundancy": None,
    "scale": None,
    "swapped": {},
}


@dataclass(frozen=True, eq=False)
class FitResult:
    """What came of one `docking fit`: the fit and its points, or the refusal. `given` is the stated expansion,
    `sigmas_known` whether every point's covariance was stated, `free` the fit with nothing held where locks were asked.
    """

    nominal: Points
    fit: Fit | None
    screened: Screened | None
    refusal: PoseError | None
    given: float
    sigmas_known: bool
    free: Fit | None = None


def run_fit(nominal_path: str | Path, measured_path: str | Path, options: FitOptions | None = None) -> FitResult:
    """Screen and fit MEASURED to NOMINAL. Raises FileUnreadable, BadPointFile, BadArgument."""
    options = FitOptions() if options is None else options
    nominal = read_points(Path(nominal_path), "nominal", weighted=True)
    measured = read_points(Path(measured_path), "measured", weighted=True)
    written = {**read_weights(Path(nominal_path)), **read_weights(Path(measured_path))}
    settings = settings_from(options, nominal, measured, written)
    nominal, measured = prepared(options, nominal, measured)
    known = bool(np.all(np.isfinite(nominal.cov_mm2))) and noise_known(measured)
    given = expansion_from(options.temperature)
    try:
        screened = screen(nominal, measured, settings)
        fit, free = _fits(screened, settings, known)
        return FitResult(nominal, fit, screened, None, given, known, free if settings.locks else None)
    except PoseError as refusal:
        return FitResult(nominal, None, None, refusal, given, known)


def _fits(screened: Screened, settings: FitSettings, sigmas_known: bool) -> tuple[Fit, Fit]:
    """The fit as asked for, and the one with nothing held.

    Where the residuals tell the scale of the noise, weights are ratios: multiplied all by one number they say the same.
    The variance factor of the weighted fit, with nothing held, makes its covariance so.
    """
    fit = fit_pose(screened, settings)
    free = fit_pose(screened, replace(settings, locks=())) if settings.locks else fit
    if sigmas_known or not settings.weights or settings.method != "ml" or not (free.dof > 0):
        return fit, free
    weights = np.mean([dict(settings.weights).get(name, 1.0) for name in screened.names])
    variance = np.trace(screened.nominal_cov_mm2 + screened.measured_cov_mm2, axis1=1, axis2=2).mean() / 3.0
    # Exact points leave rounding, which is no scale.
    factor = max(free.chi2 / free.dof, float(weights * SMALLEST_SIGMA_MM**2 / variance))
    scaled, free = (replace(f, cov=factor * f.cov, chi2=f.chi2 / factor) for f in (fit, free))
    return scaled, free


def locks_p(result: FitResult) -> float | None:
    """Probability that held values which are true enlarge chi-square so much; None where nothing was held.

    By chi-square with as many degrees of freedom as are held where the sigmas were stated, else by F against the
    variance factor of the fit with nothing held, which is 1 but for exact points: there rounding is no evidence.
    """
    if result.fit is None or result.free is None:
        return None
    held, more = result.fit.dof - result.free.dof, max(result.fit.chi2 - result.free.chi2, 0.0)
    if result.sigmas_known:
        return chi2_tail(more, held)
    return fisher_tail(more / held / max(result.free.chi2 / result.free.dof, 1.0), held, result.free.dof)


def centroid_cov(fit: Fit, centroid_M_mm: Array) -> Array:
    """Covariance (6, 6) of [rotation vector in rad about the axes of M, translation in mm of a point (3,) in M]."""
    jac = np.eye(6)
    jac[3:, :3] = -skew(centroid_M_mm - fit.pivot_mm)
    result: Array = jac @ fit.cov @ jac.T
    return result


def pose_sigmas(fit: Fit) -> dict[str, float | None]:
    """1 sigma of [Luo]'s six numbers; in gimbal lock alpha and gamma are not told apart and have none."""
    e = matrix_to_euler(fit.X_MN.R)
    jac = np.eye(6)
    jac[3:, :3] = -skew(fit.X_MN.t_mm - fit.pivot_mm)
    if not e.gimbal_lock:
        jac[:3, :3] = np.linalg.inv(turning_axes(e.beta_rad, e.gamma_rad))
    else:
        jac[1, :3] = turning_axes(e.beta_rad, e.gamma_rad)[:, 1]
    sigma = np.sqrt(np.maximum(np.diag(jac @ fit.cov @ jac.T), 0.0))
    values: list[float | None] = [*np.degrees(sigma[:3]).tolist(), *sigma[3:].tolist()]
    if e.gimbal_lock:
        values[0] = values[2] = None
    return dict(zip(SIGMAS, values, strict=True))


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


def _rejected_json(rejected: tuple[Rejection, ...]) -> dict[str, Any]:
    rows = [{"name": r.name, "reason": r.reason, "detail": r.detail} for r in rejected]
    return {"rejected": rows, "swapped": {r.name: r.partner for r in rejected if r.partner}}


def fit_json(result: FitResult) -> dict[str, Any]:
    """The JSON object of `docking fit`; every key is always there.

    `pose` is X_MN (nominal into measured coordinates); `residuals_mm` measured minus fitted, passes averaged; `used`
    and `rejected` name the points; `dropped_readings` are single passes left out of a used point; `refused` is the
    reason why no pose is given, with `refused_code` and `remedy`, else null. `covariance`: see `centroid_cov`, the
    centroid is that of the used points. `chi2_p` is null where the sigmas were taken from the residuals themselves, or
    the method does not use them; `locks_p`: see there.
    """
    fit, screened = result.fit, result.screened
    if fit is None or screened is None:
        assert result.refusal is not None
        why = {"refused": result.refusal.text(), "refused_code": result.refusal.code, "remedy": result.refusal.remedy()}
        return {**_EMPTY, **_rejected_json(result.refusal.rejected), **why}
    judged = result.sigmas_known and fit.method == "ml"
    return {
        **_EMPTY,
        "pose": _pose_json(fit.X_MN),
        "rms_mm": fit.rms_mm,
        "max_mm": fit.max_mm,
        "used": list(fit.names),
        **_rejected_json(fit.rejected),
        "dropped_readings": _rejected_json(screened.dropped)["rejected"],
        "residuals_mm": {n: [float(v) for v in r] for n, r in zip(fit.names, fit.residuals_mm, strict=True)},
        "method": fit.method,
        "covariance": centroid_cov(fit, screened.measured_mm.mean(axis=0)).tolist(),
        "sigma": pose_sigmas(fit),
        "chi2": fit.chi2,
        "dof": fit.dof,
        "chi2_p": chi2_tail(fit.chi2, fit.dof) if judged else None,
        "locks_p": locks_p(result),
        "redundancy": fit.redundancy,
        "scale": (1.0 + result.given) * (1.0 + fit.expansion),
    }


def _rejected_lines(title: str, rejected: list[dict[str, str]]) -> list[str]:
    lines = [f"{title}: {len(rejected)}"] if rejected else []
    return lines + [f"  {r['name']:<16} {r['reason']:<16} {r['detail']}" for r in rejected]


def _plus_minus(sigma: dict[str, float | None], name: str, digits: int) -> str:
    value = sigma[name]
    return "not told apart" if value is None else f"{value:.{digits}f}"


def judgement_lines(result: dict[str, Any]) -> list[str]:
    """How far the pose is known and whether the residuals are what the sigmas let expect, for a person."""
    sigma = result["sigma"]
    lines = [
        "one sigma: "
        + "  ".join(f"{name[0]} {_plus_minus(sigma, name, 4)}" for name in SIGMAS[3:])
        + " mm  "
        + "  ".join(f"{name.partition('_')[0]} {_plus_minus(sigma, name, 6)}" for name in SIGMAS[:3])
        + " deg"
    ]
    if result["chi2_p"] is not None:
        p = result["chi2_p"]
        verdict = _TOO_LARGE if not (p >= _DOUBTFUL) else _TOO_SMALL if p > 1.0 - _DOUBTFUL else _EXPECTED
        text = f"chi2 {result['chi2']:.1f} for {result['dof']} degrees of freedom (p = {p:.3g})"
        lines.append(f"{text}: {verdict}")
    if result["locks_p"] is not None:
        p = result["locks_p"]
        verdict = "as the points let expect" if p >= _DOUBTFUL else "THE POINTS CONTRADICT THE HELD VALUES"
        lines.append(f"held degrees of freedom (p = {p:.3g}): {verdict}")
    if result["redundancy"] == 0:
        lines.append("NO REDUNDANCY: three points define a pose, nothing in the fit could prove it wrong")
    if result["scale"] != 1.0:
        lines.append(f"scale of the nominal: {result['scale']:.8f}")
    return lines


def fit_text(result: dict[str, Any]) -> str:
    """The result of `fit_json` for a person."""
    tail = _rejected_lines("rejected points", result["rejected"])
    tail += _rejected_lines("readings left out", result["dropped_readings"])
    if result["refused"] is not None:
        head = [f"no pose: {result['refused_code']}: {result['refused']}", f"    -> {result['remedy']}"]
        return "\n".join([*head, *tail])
    pose = result["pose"]
    lines = [
        "pose of the nominal in the measured frame, R = Rz(gamma) Ry(beta) Rx(alpha)",
        f"  x {pose['x_mm']:.4f}  y {pose['y_mm']:.4f}  z {pose['z_mm']:.4f} mm",
        f"  alpha {pose['alpha_deg']:.6f}  beta {pose['beta_deg']:.6f}  gamma {pose['gamma_deg']:.6f} deg",
        *judgement_lines(result),
        f"{len(result['used'])} points used, residuals: rms {result['rms_mm']:.4f}, largest {result['max_mm']:.4f} mm",
    ]
    for name, r in result["residuals_mm"].items():
        lines.append(f"  {name:<16} {r[0]:+.4f} {r[1]:+.4f} {r[2]:+.4f} mm")
    return "\n".join([*lines, *tail])
