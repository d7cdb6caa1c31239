"""`docking layout`: tables, one JSON object or one page, for layouts that are enough and for those that are not."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.cli import call
from docking.config.budget import feature_budget
from docking.config.load import default_job_path, load_cell, load_job
from tests.support.program import CELLS, cell_copy

LAB = CELLS / "lab-can.toml"


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    code = call(["layout", *map(str, arguments), "--json"])
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    return code, json.loads(out)


@pytest.mark.parametrize("name", ["fuselage-can", "wing-modbus", "lab-can"])
@pytest.mark.parametrize("part", ["component", "mate"])
def test_every_reference_layout_is_enough(capsys: pytest.CaptureFixture[str], name: str, part: str) -> None:
    """The features' sigmas are those of `docking check`, whichever part is looked at."""
    path = CELLS / f"{name}.toml"
    code, found = told(capsys, path, "--part", part)
    assert (code, found["provable"], found["part"]) == (0, True, part)
    cell = load_cell(path)
    job = load_job(default_job_path(path), cell)
    budget = feature_budget(cell, job, job.measuring.passes)
    assert [f["sigma_mm"] for f in found["features"]] == pytest.approx([b.sigma_mm for b in budget])
    for feature in found["features"]:
        assert feature["left_mm"] == pytest.approx(feature["tolerance_mm"] - 2.0 * feature["sigma_mm"])
        assert feature["bound_mm"] > 2.0 * feature["sigma_mm"]
    assert all(t["change_without"] > 0.0 and t["detectable_mm"] > t["harm_mm"] > 0.0 for t in found["targets"])
    assert found["matters_most"] == max(found["targets"], key=lambda t: t["change_without"])["name"]
    gains = [extra["change"] for extra in found["extra"]]
    assert gains == sorted(gains)
    assert gains[0] < 0.0
    assert len(found["weak"]) == 6
    assert re.match(r"(rotation about|shift along) ", found["weak"][0]["words"])


def test_the_best_of_given_places_is_told_with_what_it_would_give(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The promised sigma is that of the job with the target added."""
    places = tmp_path / "places.csv"
    rows = ["near,-390,-250,-80", "far,430,240,160", "middle,0,-250,0"]
    places.write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n", "utf-8")
    _, found = told(capsys, LAB, "--candidates", places)
    assert [extra["name"] for extra in found["extra"]] == ["far", "middle", "near"]
    cell = load_cell(LAB)
    job = load_job(default_job_path(LAB), cell)
    more = job.component.targets[0].model_copy(
        update={"name": "far", "xyz_mm": (430.0, 240.0, 160.0), "reflector_offset_mm": 0.0}
    )
    wider = job.component.model_copy(update={"targets": (*job.component.targets, more)})
    sigma = {b.name: b.sigma_mm for b in feature_budget(cell, job.model_copy(update={"component": wider}), 2)}
    assert found["extra"][0]["sigma_mm"] == pytest.approx(sigma)


def test_a_layout_that_proves_too_little_is_told_and_exits_with_1(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """`docking check` refuses this job; `docking layout` shows what would help, and more passes do."""
    tight = cell_copy(tmp_path, "lab-can", (".job.toml", "tolerance_mm = 0.1", "tolerance_mm = 0.04"))
    assert call(["check", str(tight), "--json"]) == 2
    capsys.readouterr()
    code, found = told(capsys, tight, "--passes", 2)
    assert (code, found["provable"]) == (1, False)
    assert found["risk"] > 0.025
    assert call(["layout", str(tight)]) == 1
    assert "CANNOT be proved" in capsys.readouterr().out
    _, more = told(capsys, tight, "--passes", 20)
    assert np.all([m["sigma_mm"] < f["sigma_mm"] for m, f in zip(more["features"], found["features"], strict=True)])


def test_a_person_gets_tables_and_a_page(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page = tmp_path / "layout.html"
    assert call(["layout", str(CELLS / "fuselage-can.toml"), "--plot", str(page)]) == 0
    out = capsys.readouterr().out
    for words in ("nothing is measured", "rotation about X, ", "matters most: J", "grid-", "left for errors"):
        assert words in out
    html = page.read_text("utf-8")
    assert html.count("<svg") == 1
    assert "rotation about X" in html
    assert not re.search(r"(src|href)=\"(?!#)", html)
    assert "http" not in html


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--part", "tool"], 4004, "tool"),
        (["--passes", "0"], 4004, "0"),
        (["--candidates", "/nowhere/places.csv"], 4001, "/nowhere/places.csv"),
        (["--plot", "/nowhere/layout.html"], 4005, "/nowhere/layout.html"),
    ],
)
def test_a_wrong_call_is_named(capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, said: str) -> None:
    ended, found = told(capsys, LAB, *arguments)
    assert (ended, found["error"]["code"]) == (2, code)
    assert said in found["error"]["message"]


def test_a_candidate_that_is_a_target_already_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    places = tmp_path / "places.csv"
    places.write_text("name,x_mm,y_mm,z_mm\nJ01,0,0,0\n", "utf-8")
    ended, found = told(capsys, LAB, "--candidates", places)
    assert (ended, found["error"]["code"]) == (2, 4004)
    assert "J01" in found["error"]["message"]
