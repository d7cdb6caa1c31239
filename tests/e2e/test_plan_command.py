"""`docking plan`: the moves of a job as tables, one JSON object or one page, without anything being connected."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from docking.cli import call
from tests.support.program import CELLS, cell_copy

LAB = CELLS / "lab-can.toml"
NAMES = (
    "fuselage-can", "fuselage-modbus", "follower-can", "follower-force-can", "wing-modbus", "lab-can", "lab-modbus",
)  # fmt: skip


def planned(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    code = call(["plan", *map(str, arguments), "--json"])
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    return code, json.loads(out)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("start", [[], ["--seed", "4"]])
def test_every_reference_job_can_be_planned(capsys: pytest.CaptureFixture[str], name: str, start: list[str]) -> None:
    code, told = planned(capsys, CELLS / f"{name}.toml", *start)
    assert code == 0
    assert told["cell"] == name
    assert [stage["standoff_mm"] for stage in told["stages"]][-1] == 0.0
    assert told["duration_s"] == pytest.approx(sum(stage["duration_s"] for stage in told["stages"]))
    for stage in told["stages"]:
        bounds = stage["bounds"]
        assert max(bounds["peak_mm_s"].values()) <= stage["asked_mm_s"] * 1.05
        assert bounds["clearance_mm"] >= bounds["clearance_asked_mm"]
        assert bounds["limits"][0][0] == stage["speed_limited_by"] or stage["speed_limited_by"] == "standstill"
    approach = told["stages"][1]
    gap = told["stages"][0]["standoff_mm"] - approach["standoff_mm"]
    along = "A.Y" if name == "wing-modbus" and abs(approach["displacement_mm"]["A.Y"]) > 0.5 * gap else "A.X"
    assert abs(approach["displacement_mm"][along]) == pytest.approx(gap, rel=0.01)


def test_the_start_is_told_or_drawn(capsys: pytest.CaptureFixture[str]) -> None:
    """+3 mm in Y at the start is -3 mm for every Y axis on the way to the first station."""
    _, told = planned(capsys, LAB, "--from", "0,3,0,0,0,0")
    assert told["start_offset"]["y_mm"] == 3.0
    moved = told["stages"][0]["displacement_mm"]
    assert [moved[f"{p}.Y"] for p in "ABCD"] == pytest.approx([-3.0] * 4, abs=0.02)
    drawn = [planned(capsys, LAB, "--seed", seed)[1] for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert 0.0 < max(abs(v) for v in list(drawn[0]["start_offset"].values())[:3]) <= 6.0


def test_a_person_gets_tables_and_a_page(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page = tmp_path / "plan.html"
    assert call(["plan", str(LAB), "--from", "2,-1,1,0.1,0,-0.2", "--plot", str(page)]) == 0
    out = capsys.readouterr().out
    for words in ("nothing is connected", "approach-3: stand-off 3 mm", "speed set by", "jammed N", "C.Y", "mate: "):
        assert words in out
    assert out.count("A.X ") == 3
    html = page.read_text("utf-8")
    assert html.count("<svg") == 3
    for label in (
        "position / mm",
        "speed / mm/s",
        "acceleration / mm/s²",
        "jammed: force / N",
        "jammed: warp / N",
        ">A.X<",
    ):
        assert label in html
    assert not re.search(r"(src|href)=\"(?!#)", html)
    assert "http" not in html


def test_a_refused_move_says_what_would_fit(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, told = planned(capsys, LAB, "--from", "0,0,0,0,0,16")
    error = told["error"]
    assert (code, error["code"], error["where"]) == (1, 5001, "D.X")
    assert error["value"] < error["limit"] == -24.0
    assert "s = " in error["message"]
    stiff = cell_copy(tmp_path, "lab-can", (".toml", "internal_force_n = 150.0", "internal_force_n = 20.0"))
    code, told = planned(capsys, stiff)
    assert (code, told["error"]["code"]) == (1, 5012)
    assert "jammed: internal force" in told["error"]["where"]
    assert "would fit" in told["error"]["message"]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--from", "1,2,3"], 4004, "six numbers"),
        (["--from", "1,2,3,4,5,nan"], 4004, "six numbers"),
        (["--from", "a,b,c,d,e,f"], 4004, "six numbers"),
        (["--from", "0,0,0,0,0,0", "--seed", "1"], 4004, "either"),
        (["--plot", "/nowhere/plan.html"], 4005, "/nowhere/plan.html"),
    ],
)
def test_a_wrong_call_is_named(capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, said: str) -> None:
    ended, told = planned(capsys, LAB, *arguments)
    assert (ended, told["error"]["code"]) == (2, code)
    assert said in told["error"]["message"]
