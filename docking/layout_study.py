"""`docking layout`: what the targets of a job will be worth from where the station stands, before any is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import numpy as np

from docking.candidates import Box, places
from docking.config.budget import (
    FeatureBudget,
    PartReadings,
    docked_pose,
    drift_cov_mm2,
    feature_budget,
    least_risk,
    reading_cov_mm2,
)
from docking.config.build import convergence_settings
from docking.config.cell import CellFile
from docking.config.job import Component, JobFile, Mate
from docking.config.load import default_job_path, load_cell, load_job
from docking.config.nominal import feature_points, mate_feature_points, target_points
from docking.errors import BadArgument, BadPointFile
from docking.geometry import pose_from_vector
from docking.point_file import read_points
from docking.pose.expected import (
    Aims,
    Direction,
    Layout,
    Reliability,
    directions,
    feature_cov_mm2,
    normal_of,
    reliability,
    shares,
    shares_with,
    shares_without,
    sigmas_mm,
)
from docking.pose.settings import FitSettings
from docking.pose.uncertainty import own_cov_mm2
from docking.types import RISK_LIMIT, Array, Points, Pose

PartName = Literal["component", "mate"]
FEWEST_TARGETS = 7
"""No target is called spare where fewer than this would be left ([Luo]: not fewer than seven)."""
SPARE = 0.02
"""A target is spare when the worst feature's sigma grows by less than this fraction without it."""
SHOWN_EXTRA = 5


@dataclass(frozen=True)
class LayoutRequest:
    """Files and options: `candidates` CSV of possible points in the part's frame (none: a grid on its bounding box)."""

    cell: Path
    job: Path | None = None
    part: PartName = "component"
    passes: int | None = None
    candidates: Path | None = None


@dataclass(frozen=True, eq=False)
class LayoutStudy:
    """What was found about the targets of one part; places in W. `extra` are the candidates and `with_extra` (k,) the
    worst feature's sigma over its tolerance with each of them, `without` (n,) the same without each target."""

    cell: CellFile
    job: JobFile
    part: PartName
    passes: int
    X_WN: Pose
    layout: Layout
    aims: Aims
    features: tuple[FeatureBudget, ...]
    risk: float
    share: float
    weak: tuple[Direction, ...]
    reliability: Reliability
    without: Array
    extra: Layout
    with_extra: Array

    @property
    def provable(self) -> bool:
        """Whether every tolerance can be proved with so many passes when no error is left."""
        return all(feature.provable for feature in self.features) and self.risk <= RISK_LIMIT

    @property
    def station_W_mm(self) -> Array:
        return pose_from_vector(self.cell.tracker.station_pose).t_mm

    def order(self) -> list[int]:
        """Targets by what the layout loses without them, most first."""
        return sorted(range(len(self.without)), key=lambda i: -float(self.without[i]))

    def spare(self) -> list[str]:
        """Targets of which any ONE could be dropped."""
        if len(self.layout.names) <= FEWEST_TARGETS:
            return []
        return [self.layout.names[i] for i in reversed(self.order()) if self.without[i] <= (1.0 + SPARE) * self.share]

    def best_extra(self) -> list[int]:
        """Candidates by what the layout gains with them, most first."""
        return sorted(range(len(self.with_extra)), key=lambda i: float(self.with_extra[i]))


def study_layout(request: LayoutRequest) -> LayoutStudy:
    """Foresee the layout of one part. Raises FileUnreadable, ConfigInvalid, BadPointFile, BadArgument."""
    cell = load_cell(request.cell)
    job_path = default_job_path(request.cell) if request.job is None else request.job
    job = load_job(job_path, cell, proof=False)
    passes = job.measuring.passes if request.passes is None else request.passes
    own, other = _parts(cell, job, passes, request.part)
    component = feature_points(job.component, cell)
    mates = mate_feature_points(job.component, job.mate, cell)
    at_W = docked_pose(cell, job).apply(component.xyz_mm)
    rest = own_cov_mm2(feature_cov_mm2(other, at_W) + drift_cov_mm2(cell, len(at_W)))
    tolerance = np.array([feature.tolerance_mm for feature in job.component.features])
    aims = Aims(at_W, rest + component.cov_mm2 + mates.cov_mm2, tolerance)
    X_WN = _pose(cell, job, request.part)
    extra = _candidates(request, cell, job, passes)
    normal = normal_of(own)
    cov = normal.cov()
    lever = float(np.sqrt(np.mean(np.sum((at_W - normal.pivot_mm) ** 2, axis=1))))
    return LayoutStudy(
        cell=cell,
        job=job,
        part=request.part,
        passes=passes,
        X_WN=X_WN,
        layout=own,
        aims=aims,
        features=feature_budget(cell, job, passes),
        risk=least_risk(cell, job, passes),
        share=float(shares(cov, normal.pivot_mm, aims)),
        weak=directions(cov, lever, X_WN.R),
        reliability=reliability(own, aims, FitSettings().false_alarm),
        without=shares_without(own, aims),
        extra=extra,
        with_extra=shares_with(own, extra, aims),
    )


