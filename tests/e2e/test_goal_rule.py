"""A job says how its goal is found: minimax and locks dock in simulation and stand in journal and report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from docking.cli import call
from docking.journal import read
from tests.support.program import cell_copy

MINIMAX = (".job.toml", 'start = "seated"', 'start = "seated"\ngoal = "minimax"')
WARPED = (".job.toml", "mate_xyz_mm = [0.0, 150.0, 100.0]", "mate_xyz_mm = [0.04, 150.0, 100.0]")
"""One corner of the mate as measured: 0.04 mm before the plane of the others."""


def locked(locks: str, pose: str) -> tuple[str, str, str]:
    told = f'start = "seated"\ngoal_locks = {locks}\ndocked_pose = {pose}'
    return ".job.toml", 'start = "seated"', told


def test_a_minimax_goal_docks_and_is_reported(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The warp of one corner is shared by all four, and no corner has more than a quarter of it."""
    cell = cell_copy(tmp_path, "lab-can", MINIMAX, WARPED)
    page = tmp_path / "report.html"
    assert call(["dry-run", str(cell), "--report", str(page), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["true_max_feature_error_mm"] < 0.1
    goals = [record["body"] for record in read(page.with_name("report.journal.jsonl")) if record["kind"] == "goal"]
    assert [goal["stage"] for goal in goals][-1] == "dock"
    for goal in goals:
        assert goal["rule"] == "minimax"
        assert goal["misfit_mm"] == pytest.approx([0.01] * 4, abs=0.004)
        assert max(goal["share"]) - min(goal["share"]) < 1e-4
    assert "minimax: the largest error in tolerances is smallest" in page.read_text("utf-8")


def test_a_locked_degree_of_freedom_stays_as_designed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The design has the component 0.02 mm high: with z locked that is left at every feature, and it still docks."""
    cell = cell_copy(tmp_path, "lab-can", locked('["z"]', "[-450.0, 0.0, 0.02, 0.0, 0.0, 0.0]"))
    page = tmp_path / "report.html"
    assert call(["dry-run", str(cell), "--report", str(page), "--json"]) == 0
    capsys.readouterr()
    goals = [record["body"] for record in read(page.with_name("report.journal.jsonl")) if record["kind"] == "goal"]
    assert (goals[-1]["rule"], goals[-1]["locks"]) == ("least-squares", ["z"])
    assert goals[-1]["misfit_mm"] == pytest.approx([0.02] * 4, abs=0.004)
    assert "not decided by the features" in page.read_text("utf-8")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (locked('["z"]', "[-450.0, 0.0, 1.0, 0.0, 0.0, 0.0]"), "stays 1 mm off its mate point"),
        (locked('["z", "z"]', "[-450.0, 0.0, 0.0, 0.0, 0.0, 0.0]"), "degree of freedom"),
        (locked('["roll"]', "[-450.0, 0.0, 0.0, 0.0, 0.0, 0.0]"), "roll"),
        ((".job.toml", 'start = "seated"', 'start = "seated"\ngoal = "best"'), "best"),
    ],
)
def test_a_goal_that_cannot_be_is_refused_before_anything_moves(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, change: tuple[str, str, str], said: str
) -> None:
    assert call(["check", str(cell_copy(tmp_path, "lab-can", change)), "--json"]) == 2
    assert any(said in problem for problem in json.loads(capsys.readouterr().out)["error"]["problems"])
