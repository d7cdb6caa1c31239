"""Cross checks of a cell, and of a job against its cell: every problem at once, as findings that name key and bound."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain

import numpy as np

from docking.config.base import Vector3
from docking.config.budget import REMEDIES, FeatureBudget, feature_budget, least_risk
from docking.config.cell import CellFile, PositionerConfig
from docking.config.document import cell_document_findings, job_document_findings
from docking.config.findings import Finding, error, errors_of, warning
from docking.config.input_checks import input_findings
from docking.config.job import JobFile, Target
from docking.config.nominal import docked_in_mate, feature_points, mate_feature_points
from docking.config.raising import lift_findings
from docking.config.support import (
    follower_findings,
    rank_findings,
    reaction_findings,
    speed_findings,
    stroke_findings,
)
from docking.errors import DockingError
from docking.pose.layout import spread
from docking.pose.settings import FitSettings
from docking.pose.svd import mirrored_rms_mm
from docking.types import RISK_LIMIT, Array

UNIT_TOLERANCE = 1e-4
SCALE_RANGE = (0.9, 1.1)
INDEPENDENCE = 0.2
"""Smallest singular value of a positioner's unit axis directions; 1 when they are square to each other."""
ADVISED_TARGETS = 7
ADVISED_SPREAD = 0.05


def check_cell(cell: CellFile) -> list[Finding]:
    """All findings about a cell, errors and warnings, in the order of the file."""
    findings = [*_ers(cell), *_unit("gravity_direction", cell.gravity_direction, 1e-3)]
    findings += cell_document_findings(cell.model_dump()) + input_findings(cell)
    axes = list(chain.from_iterable(_directions(i, p) for i, p in enumerate(cell.positioners)))
    findings += axes
    if not errors_of(axes):
        findings += _computed("positioners", lambda: rank_findings(cell) + follower_findings(cell))
    return findings


def check_job(cell: CellFile, job: JobFile, *, proof: bool = True) -> list[Finding]:
    """All findings about a job in its cell, errors and warnings. The cell itself is taken as checked.

    Without `proof` a tolerance that the instrument cannot prove is no finding.
    """
    parts = [*_references(cell, job), *_normals(job), *_layouts(job)]
    findings = [*job_document_findings(job.model_dump()), *parts, *_permissives(cell, job)]
    if errors_of(parts):  # geometry on names or directions that are wrong would only name them again
        return findings
    findings += _computed("component.features", lambda: _congruence(cell, job))
    if not errors_of(findings):
        findings += _computed("component.com_mm", lambda: reaction_findings(cell, job))
        findings += _computed("stages", lambda: stroke_findings(cell, job) + speed_findings(cell, job))
        findings += _computed("lift_mm", lambda: lift_findings(cell, job))
        findings += _computed("component.features", lambda: _provable(cell, job)) if proof else []
    return findings


def _computed(key: str, check: Callable[[], list[Finding]]) -> list[Finding]:
    """The findings of a check on numbers; numbers that cannot be computed with are a finding themselves."""
    try:
        with np.errstate(all="ignore"):
            return check()
    except (np.linalg.LinAlgError, DockingError, ValueError) as failure:
        return [error(key, f"cannot be computed with: {failure}")]


def _unit(key: str, vector: Vector3, tolerance: float = UNIT_TOLERANCE) -> list[Finding]:
    length = float(np.linalg.norm(vector))
    if abs(length - 1.0) <= tolerance:
        return []
    return [error(key, f"{list(vector)} has the length {length:.6g}; a unit vector (1 +- {tolerance:g}) is needed")]


def _ers(cell: CellFile) -> list[Finding]:
    return _layout("tracker.ers", np.array([p.xyz_mm for p in cell.tracker.ers]), "reference points")


def _directions(index: int, positioner: PositionerConfig) -> list[Finding]:
    """Scale of each axis, independence and handedness of the three."""
    key = f"positioners[{index}].axes"
    lengths = [float(np.linalg.norm(axis.direction)) for axis in positioner.axes]
    low, high = SCALE_RANGE
    findings = [
        error(f"{key}[{j}].direction", f"length {length:.6g} (the scale of the axis) must be {low:g} to {high:g}")
        for j, length in enumerate(lengths)
        if not low <= length <= high
    ]
    if findings:
        return findings
    unit = np.array([axis.direction for axis in positioner.axes]).T / lengths
    least = float(np.linalg.svd(unit, compute_uv=False)[-1])
    if not least >= INDEPENDENCE:
        text = f"the directions of positioner {positioner.name} are not independent: least singular value {least:.3g}"
        return [error(key, f"{text}, at least {INDEPENDENCE:g} is needed")]
    if np.linalg.det(unit) < 0.0:
        return [warning(key, f"the directions of positioner {positioner.name} are left-handed: is a sign swapped?")]
    return []


def _layout(key: str, points_mm: Array, what: str) -> list[Finding]:
    """Points on one spot or on a line define no rotation; a narrow set defines it badly."""
    extent = spread(points_mm)
    ratio = extent.middle_mm / extent.long_mm if extent.long_mm > 0.0 else 0.0
    numbers = f"second extent {extent.middle_mm:.4g} mm of {extent.long_mm:.4g} mm (ratio {ratio:.2g})"
    if not ratio >= FitSettings().spread_ratio:
        return [error(key, f"the {what} lie on a line: {numbers}, at least {FitSettings().spread_ratio:g} is needed")]
    if not ratio >= ADVISED_SPREAD:
        return [warning(key, f"the {what} lie nearly on a line: {numbers}, {ADVISED_SPREAD:g} or more is advised")]
    return []


