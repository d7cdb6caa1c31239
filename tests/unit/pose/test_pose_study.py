"""The paper's study with few draws: every bar, widened by the sampling error of so few; and what it says of itself."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.cli import call
from docking.errors import BadArgument
from docking.pose.batch import fit_poses, three_point_poses
from docking.pose.three_point import fit_three_point
from docking.study.pose import bars, study_pose
from docking.study.pose.bars import FULL_DRAWS, Bar, allowance
from docking.study.pose.claims import claims
from docking.study.pose.layouts import BARREL, BOX, LAYOUTS, blocks
from docking.study.pose.page import write_study
from docking.study.pose.table import fitting_error_mm, rms_ratios

DRAWS = 200


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return study_pose(DRAWS, 1, lambda text: None)


def test_every_bar_holds(result: dict[str, Any]) -> None:
    missed = [bar for bar in result["bars"] if not bar["held"]]
    assert missed == []
    assert len(result["bars"]) > 40
    assert result["held"] is True


def test_a_full_run_is_held_to_the_bars_themselves() -> None:
    assert allowance(FULL_DRAWS, 1.0) == 0.0
    assert allowance(100, 1.0) > 0.3
    assert not Bar("a figure that is missing", float("nan"), 0.0, 1.0).held


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("bound", 1, "nees"), 7.5),
        (("bound", 1, "ml", "rotation"), 1.2),
        (("table", 0, "svd", "mean"), 0.40),
        (("table", 0, "ratio_of_means"), 1.32),
        (("table", 0, "least_squares_gap_mm"), 1e-8),
        (("noiseless_mm", "svd"), 1e-3),
        (("sizes", "layouts", "wing", "converged"), 0.9),
    ],
)
def test_a_wrong_figure_misses_its_bar(result: dict[str, Any], path: tuple[Any, ...], value: float) -> None:
    spoiled = deepcopy(result)
    at: Any = spoiled
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    assert sum(not bar.held for bar in bars(spoiled)) == 1


def test_verdicts_on_the_paper(result: dict[str, Any]) -> None:
    verdicts = {claim.paper.split(":")[0] + str(k): claim.verdict for k, claim in enumerate(claims(result))}
    assert list(verdicts.values()) == [
        "holds", "does not hold", "holds", "does not hold", "holds", "in part", "holds", "does not hold",
        "does not hold", "in part",
    ]  # fmt: skip


def test_page_stands_alone(result: dict[str, Any], tmp_path: Path) -> None:
    page = write_study(result, tmp_path / "study").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "")
    assert page.count("<svg") == 4
    for figure in ("0.400", "0.529", "0.401", "All "):
        assert figure in page
    assert {p.name for p in (tmp_path / "study").iterdir()} == {
        "pose.html", "pose.json", "table-1.svg", "figure-2.svg", "figure-3.svg", "starts.svg",
    }  # fmt: skip
    assert json.loads((tmp_path / "study" / "pose.json").read_text())["held"] is True


def test_command_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadArgument):
        study_pose(10, 1, print)
    out = ["--out", str(tmp_path / "study"), "--json"]
    for wrong in (["--draws", "10"], ["--seed", "-1"]):
        assert call(["study", "pose", *wrong, *out]) == 2
        assert json.loads(capsys.readouterr().out)["error"]["code"] == 4004
    (tmp_path / "study" / "file").write_text("")
    assert call(["study", "pose", "--out", str(tmp_path / "study" / "file"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == 4005


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_three_points_of_many_epochs_are_the_single_fits(layout: Any) -> None:
    rng = np.random.default_rng(3)
    block = next(blocks(layout, 20, rng))
    p = block.measured_mm(0.5)
    many = three_point_poses(block.nominal_mm, p, (4, 1, 7))
    for k in range(20):
        one = fit_three_point(block.nominal_mm, p[k], (4, 1, 7))
        assert np.allclose(many.R[k], one.R, atol=1e-12)
        assert np.allclose(many.t_mm[k], one.t_mm, atol=1e-7)


def test_fitting_error_counts_against_the_true_points() -> None:
    """[Luo] Eq. 16: a shift of all readings is an error of the pose, not a residual."""
    block = next(blocks(BARREL, 4, np.random.default_rng(5)))
    shifted = np.broadcast_to(block.X.apply(block.nominal_mm) + np.array([0.3, 0.0, -0.4]), (4, 10, 3))
    assert fitting_error_mm(block, fit_poses(block.nominal_mm, shifted)) == pytest.approx(np.full(4, 0.5), abs=1e-9)


@pytest.mark.full
def test_every_bar_in_full() -> None:
    result = study_pose(FULL_DRAWS, 2, lambda text: None)
    assert [bar for bar in result["bars"] if not bar["held"]] == []


@pytest.mark.full
def test_rms_in_full() -> None:
    for n, ratio in rms_ratios(range(3, 21), FULL_DRAWS, np.random.default_rng(9), BOX).items():
        assert 0.98 <= ratio <= 1.02, n
