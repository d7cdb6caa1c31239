"""Docking over real wires: `docking sim` in one process, `docking run --sim` in another, joined by pty and bus."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from docking.journal import read, verify
from tests.support.program import CELLS, PROGRAM, environment, on_an_ordinary_computer, quick_cell, served

pytestmark = [pytest.mark.wires, pytest.mark.xdist_group("wires")]

LAB = ("lab-can", "lab-modbus")
OTHERS = ("fuselage-can", "fuselage-modbus", "follower-can", "wing-modbus")


def docked(cell: Path, wires: Path, journal: Path, limit_s: float) -> dict[str, Any]:
    asked = [*PROGRAM, "run", str(cell), "--sim", "--wires", str(wires), "--journal", str(journal), "--json"]
    run = subprocess.run(
        asked, capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL, env=environment()
    )
    assert run.stdout.count("\n") == 1, run.stderr
    summary = json.loads(run.stdout)
    assert (summary["outcome"], run.returncode) == ("docked", 0), (summary["alarms"], run.stderr)
    assert "Traceback" not in run.stderr
    return summary


def assert_docked_on_wires(summary: dict[str, Any], journal: Path) -> None:
    assert summary["moves"] >= 3
    # The devices are in another process: nobody here knows the truth.
    assert summary["true_max_feature_error_mm"] is None
    assert summary["max_feature_error_mm"] + 2.0 * summary["feature_sigma_mm"] <= summary["tolerance_mm"]
    records = read(journal)
    verify(journal)
    started = next(r["body"] for r in records if r["kind"] == "run_started")
    assert started["simulated"] is True
    assert [r["body"]["result"] for r in records if r["kind"] == "moved"] == ["done"] * summary["moves"]


Scenario = Callable[[str, Path], Any]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[Scenario, str], Any]]:
    """Plays a scenario on both laboratory cells at the same time, as most of it is waiting; gives the result of one."""
    with ThreadPoolExecutor(len(LAB)) as pool:
        played: dict[Scenario, dict[str, Future[Any]]] = {}

        def result(scenario: Scenario, name: str) -> Any:
            if scenario not in played:
                played[scenario] = {n: pool.submit(scenario, n, tmp_path_factory.mktemp(n)) for n in LAB}
            return played[scenario][name].result()

        yield result


def dock_once(name: str, folder: Path) -> tuple[dict[str, Any], Path, float]:
    began_s = time.monotonic()
    cell, journal = CELLS / f"{name}.toml", folder / "run.jsonl"
    with served(cell, folder) as wires:
        summary = docked(cell, wires, journal, 90.0)
    return summary, journal, time.monotonic() - began_s


@pytest.mark.parametrize("name", LAB)
def test_the_laboratory_cell_docks_over_real_wires(both: Callable[[Scenario, str], Any], name: str) -> None:
    summary, journal, took_s = both(dock_once, name)
    assert_docked_on_wires(summary, journal)
    # Real time: the table of the moves alone takes 7 s, measuring 80 points at 0.1 s another 16 s.
    assert 20.0 <= summary["virtual_time_s"] <= took_s


@pytest.mark.timeout(2700)
@pytest.mark.parametrize("name", OTHERS)
def test_the_other_cells_dock_over_real_wires(name: str, tmp_path: Path, all_cells: bool) -> None:
    if not all_cells:
        pytest.skip("a quarter of an hour each; asked for by --all-cells (make wires)")
    cell, journal = on_an_ordinary_computer(tmp_path, name), tmp_path / "run.jsonl"
    with served(cell, tmp_path) as wires:
        summary = docked(cell, wires, journal, 2600.0)
    assert_docked_on_wires(summary, journal)


def stop_then_dock(name: str, folder: Path) -> tuple[dict[str, Any], Path]:
    """A run that is terminated in its first move, then a run that docks, with the same devices."""
    cell = quick_cell(folder, name)
    with served(cell, folder) as wires:
        asked = [*PROGRAM, "run", str(cell), "--sim", "--wires", str(wires), "--journal", str(folder / "a.jsonl")]
        said = ""
        with subprocess.Popen(
            asked, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment()
        ) as run:
            assert run.stdout is not None
            for line in run.stdout:
                said += line
                if line.startswith("moving"):
                    time.sleep(0.5)
                    run.send_signal(signal.SIGTERM)
            assert run.wait(20.0) == 4, said
        assert "stopped on the path" in said
        assert "Traceback" not in said
        states = [r["body"]["to"] for r in read(folder / "a.jsonl") if r["kind"] == "state"]
        assert states[-3:] == ["move", "stopping", "recover"]
        return docked(cell, wires, folder / "b.jsonl", 60.0), folder / "b.jsonl"


@pytest.mark.parametrize("name", LAB)
def test_the_same_devices_serve_one_run_after_the_other(both: Callable[[Scenario, str], Any], name: str) -> None:
    """The part stands where the last run left it; a run that is stopped leaves devices that the next one can use."""
    assert_docked_on_wires(*both(stop_then_dock, name))


@pytest.mark.parametrize("name", LAB)
def test_devices_that_vanish_in_a_move_end_the_run_with_a_named_fault(name: str, tmp_path: Path) -> None:
    cell = quick_cell(tmp_path, name)
    wires, journal = tmp_path / "w.json", tmp_path / "run.jsonl"
    devices = subprocess.Popen(
        [*PROGRAM, "sim", str(cell), "--wires", str(wires)], stdout=subprocess.DEVNULL, env=environment()
    )
    try:
        while not wires.exists():
            assert devices.poll() is None
            time.sleep(0.05)
        asked = [*PROGRAM, "run", str(cell), "--sim", "--wires", str(wires), "--journal", str(journal), "--json"]
        with subprocess.Popen(
            asked, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
        ) as run:
            assert run.stderr is not None
            assert run.stdout is not None
            for line in run.stderr:
                if line.startswith("moving"):
                    break
            time.sleep(0.5)
            devices.kill()
            out, rest = run.stdout.read(), run.stderr.read()
            assert run.wait(30.0) == 1
    finally:
        devices.kill()
        devices.wait()
    summary = json.loads(out)
    assert summary["outcome"] == "fault"
    assert summary["moves"] == 1
    first = summary["alarms"][0]
    assert first["code"] in {1002, 1006, 2105}, first
    assert first["remedy"]
    assert "Traceback" not in rest
