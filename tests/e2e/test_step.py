"""`docking run --sim --step` at a terminal: what the operator sees and may do, over real wires in real time."""

from __future__ import annotations

import re
import signal
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from docking.config.job import Stage
from docking.config.load import load_cell, load_job
from docking.journal import read
from tests.support.program import Terminal, quick_cell, unwired

pytestmark = [pytest.mark.wires, pytest.mark.timeout(120)]

AXIS = re.compile(r"([A-D]\.[XYZ]\*?)\s+([+-]\d+\.\d{3})")
NAMES = re.compile(r"'[^']*'|[A-D]\.[XYZ]|(upper|lower)-(right|left)|\b(dx|dy|dz|mm|align|[synaghrW])\b")
FEATURES = ("upper-right", "lower-right", "upper-left", "lower-left")


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return unwired(quick_cell(tmp_path, "lab-can"))


def step(cell: Path, language: str = "en") -> Terminal:
    journal = cell.with_name("run.jsonl")
    return Terminal("run", str(cell), "--sim", "--step", "--journal", str(journal), language=language)


def stages(cell: Path) -> tuple[Stage, ...]:
    return load_job(cell.with_name("lab-can.job.toml"), load_cell(cell)).stages


def bodies(cell: Path, kind: str) -> list[dict[str, Any]]:
    return [r["body"] for r in read(cell.with_name("run.jsonl")) if r["kind"] == kind]


def grant(terminal: Terminal, *names: str) -> None:
    for name in names:
        terminal.see(rf"'{name}'.*> \n")
        terminal.type("y")


def to_the_first_go(terminal: Terminal) -> str:
    """Grant the permissives of the first stage; the text up to the question for go."""
    terminal.see("'crane_free'.*> \n")
    terminal.type("y")
    grant(terminal, "ball_locked", "area_clear")
    terminal.see("g = .*> \n")
    return terminal.text


def test_go_hold_and_resume_dock(cell: Path) -> None:
    with step(cell) as terminal:
        shown = to_the_first_go(terminal)
        for name in FEATURES:
            assert re.search(rf"{name} +dx +[+-]\d+\.\d{{3}}  dy .* dz .* sigma \d.* tolerance 0\.100\n", shown)
        terminal.type("g")
        terminal.see("moving: align")
        time.sleep(0.4)
        terminal.type("h")
        terminal.see("HOLD")
        time.sleep(1.5)
        terminal.type("r")
        terminal.see("RESUME")
        for stage in stages(cell)[1:]:
            grant(terminal, *stage.permissives)
            terminal.see("g = .*> \n")
            terminal.type("go")
        assert terminal.ended() == 0, terminal.text
    assert "DOCKED" in terminal.text
    assert_every_axis_was_shown(terminal.text, cell)
    verbs = [(b["event"], b["to"]) for b in bodies(cell, "state") if b["event"] in ("hold", "resume")]
    assert verbs == [("hold", "paused"), ("resume", "move")]
    assert_held_for_a_while(bodies(cell, "moved")[0])
    assert [b["go"] for b in bodies(cell, "confirm")] == [True] * 3


def assert_every_axis_was_shown(text: str, cell: Path) -> None:
    axes = load_cell(cell).axis_names
    plans = bodies(cell, "plan")
    shown = [(name, float(value)) for name, value in AXIS.findall(text)]
    assert len(shown) == len(plans) * len(axes)
    for number, plan in enumerate(plans):
        rows = shown[number * len(axes) : (number + 1) * len(axes)]
        assert [name for name, _ in rows] == list(axes)
        assert dict(rows) == pytest.approx(plan["displacement_mm"], abs=0.00051)


def assert_held_for_a_while(moved: dict[str, Any]) -> None:
    trace = moved["trace"]
    rows = pairwise(zip(trace["t_s"], trace["path_time_s"], strict=True))
    standing_s = sum(after[0] - before[0] for before, after in rows if after[1] == before[1])
    assert moved["result"] == "done"
    assert 0.5 <= standing_s <= 2.0


@pytest.mark.parametrize("language", ["en", "zh"])
def test_no_means_not_yet_and_abort_at_a_question_ends_with_4(cell: Path, language: str) -> None:
    with step(cell, language) as terminal:
        terminal.see("'crane_free'.*> \n")
        terminal.type("n")
        terminal.see({"en": "nothing moves until it is", "zh": "满足之前不会有任何运动"}[language])
        terminal.see("'crane_free'.*> \n")
        terminal.type("perhaps")
        terminal.see({"en": "emergency stop is hard-wired", "zh": "急停为硬接线"}[language])
        terminal.type("y" if language == "en" else "是")
        terminal.see("'ball_locked'.*> \n")
        terminal.type("a" if language == "en" else "中止")
        assert terminal.ended() == 4, terminal.text
    assert {"en": "STOPPED", "zh": "操作者已停止"}[language] in terminal.text
    assert not bodies(cell, "intent")
    assert bodies(cell, "state")[-1] == {"from": "confirm", "event": "abort", "to": "recover"}


