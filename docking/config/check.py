"""`docking check`: load both files with all their checks, and say what was found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docking.config.budget import feature_budget, least_risk
from docking.config.build import positioners_from, rank_settings
from docking.config.cell import CellFile
from docking.config.cross_check import check_cell, check_job
from docking.config.describe import describe
from docking.config.findings import Finding, Severity
from docking.config.job import JobFile
from docking.config.load import default_job_path, file_sha256, load_cell, load_job
from docking.config.torque_off import strain_json
from docking.errors import BadMesh, ConfigInvalid, FileUnreadable
from docking.guidance.mesh import read_mesh
from docking.kinematics import conditioning

__all__ = ["CheckResult", "check_cell", "check_files", "check_job"]


@dataclass(frozen=True)
class CheckResult:
    """Two files that passed their checks, with the warnings: (file, finding)."""

    cell_path: Path
    job_path: Path
    cell: CellFile
    job: JobFile
    warnings: tuple[tuple[Path, Finding], ...]

    @property
    def text(self) -> str:
        """The summary for people, warnings last."""
        lines = [f"warning: {path.name}: {finding}" for path, finding in self.warnings]
        return "\n".join([describe(self.cell, self.job), "", *(lines or ["no warnings"])])

    def as_json(self) -> dict[str, Any]:
        """The same facts for programs."""
        return {
            "ok": True,
            "cell": {"path": str(self.cell_path), "sha256": file_sha256(self.cell_path), "name": self.cell.name},
            "job": {
                "path": str(self.job_path),
                "sha256": file_sha256(self.job_path),
                "part_number": self.job.part_number,
                "serial_number": self.job.serial_number,
            },
            "axes": list(self.cell.axis_names),
            "driven": [name for name, on in zip(self.cell.axis_names, self.cell.driven, strict=True) if on],
            "held_n": {
                f"{p.name}.{axis.name}": axis.force_n
                for p in self.cell.positioners
                for axis in p.axes
                if axis.force_n is not None
            },
            **self._held(),
            **strain_json(self.cell, self.job),
            "features": [
                {
                    "name": budget.name,
                    "tolerance_mm": budget.tolerance_mm,
                    "expected_sigma_mm": budget.sigma_mm,
                    "parts_mm": dict(budget.parts_mm),
                }
                for budget in feature_budget(self.cell, self.job, self.job.measuring.max_passes)
            ],
            "expected_risk": least_risk(self.cell, self.job, self.job.measuring.max_passes),
            "warnings": [{"file": str(path), "key": f.key, "text": f.text} for path, f in self.warnings],
        }

    def _held(self) -> dict[str, Any]:
        found = conditioning(positioners_from(self.cell, self.job), rank_settings(self.cell))
        return {"redundancy": found.redundancy, "condition": found.condition}


def check_files(cell_path: Path, job_path: Path | None = None) -> CheckResult:
    """Check a CELL file and its JOB file (default: NAME.job.toml beside it).

    Raises FileUnreadable, or ConfigInvalid with every error of the cell, else of the job.
    """
    cell = load_cell(cell_path)
    job_path = default_job_path(cell_path) if job_path is None else job_path
    job = load_job(job_path, cell)
    _check_meshes(job, job_path)
    found = [(cell_path, f) for f in check_cell(cell)] + [(job_path, f) for f in check_job(cell, job)]
    warnings = tuple((path, f) for path, f in found if f.severity is Severity.WARNING)
    return CheckResult(cell_path, job_path, cell, job, warnings)


def _check_meshes(job: JobFile, job_path: Path) -> None:
    """Every mesh of the work instructions is there and can be drawn: a missing one would show at the machine only."""
    problems = []
    for k, step in enumerate(job.instructions):
        if step.mesh is not None:
            try:
                read_mesh(job_path.parent / step.mesh)
            except (FileUnreadable, BadMesh) as refused:
                problems.append(f"instructions[{k}].mesh: {refused.text().splitlines()[0]}")
    if problems:
        raise ConfigInvalid(str(job_path), tuple(problems))