def _pose(cell: CellFile, job: JobFile, part: PartName) -> Pose:
    return docked_pose(cell, job) if part == "component" else pose_from_vector(job.mate.pose)


def _parts(cell: CellFile, job: JobFile, passes: int, part: PartName) -> tuple[Layout, Layout]:
    """The layout that is studied, and that of the part it must meet."""
    component = PartReadings.of(cell, job.component, _pose(cell, job, "component"), passes).layout()
    mate = PartReadings.of(cell, job.mate, _pose(cell, job, "mate"), passes).layout()
    return (component, mate) if part == "component" else (mate, component)


# Where one more target could stand -------------------------------------------------------------------------------
def _candidates(request: LayoutRequest, cell: CellFile, job: JobFile, passes: int) -> Layout:
    """Candidate points in W with the covariance that a reading there and a nest like the others would have."""
    X_WN = _pose(cell, job, request.part)
    part = job.component if request.part == "component" else job.mate
    usual_mm = float(np.median([target.sigma_mm for target in part.targets]))
    if request.candidates is None:
        points = _generated(request.part, cell, job)
    else:
        points = read_points(request.candidates, "nominal")
        if not len(points):
            raise BadPointFile(str(request.candidates), "one or more candidate points are needed", value="no points")
        twice = sorted({target.name for target in part.targets} & set(points.names))
        if twice:
            raise BadArgument("--candidates", f"{twice[0]} is a target already", value=str(request.candidates))
    unknown = ~np.all(np.isfinite(points.cov_mm2), axis=(1, 2))
    nominal = np.where(unknown[:, None, None], usual_mm**2 * np.eye(3), points.cov_mm2)
    at_W = X_WN.apply(points.xyz_mm)
    cov = reading_cov_mm2(cell, at_W, passes) + X_WN.R @ nominal @ X_WN.R.T
    return Layout(points.names, at_W, cov)


def _generated(name: PartName, cell: CellFile, job: JobFile) -> Points:
    """Check points, which have their nests already, and a grid on the visible sides of the part's bounding box, where
    reflectors stand off like those of its targets."""
    axis_C = docked_pose(cell, job).R.T @ pose_from_vector(job.mate.pose).R @ np.array(job.docking_axis)
    boxes = {
        "component": Box.around(_pose(cell, job, "component"), _extent_of_component(job.component)),
        "mate": Box.around(_pose(cell, job, "mate"), _extent_of_mate(job.mate)),
    }
    covered = axis_C if name == "component" else -np.array(job.docking_axis)
    others = [box for part, box in boxes.items() if part != name]
    found = places(boxes[name], pose_from_vector(cell.tracker.station_pose).t_mm, covered, others)
    part = job.component if name == "component" else job.mate
    nests = target_points(job.component.check_points if name == "component" else (), part, cell)
    offset_mm = float(np.median([target.reflector_offset_mm for target in part.targets]))
    xyz = found.xyz_mm + offset_mm * found.normal
    names = tuple(f"grid-{k + 1:03d}" for k in range(len(xyz)))
    unknown = np.full((len(xyz), 3, 3), np.nan)
    return Points(nests.names + names, np.vstack([nests.xyz_mm, xyz]), np.concatenate([nests.cov_mm2, unknown]))


def _extent_of_component(part: Component) -> Array:
    rings = [point for ring in part.outline_mm for point in ring]
    nests = [target.xyz_mm for target in (*part.targets, *part.check_points)]
    return np.array([*rings, *nests, *(feature.xyz_mm for feature in part.features)])


