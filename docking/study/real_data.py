"""Measurements that other people made, through the product's own screening and fit, against what they published.

faro_epochs   a laser tracker's session: three reflectors on the floor, three on a moving tool, lost and mixed-up beams
helmert3d     20 survey points in two frames with that program's printed answer
clas12_svt    66 modules with 3 fiducials each, ideal and surveyed, with the survey's own table of module shifts
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import BadPointFile, FileUnreadable, PoseError
from docking.geometry import rms
from docking.pose import LASER_TRACKER, FitSettings, fit_pose, screen
from docking.pose.pairs import distances
from docking.types import Array, Fit, Points, Pose, Screened

BASE, TOOL = ("base_1", "base_2", "base_3"), ("SMR_1", "SMR_2", "SMR_3")
HELMERT_SIGMA_MM = 0.5
"""A survey of metres read as mm; equal for all points, so it has no part in the answer."""
BAD_MM = 0.1
"""An epoch whose distances leave their medians by more is none of the instrument's noise."""
_FREE_SCALE = 0.05
"""Prior of the scale so wide that the points alone decide it."""
PRINTED_POSE = {"rotation": 2e-10, "translation": 2e-4, "scale": 2e-10}
"""The program's answer has ten digits, and its residuals have a mean of 0.0002: its translation is good to that."""
PRINTED_SHIFT_MM = 0.0006
"""The published shifts have three digits, and so have the coordinates."""


def numbers(path: Path, columns: tuple[int, ...] | None = None) -> Array:
    """A table of numbers (n, columns) separated by blanks. Raises FileUnreadable, BadPointFile."""
    try:
        return np.loadtxt(path, usecols=columns, ndmin=2)
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error
    except ValueError as error:
        raise BadPointFile(str(path), str(error), value=path.name) from error


def study_real(folder: Path) -> dict[str, Any]:
    """Every data set under the folder, each with its bars. Raises FileUnreadable, BadPointFile."""
    rows = [faro_epochs(folder / "faro_epochs"), helmert(folder / "helmert3d"), clas12(folder / "clas12_svt")]
    return {"sets": rows, "held": all(row["held"] for row in rows)}


