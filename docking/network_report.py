"""`docking network`: one point file a station in, the adjusted stations and points out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from docking.calibration.network import Network, View, adjust_network
from docking.errors import BadArgument, SigmaMissing
from docking.geometry import pose_to_vector
from docking.noise_spec import noise_from, with_noise
from docking.point_file import read_points
from docking.pose.uncertainty import largest_sigma_mm
from docking.records import POSE_KEYS, rejection_records
from docking.types import Array, Points

_AXES = ("alpha_urad", "beta_urad", "gamma_urad", "x_mm", "y_mm", "z_mm")


def network_of(files: tuple[Path, ...], ers: Path | None, noise: str) -> Network:
    """Read the files and adjust; a station is called like its file. Raises as `read_points` and `adjust_network`."""
    names = [path.stem for path in files]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadArgument("FILES", f"two stations are called {twice[0]}", value=" ".join(map(str, files)))
    of = noise_from(noise)
    views = tuple(
        View(name, with_noise(read_points(path, "measured"), of)) for name, path in zip(names, files, strict=True)
    )
    return adjust_network(views, None if ers is None else _references(ers))


def _references(path: Path) -> Points:
    points = read_points(path, "nominal")
    if not np.all(np.isfinite(points.cov_mm2)):
        raise SigmaMissing(str(path), value="a reference point (sx_mm, sy_mm, sz_mm)")
    return points


def sigmas_of(network: Network, k: int) -> Array:
    """1 sigma (6,) of station k: rotations about the axes of W in rad, then the shift in mm of its points' centroid."""
    result: Array = np.sqrt(np.diag(network.cov)[6 * k : 6 * k + 6])
    return result


def _rms_mm(network: Network, station: str) -> float:
    rows = [i for i, (name, _) in enumerate(network.observed) if name == station]
    return float(np.sqrt(np.mean(np.sum(network.residuals_mm[rows] ** 2, axis=1)))) if rows else float("nan")


def network_json(network: Network) -> dict[str, Any]:
    """The object of `docking network --json`. `covariance` (6k, 6k): for each station rotation vector in rad about the
    axes of W, then translation in mm of its pivot."""
    unit = np.array([1e6] * 3 + [1.0] * 3)
    return {
        "stations": [
            {
                "name": name,
                "pose": dict(zip(POSE_KEYS, pose_to_vector(X).tolist(), strict=True)),
                "matrix": X.matrix().tolist(),
                "pivot_mm": network.pivots_mm[k].tolist(),
                "sigma": dict(zip(_AXES, (sigmas_of(network, k) * unit).tolist(), strict=True)),
                "used": sum(station == name for station, _ in network.observed),
                "rms_mm": _rms_mm(network, name),
            }
            for k, (name, X) in enumerate(zip(network.stations, network.poses, strict=True))
        ],
        "covariance": network.cov.tolist(),
        "points": [
            {"name": name, "xyz_mm": xyz.tolist(), "covariance_mm2": cov.tolist(), "views": views}
            for name, xyz, cov, views in zip(
                network.points.names, network.points.xyz_mm, network.points.cov_mm2, network.views, strict=True
            )
        ],
        "residuals_mm": [
            {"station": station, "point": point, "xyz_mm": r.tolist()}
            for (station, point), r in zip(network.observed, network.residuals_mm, strict=True)
        ],
        "rejected": rejection_records(network.rejected),
        "chi2": network.chi2,
        "dof": network.dof,
        "chi2_p": network.chi2_p,
        "consistent": network.consistent,
    }


def network_text(network: Network) -> str:
    """The same for a person."""
    lines = ["stations in W, mm and deg, R = Rz(gamma) Ry(beta) Rx(alpha)"]
    for k, (name, X) in enumerate(zip(network.stations, network.poses, strict=True)):
        v, sigma = pose_to_vector(X), sigmas_of(network, k)
        shift, turn = " ".join(f"{c:.4f}" for c in v[:3]), " ".join(f"{c:.6f}" for c in v[3:])
        held = "" if np.any(sigma) else "  (held: it defines W)"
        lines += [
            f"  {name:<16} x y z {shift}   alpha beta gamma {turn}{held}",
            f"  {'':<16} sigma {np.max(sigma[3:]):.4f} mm in the middle of its points, "
            f"{np.max(sigma[:3]) * 1e6:.1f} urad; residuals rms {_rms_mm(network, name):.4f} mm",
        ]
    lines += ["", f"{len(network.points)} points in W            x           y           z    sigma mm  views"]
    sigma_mm = largest_sigma_mm(network.points.cov_mm2)
    for name, xyz, s, views in zip(network.points.names, network.points.xyz_mm, sigma_mm, network.views, strict=True):
        lines.append(f"  {name:<16}{xyz[0]:>12.4f}{xyz[1]:>12.4f}{xyz[2]:>12.4f}{s:>12.4f}{views:>7}")
    lines += [f"observations left out: {len(network.rejected)}"] if network.rejected else []
    lines += [f"  {r.name:<24} {r.reason:<16} {r.detail}" for r in network.rejected]
    verdict = (
        "as the sigmas let expect"
        if network.consistent
        else "MORE THAN THE SIGMAS LET EXPECT: noise or a frame is wrong"
    )
    return "\n".join(
        [*lines, f"chi2 {network.chi2:.1f} for {network.dof} degrees of freedom (p = {network.chi2_p:.3g}): {verdict}"]
    )