def _extent_of_mate(mate: Mate) -> Array:
    corners = [corner for box in mate.envelope for corner in (box.min_mm, box.max_mm)]
    return np.array([*corners, *(target.xyz_mm for target in mate.targets)])


# In words and numbers --------------------------------------------------------------------------------------------
def dead_band_mm(study: LayoutStudy, tolerance_mm: float) -> float:
    """The error below which the cell does not correct a feature of this tolerance."""
    settings = convergence_settings(study.cell, study.job)
    return min(settings.dead_band_mm, settings.dead_band_fraction * tolerance_mm)


def axis_words(vector: Array) -> str:
    """A direction in words: an axis, the plane of two, or its components."""
    unit = vector / np.linalg.norm(vector)
    order = np.argsort(-np.abs(unit))
    first, second = ("XYZ"[k] for k in sorted(order[:2]))
    unit = unit * np.sign(unit[order[0]])
    numbers = ", ".join(f"{value:z.2f}" for value in unit)
    if abs(unit[order[0]]) > 0.97:
        return "XYZ"[order[0]]
    if abs(unit[order[2]]) < 0.2:
        return f"an axis between {first} and {second} ({numbers})"
    return f"({numbers})"


def direction_words(direction: Direction) -> str:
    """A principal direction of the pose's uncertainty in words; a part under a third of the other is left out."""
    turn_rad, shift_mm = (float(np.linalg.norm(v)) for v in (direction.rotation_rad, direction.translation_mm))
    turned_mm = float(np.sqrt(max(direction.moves_mm**2 - shift_mm**2, 0.0)))
    turn = f"rotation about {axis_words(direction.rotation_rad)}, {turn_rad * 1e6:.1f} urad" if turn_rad else ""
    shift = f"shift along {axis_words(direction.translation_mm)}, {shift_mm * 1e3:.1f} um" if shift_mm else ""
    if shift_mm < turned_mm / 3.0:
        return turn
    return shift if turned_mm < shift_mm / 3.0 else f"{turn}, together with {shift}"


def _known(value: float) -> float | None:
    return float(value) if isfinite(value) else None


def _foreseen(study: LayoutStudy, share: float) -> float | None:
    """Sigma over tolerance against that of the layout as it is: -0.1 is ten percent better; None: the pose is open."""
    return _known(share / study.share - 1.0)


def layout_json(study: LayoutStudy) -> dict[str, Any]:
    """The object of `docking layout --json`. Points in the part's frame; `change` is the relative change of the worst
    feature's sigma over tolerance; null: the error would stay unnoticed, or the pose would be open."""
    to_part, rel = study.X_WN.inverse(), study.reliability
    at_N = to_part.apply(study.layout.xyz_mm)
    return {
        "cell": study.cell.name,
        "job": {"part_number": study.job.part_number, "serial_number": study.job.serial_number},
        "part": study.part,
        "passes": study.passes,
        "provable": study.provable,
        "risk": study.risk,
        "features": [_feature_json(study, feature) for feature in study.features],
        "weak": [
            {
                "words": direction_words(d),
                "rotation_urad": (d.rotation_rad * 1e6).tolist(),
                "translation_mm": d.translation_mm.tolist(),
                "moves_features_mm": d.moves_mm,
            }
            for d in study.weak
        ],
        "targets": [
            {
                "name": name,
                "xyz_mm": at_N[i].tolist(),
                "redundancy": float(rel.redundancy[i]),
                "detectable_mm": _known(rel.detectable_mm[i]),
                "harm_mm": _known(rel.harm_mm[i]),
                "change_without": _foreseen(study, float(study.without[i])),
            }
            for i, name in enumerate(study.layout.names)
        ],
        "matters_most": study.layout.names[study.order()[0]],
        "spare": study.spare(),
        "candidates": len(study.extra.names),
        "extra": [_extra_json(study, i) for i in study.best_extra()[:SHOWN_EXTRA]],
    }