# A tracker's session ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Session:
    """Readings (epochs, 3, 3) in mm of three reflectors of one rigid body, in the tracker's frame."""

    names: tuple[str, ...]
    xyz_mm: Array

    def off_mm(self) -> Array:
        """How far the distances of each epoch (n,) leave their medians at most."""
        gaps = np.array([distances(epoch)[np.triu_indices(3, 1)] for epoch in self.xyz_mm])
        largest: Array = np.max(np.abs(gaps - np.median(gaps, axis=0)), axis=1)
        return largest

    def nominal(self) -> Points:
        """The body's figure: the mean of the typical epochs after each is laid upon the most typical one."""
        off = self.off_mm()
        typical = np.argsort(off)[: len(off) // 2]
        first = self.xyz_mm[typical[0]]
        names, none = self.names, np.zeros((3, 3, 3))
        laid = [
            fit_pose(Screened(names, self.xyz_mm[k], none, first, none + np.eye(3))).X_MN.apply(self.xyz_mm[k])
            for k in typical
        ]
        return Points(names, np.mean(laid, axis=0), none)

    def epoch(self, k: int) -> Points:
        """One epoch with the covariance of the instrument, which stands at the origin; a lost beam has none."""
        xyz = self.xyz_mm[k]
        seen = np.any(xyz != 0.0, axis=1)
        cov = np.full((3, 3, 3), np.nan)
        cov[seen] = LASER_TRACKER.covariance(xyz[seen])
        return Points(self.names, xyz, cov)


def session(folder: Path, names: tuple[str, ...]) -> Session:
    """The reflectors of these names. Raises FileUnreadable, BadPointFile."""
    return Session(names, np.stack([numbers(folder / f"measured_{name}.txt") for name in names], axis=1))


def faro_epochs(folder: Path) -> dict[str, Any]:
    """Which epochs are refused, of the floor points and of the tool, and the rms of all others."""
    bodies, held = {}, True
    for body, names in (("floor", BASE), ("tool", TOOL)):
        points = session(folder, names)
        row = bodies[body] = _epochs(points, points.nominal())
        # By plain distances too: all that were refused are far off, and nothing else is.
        held = held and sorted({*row["lost"], *row["wrong"]}) == np.flatnonzero(points.off_mm() > BAD_MM).tolist()
    bad = sorted({k for row in bodies.values() for k in (*row["lost"], *row["wrong"])})
    return {"set": "faro_epochs", "bodies": bodies, "bad_epochs": bad, "held": held}


def _epochs(points: Session, nominal: Points) -> dict[str, Any]:
    lost: list[int] = []
    wrong: list[int] = []
    sizes, reasons = [], {}
    for k in range(len(points.xyz_mm)):
        try:
            fit = fit_pose(screen(nominal, points.epoch(k), FitSettings(where=f"epoch {k}")))
        except PoseError as error:
            named = {r.name: r.reason for r in error.rejected}
            (lost if "lost-beam" in named.values() else wrong).append(k)
            reasons[str(k)] = named
        else:
            sizes.append(fit.rms_mm)
    return {
        "epochs": len(points.xyz_mm),
        "lost": lost,
        "wrong": wrong,
        "named": reasons,
        "rms_mm": float(np.median(sizes)),
        "largest_rms_mm": float(np.max(sizes)),
    }


# A survey against another program --------------------------------------------------------------------------------
def similarity(fit: Fit) -> tuple[float, Array, Array]:
    """Scale s, rotation (3, 3) and translation (3,) in `p = s R j + t` of a fit with expansion."""
    s = 1.0 + fit.expansion
    return s, fit.X_MN.R, s * fit.X_MN.t_mm - fit.expansion * fit.pivot_mm


def helmert(folder: Path) -> dict[str, Any]:
    """Seven parameters of 20 points beside the printed ones; metres are read as mm."""
    source, target = (numbers(folder / f"SK-{k}-points.txt") for k in (42, 95))
    names = tuple(f"P{i + 1}" for i in range(len(source)))
    none = np.zeros((len(source), 3, 3))
    settings = FitSettings(expansion_sigma=_FREE_SCALE)
    cov = none + HELMERT_SIGMA_MM**2 * np.eye(3)
    fit = fit_pose(Screened(names, source, none, target, cov), settings)
    scale, R, t = similarity(fit)
    printed = [
        [float(v) for v in line.split()]
        for line in (folder / "SK-42-SK-95-param-1.0.5.txt").read_text(encoding="utf-8").splitlines()
    ]
    off = {
        "rotation": float(np.max(np.abs(R - np.array(printed[:3])))),
        "translation": float(np.max(np.abs(t - np.array(printed[3])))),
        "scale": abs(scale - printed[4][0]),
    }
    held = all(off[key] <= limit for key, limit in PRINTED_POSE.items())
    return {"set": "helmert3d", "points": len(source), "rms_m": fit.rms_mm, "scale": scale, "off": off, "held": held}


# A structure of modules ------------------------------------------------------------------------------------------
def clas12(folder: Path) -> dict[str, Any]:
    """The whole barrel, and the shift of every module's centroid beside the published one."""
    ideal, measured = (_fiducials(folder / f"survey_{kind}_reformat.dat") for kind in ("ideals", "measured"))
    published = _shifts(folder / "shifts_survey_measured_from_ideals.dat")
    whole = fit_pose(screen(ideal, measured))
    modules = sorted({name[:5] for name in ideal.names})
    found = {module: _shift(ideal, measured, module) for module in modules}
    off = [float(np.max(np.abs(found[m][0] - published[m]))) for m in modules if m in published]
    return {
        "set": "clas12_svt",
        "modules": len(modules),
        "compared": len(off),
        "rms_mm": whole.rms_mm,
        "used": len(whole.names),
        "module_rms_mm": float(np.median([found[m][1] for m in modules])),
        "largest_difference_mm": max(off),
        "held": bool(len(off) == len(modules) and max(off) <= PRINTED_SHIFT_MM),
    }


def _lines(path: Path) -> list[list[str]]:
    try:
        return [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except OSError as error:
        raise FileUnreadable(str(path), error.strerror or str(error)) from error


def _fiducials(path: Path) -> Points:
    """Fiducials `name x y z` in mm, without sigmas."""
    rows = _lines(path)
    xyz = numbers(path, (1, 2, 3))
    return Points(tuple(row[0] for row in rows), xyz, np.full((len(rows), 3, 3), np.nan))


def _shifts(path: Path) -> dict[str, Array]:
    return {row[0]: np.array([float(v) for v in row[1:4]]) for row in _lines(path)}


def _shift(ideal: Points, measured: Points, module: str) -> tuple[Array, float]:
    """Shift of a module's middle by the fitted pose of its three fiducials, and the rms of that fit."""
    names = tuple(name for name in ideal.names if name.startswith(module))
    j, p = (points.xyz_mm[[points.names.index(name) for name in names]] for points in (ideal, measured))
    none = np.zeros((len(names), 3, 3))
    fit = fit_pose(Screened(names, j, none, p, none + np.eye(3)), FitSettings(method="svd"))
    return _moved(fit.X_MN, j.mean(axis=0)), rms(fit.residuals_mm)


def _moved(X: Pose, point_mm: Array) -> Array:
    shift: Array = X.apply(point_mm) - point_mm
    return shift


def real_text(result: dict[str, Any]) -> str:
    """The outcome for a person."""
    faro, survey, barrel = result["sets"]
    lines = []
    for body, row in faro["bodies"].items():
        lines.append(
            f"faro_epochs, {body}: {row['epochs']} epochs, lost beams {row['lost']}, wrong reflectors {row['wrong']}; "
            f"the others fit to {1e3 * row['rms_mm']:.1f} um (median rms), {1e3 * row['largest_rms_mm']:.1f} um at most"
        )
    lines.append(
        f"helmert3d: {survey['points']} points, rms {survey['rms_m']:.4f} m, scale 1 {survey['scale'] - 1.0:+.2e}; "
        f"from the printed answer by {survey['off']['rotation']:.0e} (rotation), {survey['off']['translation']:.0e} m, "
        f"{survey['off']['scale']:.0e} (scale)"
    )
    lines.append(
        f"clas12_svt: {barrel['used']} fiducials, rms {barrel['rms_mm']:.3f} mm as one body, "
        f"{barrel['module_rms_mm']:.4f} mm module by module; {barrel['compared']} module shifts differ from the "
        f"published by {barrel['largest_difference_mm']:.5f} mm at most"
    )
    lines.append("all as published" if result["held"] else "NOT AS PUBLISHED: see above")
    return "\n".join(lines)