def test_chinese_throughout(cell: Path) -> None:
    with step(cell, "zh") as terminal:
        shown = to_the_first_go(terminal)
        terminal.type("执行")
        terminal.see("运动:对准")
        terminal.type("a")
        assert terminal.ended() == 4, terminal.text
    for line in shown.splitlines():
        told = re.sub(
            r"'[^']*'|[A-D]\.[XYZ]|(upper|lower)-(right|left)|\b(dx|dy|dz|mm|align|s|y|n|a|g|h|r|W)\b", "", line
        )
        assert not re.search(r"[A-Za-z]{2,}", told), line


@pytest.mark.parametrize("way", ["key", "Ctrl-C", "hang up"])
def test_abort_in_a_move_stops_on_the_path(cell: Path, way: str) -> None:
    with step(cell) as terminal:
        to_the_first_go(terminal)
        terminal.type("g")
        terminal.see("moving: align")
        time.sleep(0.5)
        if way == "key":
            terminal.type("a")
        elif way == "hang up":
            terminal.hang_up()
        else:
            terminal.interrupt(signal.SIGINT)
        assert terminal.ended() == 4, terminal.text
    plan, moved = bodies(cell, "plan")[0], bodies(cell, "moved")[0]
    assert moved["result"] == "stopped"
    assert 0.3 < moved["path_time_s"] < plan["duration_s"]
    assert moved["max_consistency_residual_mm"] < 0.1
    assert bodies(cell, "state")[-1]["to"] == "recover"
    assert bodies(cell, "outcome")[0]["outcome"] == "stopped"
    if way != "hang up":
        assert "stopped on the path" in terminal.text
        assert "Traceback" not in terminal.text


def test_the_end_of_the_input_aborts(cell: Path) -> None:
    with step(cell) as terminal:
        terminal.see("'crane_free'.*> \n")
        terminal.end_input()
        terminal.see("end of input")
        assert terminal.ended() == 4, terminal.text
    assert not bodies(cell, "intent")


def test_interrupted_while_measuring_nothing_moves(cell: Path) -> None:
    with step(cell) as terminal:
        terminal.see("measuring the fixed references")
        terminal.interrupt(signal.SIGINT)
        assert terminal.ended() == 4, terminal.text
    assert "Traceback" not in terminal.text
    assert not bodies(cell, "intent")


def test_what_was_typed_ahead_confirms_nothing(cell: Path) -> None:
    with step(cell) as terminal:
        terminal.see("'crane_free'.*> \n")
        terminal.type("y\ny\ny\ng\ng")
        terminal.see("'ball_locked'.*> \n")
        time.sleep(1.0)
        assert "area_clear" not in terminal.text
        terminal.type("y")
        terminal.see("'area_clear'.*> \n")
        terminal.type("a")
        assert terminal.ended() == 4, terminal.text
    assert not bodies(cell, "intent")


def test_a_retreat_is_chosen_at_the_question_and_leads_back_to_a_measurement(cell: Path) -> None:
    with step(cell) as terminal:
        to_the_first_go(terminal)
        assert "r = retreat" not in terminal.text, "there is no way back yet"
        terminal.type("g")
        terminal.see("moving: align")
        terminal.type("150%")
        terminal.see("emergency stop is hard-wired")
        terminal.type("50%")
        terminal.see("speed: 50 % of the plan")
        grant(terminal, *stages(cell)[1].permissives)
        terminal.see("r = retreat.*> \n")
        terminal.type("r")
        terminal.see("planned move 2: retreat")
        grant(terminal, *stages(cell)[0].permissives)
        terminal.see("g = .*> \n")
        terminal.type("g")
        terminal.see("moving: retreat")
        terminal.see("measuring the component")
        grant(terminal, *stages(cell)[0].permissives)
        terminal.see("g = .*> \n")
        terminal.type("a")
        assert terminal.ended() == 4, terminal.text
    plans = bodies(cell, "plan")
    assert [p["kind"] for p in plans][-2:] == ["retreat", "align"]
    forth, back = bodies(cell, "intent")
    assert back["target_mm"] == pytest.approx(forth["start_mm"], abs=1e-3)
    assert {"verb": "override", "percent": 50.0} in bodies(cell, "command")


def test_a_part_without_strain_is_weighed_and_left_alone(cell: Path) -> None:
    journal = cell.with_name("run.jsonl")
    asked = ("relieve", str(cell), "--sim", "--supervisor", "A. Smith", "--journal", str(journal))
    with Terminal(*asked, language="zh") as terminal:
        assert terminal.ended() == 0, terminal.text
    assert "应力已消除" in terminal.text
    assert "绝对值" in terminal.text, "without a weighing before it has to say so"
    assert not bodies(cell, "intent")
    assert bodies(cell, "run_started")[0]["supervisor"] == "A. Smith"
