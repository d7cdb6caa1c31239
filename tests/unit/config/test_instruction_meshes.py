"""`docking check` opens the meshes of the work instructions: a missing one would show only at the machine."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import sim
from docking.config.check import check_files
from docking.errors import ConfigInvalid

CELLS = Path(sim.__file__).parent / "cells"
INSTRUCTION = """
[[instructions]]
name = "fit-bracket"
order = 1
text_en = "Fit the bracket"
text_zh = "安装支架"
frame = "component"
pose = [300.0, 0.0, 170.0, 0.0, 0.0, 0.0]
mesh = "bracket.stl"
"""
BRACKET = "solid b\nfacet normal 0 0 1 outer loop vertex 0 0 0 vertex 9 0 0 vertex 0 9 0 endloop endfacet\nendsolid b\n"


def cell_with_instruction(folder: Path) -> Path:
    for name in ("lab-can.toml", "lab-can.job.toml"):
        shutil.copy(CELLS / name, folder / name)
    job = folder / "lab-can.job.toml"
    job.write_text(job.read_text("utf-8") + INSTRUCTION, "utf-8")
    return folder / "lab-can.toml"


def test_a_mesh_beside_the_job_passes(tmp_path: Path) -> None:
    cell = cell_with_instruction(tmp_path)
    (tmp_path / "bracket.stl").write_text(BRACKET)
    assert check_files(cell).job.instructions[0].mesh == "bracket.stl"


@pytest.mark.parametrize(("content", "says"), [(None, "cannot be read"), ("not a mesh", "not a mesh")])
def test_a_missing_or_damaged_mesh_names_its_step(tmp_path: Path, content: str | None, says: str) -> None:
    cell = cell_with_instruction(tmp_path)
    if content is not None:
        (tmp_path / "bracket.stl").write_text(content)
    with pytest.raises(ConfigInvalid) as refused:
        check_files(cell)
    (problem,) = refused.value.problems
    assert problem.startswith("instructions[0].mesh: ")
    assert says in problem
