"""`docking dry-run` on the reference cells: docked and true, told in full, the same every time."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking import cli
from docking.journal import read, verify
from docking.state import State
from tests.support.dry_cell import CELLS, DryCell, run_dry

NAMES = ("fuselage-can", "fuselage-modbus", "follower-can", "wing-modbus", "lab-can", "lab-modbus")
SEEDS = (1, 2, 3)
CASES = [*((name, seed) for name in NAMES for seed in SEEDS), ("follower-force-can", 1)]
KEYS = {
    "outcome",
    "tolerance_mm",
    "max_feature_error_mm",
    "feature_sigma_mm",
    "true_max_feature_error_mm",
    "moves",
    "rejected_points",
    "max_consistency_residual_mm",
    "max_internal_force_n",
    "virtual_time_s",
    "wall_time_s",
    "alarms",
    "report",
}
TOLERANCE_MM = {"wing-modbus": 1.5, "lab-can": 0.1, "lab-modbus": 0.1}
RATED_MM = 0.2


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_the_reference_cell_docks_inside_its_tolerance(name, seed, tmp_path, capsys):
    report, journal = tmp_path / "report.html", tmp_path / "run.jsonl"
    asked = ["dry-run", str(CELLS / f"{name}.toml"), "--seed", str(seed), "--json"]
    code = cli.call([*asked, "--report", str(report), "--journal", str(journal)])
    out = capsys.readouterr().out
    told = json.loads(out)
    assert out.count("\n") == 1, "one object on one line"
    assert (told["outcome"], code) == ("docked", 0)
    assert set(told) == KEYS
    assert_figures(told, TOLERANCE_MM.get(name, RATED_MM))
    chain = verify(journal)
    records = read(journal)
    assert chain.torn_bytes == 0
    assert records[-1]["kind"] == "outcome"
    assert records[-1]["body"] == told
    assert_intents_and_confirmations(records)
    assert told["report"] == str(report)
    assert_self_contained(report.read_text("utf-8"), records)


def assert_figures(told: dict[str, Any], tolerance_mm: float) -> None:
    assert told["tolerance_mm"] == tolerance_mm
    assert told["true_max_feature_error_mm"] <= tolerance_mm
    assert told["max_feature_error_mm"] + 2.0 * told["feature_sigma_mm"] <= tolerance_mm
    assert told["feature_sigma_mm"] > 0.0
    # What the controller believes and what is so lie no further apart than its own sigma explains.
    assert told["true_max_feature_error_mm"] <= told["max_feature_error_mm"] + 4.0 * told["feature_sigma_mm"]
    assert told["moves"] >= 2
    assert told["virtual_time_s"] > told["wall_time_s"] > 0.0
    assert 0.0 < told["max_consistency_residual_mm"] <= 0.1
    assert told["max_internal_force_n"] > 0.0
    assert told["alarms"] == []
    assert isinstance(told["rejected_points"], list)


def assert_intents_and_confirmations(records: list[dict[str, Any]]) -> None:
    """Each move: its plan, a go for that very plan, its durable intent, its result, in this order."""
    order = [r for r in records if r["kind"] in ("plan", "confirm", "intent", "moved")]
    assert len(order) % 4 == 0
    for i in range(0, len(order), 4):
        assert [r["kind"] for r in order[i : i + 4]] == ["plan", "confirm", "intent", "moved"]
        assert len({r["body"]["plan_hash"] for r in order[i : i + 4]}) == 1
        assert order[i + 1]["body"]["go"] is True
        assert order[i + 3]["body"]["result"] == "done"


def assert_self_contained(page: str, records: list[dict[str, Any]]) -> None:
    """One file that fetches nothing and names the run that it is about."""
    assert page.lstrip().lower().startswith("<!doctype html")
    for reference in re.findall(r"""(?:src|href)\s*=\s*["']([^"']+)""", page):
        assert reference.startswith(("data:", "#")), reference
    assert not re.search(r"""url\(\s*["']?(?!["']?(?:data:|#))""", page)
    assert "<script src" not in page
    assert "@import" not in page
    started = records[0]["body"]
    for fact in (started["part_number"], started["serial_number"], started["cell_sha256"], started["job_sha256"]):
        assert fact in page
    for plan in (r["body"] for r in records if r["kind"] == "plan"):
        assert plan["plan_hash"][:12] in page


def bodies(path: Path) -> list[tuple[str, float, str]]:
    """(kind, time, canonical body) of a journal, without what the wall decides."""
    kept = []
    for record in read(path):
        body = {k: v for k, v in record["body"].items() if k not in ("wall_time_s", "report")}
        kept.append((record["kind"], record["t_mono_s"], json.dumps(body, sort_keys=True)))
    return kept


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_same_seed_gives_the_same_journal_and_another_seed_another(name, tmp_path, capsys):
    journals = [tmp_path / f"{i}.jsonl" for i in range(3)]
    for journal, seed in zip(journals, (5, 5, 6), strict=True):
        assert cli.call(["dry-run", str(CELLS / f"{name}.toml"), "--seed", str(seed), "--journal", str(journal)]) == 0
    first, again, other = (bodies(journal) for journal in journals)
    assert first == again
    assert first != other
    capsys.readouterr()


def spans(run: DryCell) -> list[tuple[float, float]]:
    """(time of the intent, time of the result) of every move; the confirmation comes before the intent."""
    records = [r for r in run.all_records() if r["kind"] in ("confirm", "intent", "moved")]
    assert [r["kind"] for r in records] == ["confirm", "intent", "moved"] * (len(records) // 3)
    return [(records[i + 1]["t_mono_s"], records[i + 2]["t_mono_s"]) for i in range(0, len(records), 3)]


def slow_to_confirm(run: DryCell) -> None:
    """The operator takes three seconds for each go."""
    confirm = run.operator.confirm

    async def later(plan, shown) -> bool:
        await asyncio.sleep(3.0)
        return await confirm(plan, shown)

    run.operator.confirm = later


def test_no_set_point_changes_on_the_bus_before_its_go_and_its_intent(tmp_path):
    run = run_dry("lab-can", 1, tmp_path, slow_to_confirm)
    assert run.state is State.DOCKED
    times, table = run.setpoints_mm()
    allowed = spans(run)
    enabled_s = next(r["t_mono_s"] for r in run.all_records() if r["kind"] == "state" and r["body"]["to"] == "idle")
    changes = np.flatnonzero((np.diff(table, axis=0) != 0.0).any(axis=1)) + 1
    inside = [any(begin < times[i] <= end + 0.05 for begin, end in allowed) for i in changes if times[i] > enabled_s]
    assert len(inside) > 300
    closing = [times[i] > run.ended_at_s - 1.0 for i in changes if times[i] > enabled_s]
    assert all(ok or last for ok, last in zip(inside, closing, strict=True))
    # From enabling to the first intent, through all measuring and the wait for the go, not one count.
    before = (times > enabled_s) & (times <= allowed[0][0])
    assert before.sum() > 300
    assert len(np.unique(table[before], axis=0)) == 1


def test_no_segment_leaves_before_its_go_and_its_intent(tmp_path):
    run = run_dry("lab-modbus", 1, tmp_path, slow_to_confirm)
    assert run.state is State.DOCKED
    allowed = spans(run)
    assert len(run.pushed) > 4 * 10 * len(allowed)
    for at_s, _, _ in run.pushed:
        assert any(begin < at_s < end for begin, end in allowed)
    # What was pushed are the rows of the plans, to the micrometre of the registers, in order, to every PLC.
    names = [p.name for p in run.cell.positioners]
    for i, name in enumerate(names):
        knots = np.array([knot for _, to, knot in run.pushed if to == name])
        rows = np.concatenate([plan.q_mm[:, 3 * i : 3 * i + 3] for plan in run.plans])
        np.testing.assert_allclose(knots, rows, atol=0.00051)


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_intent_says_where_every_axis_goes(name, tmp_path):
    run = run_dry(name, 2, tmp_path, lambda run: None)
    for plan, intent, moved in zip(run.plans, run.records("intent"), run.records("moved"), strict=True):
        assert intent["plan_hash"] == plan.plan_hash
        for k, axis in enumerate(plan.axes):
            assert intent["target_mm"][axis] == pytest.approx(plan.q_mm[-1, k], abs=1e-9)
            assert moved["trace"]["position_mm"][axis][-1] == pytest.approx(plan.q_mm[-1, k], abs=0.02)
