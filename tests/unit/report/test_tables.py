"""Rows, numbers and traces of the report."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from docking.motion.lateness import Lateness
from docking.report.figures import inline
from docking.report.run import Move, Run
from docking.report.tables import (
    check_rows,
    displacement_blocks,
    end_difference,
    feature_rows,
    lateness_rows,
    maxima_rows,
    natural,
    plan_rows,
    pose_of,
    risk_row,
    stage_rows,
)
from docking.report.traces import envelope, track
from docking.report.words import clock, css_string, number, plain, signed


def test_a_feature_is_inside_up_to_its_tolerance_and_no_further() -> None:
    body = {
        "names": ["at", "over", "unknown"],
        "error_mm": [[0.06, 0.08, 0.0], [0.0, 0.0, -0.1], [0.0, 0.0, 0.0]],
        "sigma_mm": [0.05, 0.0501, None],
        "tolerance_mm": [0.2, 0.2, 0.2],
        "risk": 0.025,
    }
    at, over, unknown = feature_rows(body)
    assert at["e_mm"] == pytest.approx(0.1)
    assert at["e2s_mm"] == pytest.approx(0.2)
    assert at["inside"]
    assert over["margin_mm"] == pytest.approx(-0.0002)
    assert not over["inside"]
    assert not unknown["inside"]


@pytest.mark.parametrize("risk", [0.0251, None, float("nan")])
def test_no_feature_is_inside_where_the_risk_of_all_is_too_high_or_unknown(risk: float | None) -> None:
    body = {"names": ["F"], "error_mm": [[0.01, 0, 0]], "sigma_mm": [0.05], "tolerance_mm": [0.2], "risk": risk}
    (row,) = feature_rows(body)
    assert row["within"]
    assert not row["inside"]
    assert not risk_row(body)["holds"]


def test_risk_is_told_in_percent() -> None:
    assert risk_row({"risk": 0.0123}) == {"percent": pytest.approx(1.23), "limit_percent": 2.5, "holds": True}


def test_a_check_point_with_an_unknown_error_disagrees() -> None:
    rows = check_rows({"names": ["K1", "K2"], "error_mm": [[0.1, 0.0, 0.0], None], "limit_mm": [0.12, 0.12]})
    assert [row["agrees"] for row in rows] == [True, False]
    assert check_rows({"names": ["K1"], "error_mm": [0.1], "limit_mm": None})[0]["agrees"] is None


def test_a_stage_begins_with_the_last_judgement_before_it() -> None:
    def judged(stage: str, when: str, e_mm: float) -> dict[str, object]:
        error = {"names": ["F"], "error_mm": [[e_mm, 0, 0]], "sigma_mm": [0], "tolerance_mm": [1]}
        return {"kind": "features", "body": {"stage": stage, "when": when, **error}}

    stages = [("a", "before", 9.0), ("a", "after", 5.0), ("a", "after", 4.0), ("b", "after", 2.0)]
    run = Run([judged(*row) for row in stages])
    assert [s["meets"] for s in stage_rows(run)] == [False, False]
    shown = [(s["stage"], s["rows"][0]["before"]["e_mm"], s["rows"][0]["after"]["e_mm"]) for s in stage_rows(run)]
    assert shown == [("a", 9.0, 4.0), ("b", 4.0, 2.0)]


def test_pose_of_a_matrix_uses_the_house_angles() -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZYX", [30.0, -20.0, 10.0], degrees=True).as_matrix()
    matrix[:3, 3] = [1.0, 2.0, 3.0]
    pose = pose_of(matrix.tolist())
    assert [pose["x_mm"], pose["y_mm"], pose["z_mm"]] == [1.0, 2.0, 3.0]
    assert [pose["alpha_deg"], pose["beta_deg"], pose["gamma_deg"]] == pytest.approx([10.0, -20.0, 30.0])
    assert pose_of(None) == {}


def made_move(number_: int, start_mm: list[float], finished: bool = True) -> Move:
    trace = {
        "t_s": [10.0, 11.0, 12.0],
        "path_time_s": [0.0, 1.0, 2.0 if finished else 1.5],
        "position_mm": {"A.X": start_mm},
        "residual_mm": [0.0, None, 0.2],
    }
    plan = {"plan_hash": f"h{number_}", "displacement_mm": {"A.X": 5.0}, "duration_s": 2.0}
    return Move(number_, plan, {"plan_hash": f"h{number_}", "trace": trace})


def test_end_difference_compares_read_back_with_plan() -> None:
    assert end_difference(made_move(1, [100.0, 102.0, 104.75])) == pytest.approx(0.25)
    assert math.isnan(end_difference(made_move(1, [100.0, 102.0, 104.0], finished=False)))
    assert math.isnan(end_difference(Move(1, {}, {})))


def test_the_measured_force_nearest_to_its_limit_is_shown() -> None:
    forces = {"A.X": [10.0, -45.0, 20.0], "A.Z": [400.0, 380.0, None], "B.Z": [None, None, None]}
    move = Move(1, {}, {"trace": {"force_n": forces}})
    (row,) = maxima_rows([move], {"A.X": 50.0, "A.Z": 1000.0, "B.Z": 1.0})
    assert (row["axis_force_n"], row["axis_limit_n"], row["force_axis"]) == (45.0, 50.0, "A.X")
    (unknown,) = maxima_rows([Move(1, {}, {})], {})
    assert math.isnan(unknown["axis_force_n"])


def test_displacements_come_in_blocks_that_fit_the_page() -> None:
    moves = [made_move(i + 1, [0.0, 0.0, 5.0]) for i in range(20)]
    blocks = displacement_blocks(moves, ["A.X", "A.Y"], width=9)
    assert [len(block["moves"]) for block in blocks] == [9, 9, 2]
    assert blocks[2]["rows"][0] == {"axis": "A.X", "values": [5.0, 5.0]}
    assert blocks[2]["rows"][1]["values"] == [None, None]


def test_plans_tell_smallest_margins_confirmation_and_end() -> None:
    def record(seq: int, kind: str, **body: object) -> dict[str, object]:
        return {"seq": seq, "kind": kind, "t_mono_s": float(seq), "body": body}

    margins = [["A.X", 30.0, 2.0], ["B.Z", 12.5, 3.0], ["C.Y", None, 0.5]]
    run = Run(
        [
            record(0, "plan", plan_hash="a", margins=margins, correction={"shift_mm": [3.0, 0.0, 4.0]}),
            record(1, "plan", plan_hash="b"),
            record(2, "confirm", plan_hash="a", go=True),
            record(3, "moved", plan_hash="a", result="done"),
            record(4, "confirm", plan_hash="b", go=False),
        ]
    )
    first, second = plan_rows(run)
    assert (first["stroke_margin"], first["speed_margin"]) == ("12.50 mm (B.Z)", "0.50 mm/s (C.Y)")
    assert first["shift_mm"] == 5.0
    assert (first["confirmed"], first["result"]) == (True, "done")
    assert (second["confirmed"], second["result"]) == (False, None)


def test_moves_are_laid_end_to_end_with_gaps_between() -> None:
    found = track([made_move(1, [0.0, 1.0, 5.0]), Move(2, {}, {"trace": {}}), made_move(3, [5.0, 6.0, 10.0])])
    assert found is not None
    assert (found.starts_s, found.ends_s) == ((0.0, 2.0), (2.0, 4.0))
    t, v = found.line("position_mm", "A.X")
    np.testing.assert_array_equal(t, [0, 1, 2, 2, 2, 3, 4, 4])
    np.testing.assert_array_equal(v, [0, 1, 5, np.nan, 5, 6, 10, np.nan])
    np.testing.assert_array_equal(found.line("residual_mm")[1][:3], [0.0, np.nan, 0.2])
    assert found.line("force_n", "A.X")[0].size == 0
    assert track([]) is None


def test_thinning_keeps_every_extreme() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=5000)
    values[1234], values[4321], values[777] = 50.0, -60.0, np.nan
    kept = envelope(values, 200)
    assert len(kept) <= 202
    assert np.all(np.diff(kept) > 0)
    assert {0, 1234, 4321, 4999} <= set(kept.tolist())
    np.testing.assert_array_equal(envelope(values[:100], 200), np.arange(100))
    assert len(envelope(np.full(1000, np.nan), 50)) <= 52


def test_numbers_as_people_read_them() -> None:
    assert number(12345.6789, 2) == "12\u202f345.68"
    assert number(-0.5) == "−0.500"
    assert number(-0.0001) == "0.000"
    assert signed(0.25) == "+0.250"
    assert signed(-0.25) == "−0.250"
    assert signed(0.0001) == "0.000"
    assert [number(v) for v in (None, float("nan"), "1", True)] == ["–"] * 4
    assert [plain(v) for v in (None, "", "a", 0.5, -1500.0, 3)] == ["–", "–", "a", "0.5", "−1500", "3"]
    assert [clock(s) for s in (0.4, 61, 3725.0, None)] == ["0:00:00", "0:01:01", "1:02:05", "–"]
    assert sorted(["T10", "T2", "A", "T1"], key=natural) == ["A", "T1", "T2", "T10"]
    assert css_string('a"\\<') == "a\\000022\\00005c\\00003c"


def test_an_inlined_picture_keeps_its_words_and_parts_its_ids() -> None:
    source = (
        '<?xml version="1.0"?><!DOCTYPE svg><svg xmlns:xlink="http://x" width="9pt" height="8pt" viewBox="0 0 9 8" '
        'xmlns="http://y"><metadata>http://z</metadata><defs><path id="m1" d="M 1.23456 -0.98765"/></defs>'
        '<use xlink:href="#m1" clip-path="url(#m1)"/><text x="1.5000">0.0075</text></svg>'
    )
    assert inline(source, "p") == (
        '<svg viewBox="0 0 9 8"><defs><path id="p-m1" d="M 1.23 -0.99"/></defs>'
        '<use href="#p-m1" clip-path="url(#p-m1)"/><text x="1.50">0.0075</text></svg>'
    )


def test_lateness_is_counted_in_classes() -> None:
    """Classes that end at a bound lie under it; what is over the last bound is at the end."""
    counted = Lateness()
    for late_s in (5e-6, 5e-5, 5e-4, 5e-3, 0.05, 0.5, 0.6):
        counted.add(late_s)
    record = {"kind": "run_lateness", "body": counted.as_record()}
    (row,) = lateness_rows(Run([record]))
    assert row["counts"] == [2, 1, 1, 1, 2]
    assert (row["kind"], row["samples"]) == ("run_lateness", 7)
    assert row["max_ms"] == pytest.approx(600.0)
    assert row["p50_ms"] == pytest.approx(5.0, rel=0.13)
