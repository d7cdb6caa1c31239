"""Counting, intervals, resuming, and the same result whatever the workers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import binomtest

import sim
from docking.errors import BadArgument
from docking.study.dock import StudyRequest, study_dock, study_text, summarise

LAB = Path(sim.__file__).parent / "cells" / "lab-can.toml"


def row(seed: int, outcome: str, true_mm: float | None = 0.05, **changed: Any) -> dict[str, Any]:
    known = true_mm is not None
    return {
        "seed": seed,
        "outcome": outcome,
        "tolerance_mm": 0.1,
        "true_max_feature_error_mm": true_mm,
        "feature_sigma_mm": 0.01 * seed if known else None,
        "virtual_time_s": 100.0 if known else None,
        "wall_time_s": 2.0 if known else None,
        "alarms": [],
        **changed,
    }


def silent(text: str) -> None:
    """Nobody listens to the progress."""


def test_outcomes_false_acceptances_and_false_refusals_are_counted() -> None:
    rows = [
        row(1, "docked", 0.03),
        row(2, "docked", 0.12),
        row(3, "docked", 0.1),
        row(4, "out_of_tolerance", 0.09),
        row(5, "out_of_tolerance", 0.2),
        row(6, "fault", 0.01, alarms=[{"code": 2003, "where": "A.X"}, {"code": 2003, "where": "B.X"}]),
        row(7, "refused", None, alarms=[{"code": 4001, "where": "cell"}]),
    ]
    result = summarise("lab", rows)
    assert (result["cell"], result["seeds"]) == ("lab", 7)
    assert result["outcomes"] == {"docked": 3, "out_of_tolerance": 2, "fault": 1, "refused": 1}
    assert (result["docked"]["count"], result["docked"]["of"]) == (3, 7)
    # Exactly at the tolerance is inside; false acceptance is counted per accepted run.
    assert (result["false_accepted"]["count"], result["false_accepted"]["of"]) == (1, 3)
    assert result["false_accepted_seeds"] == [2]
    # A fault is no judgement of the features: only a decision against a good part is a false refusal.
    assert (result["false_refused"]["count"], result["false_refused"]["of"]) == (1, 7)
    assert result["not_docked_seeds"] == [4, 5, 6, 7]
    assert result["worst_true_error_docked_mm"] == 0.12
    assert result["median_true_error_docked_mm"] == 0.1
    assert result["median_speed"] == 50.0
    assert result["alarm_codes"] == {"2003": 2, "4001": 1}


def test_an_unknown_true_error_of_a_docked_run_is_not_taken_for_a_good_one() -> None:
    result = summarise("lab", [row(1, "docked", float("nan"))])
    assert result["false_accepted"]["count"] == 1


@pytest.mark.parametrize(("bad", "good"), [(0, 300), (1, 299), (7, 293), (150, 150), (299, 1), (300, 0)])
def test_intervals_are_the_exact_ones(bad: int, good: int) -> None:
    rows = [row(i, "docked", 0.2 if i < bad else 0.05) for i in range(bad + good)]
    share = summarise("lab", rows)["false_accepted"]
    exact = binomtest(bad, bad + good).proportion_ci(0.95)
    assert share["share"] == bad / (bad + good)
    assert share["low"] == pytest.approx(exact.low, abs=1e-12)
    assert share["high"] == pytest.approx(exact.high, abs=1e-12)


def test_a_study_without_a_docked_run_has_words_too() -> None:
    result = {"cells": [summarise("lab", [row(1, "refused", None)])]}
    assert result["cells"][0]["false_accepted"]["share"] is None
    assert result["cells"][0]["median_speed"] is None
    assert "none to judge" in study_text(result)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


@pytest.mark.parametrize("numbers", [{"seeds": 0}, {"seeds": 1, "workers": 0}, {"seeds": 1, "workers": -2}])
def test_no_seeds_and_no_workers_are_refused(numbers: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(BadArgument):
        study_dock(StudyRequest(cells=(LAB,), out=tmp_path, **numbers), silent)


def stored(out: Path) -> list[dict[str, Any]]:
    (path,) = out.glob("*.jsonl")
    rows = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    return sorted(rows, key=lambda found: int(found["seed"]))


def without_wall_time(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in found.items() if key != "wall_time_s"} for found in rows]


def study(out: Path, workers: int, seeds: int = 2) -> dict[str, Any]:
    result = study_dock(StudyRequest(cells=(LAB,), seeds=seeds, out=out, workers=workers), silent)
    (cell,) = result["cells"]
    return {key: value for key, value in cell.items() if key != "median_speed"}


def test_one_and_two_workers_give_the_same_and_a_cut_line_is_done_again(tmp_path: Path) -> None:
    alone = study(tmp_path / "one", workers=1)
    assert alone["outcomes"] == {"docked": 2}
    assert study(tmp_path / "two", workers=2) == alone
    rows = stored(tmp_path / "one")
    assert without_wall_time(stored(tmp_path / "two")) == without_wall_time(rows)
    assert rows[0] != rows[1]

    # Cut inside the alarms, where the rest of the line would end with a brace of its own.
    (path,) = (tmp_path / "one").glob("*.jsonl")
    first, second = path.read_text("utf-8").splitlines()
    path.write_text(f'{first}\n{second[:-2]}{{"code": 1}}', "utf-8")
    assert study(tmp_path / "one", workers=2) == alone
    kept, again = stored(tmp_path / "one")
    assert kept == rows[0], "a whole line is not done again"
    assert without_wall_time([again]) == without_wall_time(rows[1:])
    lines = path.read_text("utf-8")
    assert study(tmp_path / "one", workers=1, seeds=1)["seeds"] == 1
    assert path.read_text("utf-8") == lines, "nothing was missing"


def test_another_option_is_another_study(tmp_path: Path) -> None:
    tight = StudyRequest(cells=(LAB,), seeds=1, out=tmp_path, workers=1, tolerance_mm=0.001)
    (result,) = study_dock(tight, silent)["cells"]
    assert result["docked"]["count"] == 0
    assert study(tmp_path, workers=1, seeds=1)["docked"]["count"] == 1
    assert len(list(tmp_path.glob("lab-can.*.jsonl"))) == 2