def _feature_json(study: LayoutStudy, feature: FeatureBudget) -> dict[str, Any]:
    dead = dead_band_mm(study, feature.tolerance_mm)
    return {
        "name": feature.name,
        "tolerance_mm": feature.tolerance_mm,
        "sigma_mm": feature.sigma_mm,
        "bound_mm": dead + 2.0 * feature.sigma_mm,
        "left_mm": feature.tolerance_mm - 2.0 * feature.sigma_mm,
        "provable": feature.provable,
        "parts_mm": dict(feature.parts_mm),
    }


def _extra_json(study: LayoutStudy, i: int) -> dict[str, Any]:
    """One candidate: where, and how the features' sigmas would be."""
    normal = normal_of(study.layout)
    wider = replace(
        study.layout,
        names=(*study.layout.names, study.extra.names[i]),
        xyz_mm=np.vstack([study.layout.xyz_mm, study.extra.xyz_mm[i]]),
        cov_mm2=np.concatenate([study.layout.cov_mm2, study.extra.cov_mm2[i : i + 1]]),
    )
    normal = normal_of(wider)
    sigma = sigmas_mm(normal.cov(), normal.pivot_mm, study.aims)
    return {
        "name": study.extra.names[i],
        "xyz_mm": study.X_WN.inverse().apply(study.extra.xyz_mm[i]).tolist(),
        "change": _foreseen(study, float(study.with_extra[i])),
        "sigma_mm": dict(zip((feature.name for feature in study.features), sigma.tolist(), strict=True)),
    }


def layout_text(study: LayoutStudy) -> str:
    """The same for a person."""
    head = (
        f"cell {study.cell.name}, job {study.job.part_number} / {study.job.serial_number}: {study.part}, "
        f"{len(study.layout.names)} targets, {study.passes} passes; nothing is measured"
    )
    return "\n".join([head, *_feature_lines(study), *_weak_lines(study), *_target_lines(study), *_extra_lines(study)])


def _feature_lines(study: LayoutStudy) -> list[str]:
    lines = ["", "docking features, both parts measured       sigma  e + 2 sigma*  tolerance  left for errors"]
    for feature in study.features:
        f = _feature_json(study, feature)
        lines.append(
            f"  {feature.name:<36}{f['sigma_mm']:>11.4f}{f['bound_mm']:>14.4f}{f['tolerance_mm']:>11.3f}"
            f"{f['left_mm']:>17.4f} mm"
        )
    verdict = "can be proved" if study.provable else "CANNOT be proved with so many passes"
    return [
        *lines,
        "  * e = the largest error that is left uncorrected on purpose (dead-band)",
        f"  the tolerances {verdict}; risk that any feature is out with no error measured: {study.risk:.2%}",
    ]


def _weak_lines(study: LayoutStudy) -> list[str]:
    frame = "C" if study.part == "component" else "M"
    lines = ["", f"weak directions of the {study.part}'s pose (1 sigma, axes of {frame}; how far features move)"]
    return lines + [f"  {d.moves_mm * 1e3:7.1f} um  {direction_words(d)}" for d in study.weak[:3]]


def _target_lines(study: LayoutStudy) -> list[str]:
    rel = study.reliability
    lines = ["", "target            redundancy  detectable mm  could do at a feature mm  sigma without it"]
    for i in study.order():
        change = _foreseen(study, float(study.without[i]))
        told = "pose open" if change is None else f"{change:+.1%}"
        lines.append(
            f"  {study.layout.names[i]:<16}{rel.redundancy[i]:>10.2f}{rel.detectable_mm[i]:>15.3f}"
            f"{rel.harm_mm[i]:>26.4f}{told:>18}"
        )
    spare = ", ".join(study.spare()) or "none"
    return [*lines, f"  matters most: {study.layout.names[study.order()[0]]}; any one of these could go: {spare}"]


def _extra_lines(study: LayoutStudy) -> list[str]:
    if not len(study.extra.names):
        return ["", "no place on the part's bounding box is seen from the station"]
    lines = [
        "",
        f"one more target, {len(study.extra.names)} places tried: where, mm; change of the worst sigma / tolerance",
    ]
    for i in study.best_extra()[:SHOWN_EXTRA]:
        at = ", ".join(f"{value:z.0f}" for value in study.X_WN.inverse().apply(study.extra.xyz_mm[i]))
        change = study.with_extra[i] / study.share - 1.0
        lines.append(f"  {study.extra.names[i]:<16}({at}){change:>+{40 - len(at)}.1%}")
    return lines