def _references(cell: CellFile, job: JobFile) -> list[Finding]:
    """Balls against positioners, and names that cell and job share."""
    known = [p.name for p in cell.positioners]
    carried = [ball.positioner for ball in job.component.balls]
    findings = [
        error(f"component.balls[{i}].positioner", f"{name!r} is not a positioner of this cell ({', '.join(known)})")
        for i, name in enumerate(carried)
        if name not in known
    ]
    findings += [
        error("component.balls", f"positioner {name} has no ball in this job") for name in known if name not in carried
    ]
    fixed = {point.name: i for i, point in enumerate(cell.tracker.ers)}
    findings += [
        error(f"{group}[{i}].name", f"{t.name!r} is a duplicate: tracker.ers[{fixed[t.name]}] of the cell has it too")
        for group, targets in _measured(job)
        for i, t in enumerate(targets)
        if t.name in fixed
    ]
    need = job.measuring.drift_points
    for key, count in (("mate.targets", len(job.mate.targets)), ("tracker.ers of the cell", len(cell.tracker.ers))):
        if need > count:
            findings.append(error("measuring.drift_points", f"{need} is more than the {count} of {key}"))
    return findings


def _measured(job: JobFile) -> tuple[tuple[str, tuple[Target, ...]], ...]:
    """Every group of reflectors of a job under its key."""
    component = job.component
    return (
        ("component.targets", component.targets),
        ("component.check_points", component.check_points),
        ("mate.targets", job.mate.targets),
    )


def _normals(job: JobFile) -> list[Finding]:
    findings = _unit("docking_axis", job.docking_axis)
    for group, targets in _measured(job):
        findings += chain.from_iterable(_unit(f"{group}[{i}].normal", t.normal) for i, t in enumerate(targets))
    return findings


def _layouts(job: JobFile) -> list[Finding]:
    component = job.component
    findings = []
    count = len(component.targets)
    if count < ADVISED_TARGETS:
        findings.append(warning("component.targets", f"{count} targets; {ADVISED_TARGETS} or more are advised"))
    if not component.check_points:
        findings.append(warning("component.check_points", "none: nothing outside the fit confirms the result"))
    figures = (
        ("component.targets", [t.xyz_mm for t in component.targets], "targets"),
        ("mate.targets", [t.xyz_mm for t in job.mate.targets], "targets"),
        ("component.features", [f.xyz_mm for f in component.features], "docking features"),
        ("component.balls", [b.xyz_mm for b in component.balls], "ball centres"),
    )
    return findings + [f for key, xyz_mm, what in figures for f in _layout(key, np.array(xyz_mm), what)]


def _permissives(cell: CellFile, job: JobFile) -> list[Finding]:
    offered = ", ".join(cell.permissives) or "none"
    return [
        error(f"stages[{i}].permissives[{j}]", f"{name!r} is not an input of this cell (it offers: {offered})")
        for i, stage in enumerate(job.stages)
        for j, name in enumerate(stage.permissives)
        if name not in cell.permissives
    ]


def _congruence(cell: CellFile, job: JobFile) -> list[Finding]:
    """The component's features must be able to meet those of the mate: same figure, not its mirror image."""
    component = feature_points(job.component, cell).xyz_mm
    mate = mate_feature_points(job.component, job.mate, cell).xyz_mm
    gap = np.linalg.norm(docked_in_mate(job, cell).apply(component) - mate, axis=1)
    limits = np.array([feature.tolerance_mm for feature in job.component.features])
    worst = int(np.argmax(gap - limits))
    if gap[worst] <= limits[worst]:
        return []
    mirrored = mirrored_rms_mm(component, mate) <= limits[worst]
    name = job.component.features[worst].name
    text = f"feature {name} stays {gap[worst]:.4g} mm off its mate point at best, tolerance {limits[worst]:g} mm"
    image = " (the mate is a mirror image)" if mirrored else ""
    return [error(f"component.features[{worst}].mate_xyz_mm", text + image)]


def _provable(cell: CellFile, job: JobFile) -> list[Finding]:
    """What can never be accepted, whatever the measured errors: a feature whose 2 sigma fill its tolerance, or features
    of which one is too likely out of tolerance even when no error is measured."""
    passes = job.measuring.max_passes
    instrument = f"with {passes} passes of the {cell.tracker.device_class}"
    budgets = feature_budget(cell, job, passes)
    findings = [
        error(
            f"component.features[{i}].tolerance_mm",
            f"{feature.tolerance_mm:g} mm for feature {feature.name} cannot be proved: 2 sigma = "
            f"{2.0 * feature.sigma_mm:.3g} mm {instrument}; {_remedy(feature)}",
        )
        for i, feature in enumerate(budgets)
        if not feature.provable
    ]
    risk = least_risk(cell, job, passes)
    if findings or risk <= RISK_LIMIT:
        return findings
    i, worst = max(enumerate(budgets), key=lambda item: item[1].sigma_mm / item[1].tolerance_mm)
    text = (
        f"{worst.tolerance_mm:g} mm for feature {worst.name} and its neighbours cannot be proved: even with no error "
        f"measured the risk that a feature is out of tolerance is {risk:.2%}, at most {RISK_LIMIT:.1%} is accepted "
        f"(2 sigma = {2.0 * worst.sigma_mm:.3g} mm {instrument}); {_remedy(worst)}"
    )
    return [error(f"component.features[{i}].tolerance_mm", text)]


def _remedy(feature: FeatureBudget) -> str:
    part, sigma = feature.largest
    return f"largest part {part}, sigma {sigma:.3g} mm: {REMEDIES[part]}"
