"""kill -9 of the cell process and of the motion process in the middle of a move, over real wires.

What the axes did is read off the simulated devices' own record. A dead cell process: the axes stop on the planned path.
A dead motion process: SYNC and heartbeat end, and the drives stop by their own watchdogs (1016h = 280 ms, here up to
10 ms fast or slow; a PLC's 120 ms).
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from docking.config.build import positioners_from
from docking.config.load import load_cell, load_job
from docking.types import Array
from tests.support.program import cell_copy, environment, served
from tests.support.rigid_figure import path_gap_mm, rigid_gap_mm, sockets_mm

pytestmark = [pytest.mark.wires, pytest.mark.xdist_group("wires")]

ROW_S = 0.01
SCATTER_S = 0.01
RAMP_S = 0.5
T_STOP_S = {"lab-can": 0.05, "lab-modbus": RAMP_S}
"""Longest ramp: CANopen peak speed / a_quick (5 / 200 mm/s2, and the servo's lag behind it); Modbus `ramp_s`."""
WATCHED_S = {"lab-can": 0.3, "lab-modbus": 0.15}
MOVING_MM_S = 0.2
"""Axes slower than this when the process dies say nothing about when they began to stop."""


@dataclass(frozen=True, eq=False)
class Record:
    """What the devices recorded: times (n,), commanded and actual positions (n, m); when the process was killed."""

    t_s: Array
    heard_s: Array
    commanded_mm: Array
    actual_mm: Array
    table_mm: Array
    killed_s: float
    rigid_mm: Array
    gone_s: float

    def at(self, t_s: float) -> int:
        return int(np.searchsorted(self.t_s, t_s))

    def speed_mm_s(self) -> Array:
        """Actual speeds (m,) over the last tenth of a second before the kill, with their sign."""
        last = self.at(self.killed_s)
        moved = self.actual_mm[last] - self.actual_mm[last - 10]
        return moved / (self.t_s[last] - self.t_s[last - 10])

    def fast_until_s(self) -> Array:
        """For each axis the last row that it came to at 0.9 of its speed and more (m,)."""
        steps = np.abs(np.diff(self.actual_mm, axis=0)) / np.diff(self.t_s)[:, None]
        smooth = steps[1:] + steps[:-1]
        fast = smooth >= 2.0 * 0.9 * np.abs(self.speed_mm_s())
        rows = len(fast) - 1 - np.argmax(fast[::-1], axis=0)
        return self.t_s[rows + 1]

    def ramp_began_s(self, ramp_s: float) -> Array:
        """For each axis when it was half a ramp's distance, v ramp_s / 2, from where it came to rest (m,)."""
        speed = self.speed_mm_s()
        ahead = (self.actual_mm[-1] - self.actual_mm) * np.sign(speed) - 0.5 * np.abs(speed) * ramp_s
        row = np.argmax(ahead <= 0.0, axis=0)
        axes = np.arange(len(speed))
        before, after = ahead[row - 1, axes], ahead[row, axes]
        return self.t_s[row - 1] + (self.t_s[row] - self.t_s[row - 1]) * before / (before - after)

    def rest_s(self) -> float:
        """From when on nothing moves any more."""
        moved = np.abs(self.actual_mm - self.actual_mm[-1]).max(axis=1) > 0.002
        return float(self.t_s[np.flatnonzero(moved)[-1]])


def kill(folder: Path, name: str, victim: str, sync_loss: str = "quick-stop") -> Record:
    """Move a laboratory cell, kill one process in the middle, let the devices come to rest."""
    changes = [(".toml", "\n[limits]\n", "\n[motion]\nlateness_s = 0.2\n\n[limits]\n")]
    if name == "lab-can":
        drives = f'sync_loss = "{sync_loss}"\nwatchdog_scatter_s = {SCATTER_S}\nsync_loss_cycles = 5.0'
        changes.append((".sim.toml", 'sync_loss = "quick-stop"\nsync_loss_cycles = 25.0', drives))
    cell, trace, table = cell_copy(folder, name, *changes), folder / "trace.csv", folder / "plan.npy"
    with served(cell, folder, "--trace", str(trace)) as wires:
        asked = [sys.executable, "-m", "tests.support.moving_cell", str(cell), str(wires), str(table)]
        with subprocess.Popen(asked, stdout=subprocess.PIPE, text=True, env=environment()) as run:
            assert run.stdout is not None
            told = dict(line.split(" ", 1) for line in (run.stdout.readline(), run.stdout.readline()))
            motion = int(told["motion"])
            time.sleep(0.5 * float(told["moving"].split()[0]))
            killed_s = time.monotonic()
            os.kill(run.pid if victim == "cell" else motion, signal.SIGKILL)
            rest = run.stdout.read()
            run.wait(30.0)
        if victim == "motion":
            assert "ended MotionProcessLost" in rest, rest
            assert "SIGKILL" in rest
        gone_s = until_gone(motion)
        time.sleep(1.0)
    return read_record(cell, trace, table, killed_s, gone_s)


def until_gone(pid: int) -> float:
    """When the process has ended: it is no child of the tests."""
    end_s = time.monotonic() + 20.0
    with contextlib.suppress(ProcessLookupError):
        while time.monotonic() < end_s:
            os.kill(pid, 0)
            time.sleep(0.02)
        pytest.fail("the motion process outlives its cell")
    return time.monotonic()


def read_record(cell_file: Path, trace: Path, table: Path, killed_s: float, gone_s: float) -> Record:
    rows = np.genfromtxt(trace, delimiter=",", skip_header=1)
    cell = load_cell(cell_file)
    positioners = positioners_from(cell, load_job(cell_file.with_suffix(".job.toml"), cell))
    where = positioners.origins_W_mm, positioners.axes_W
    commanded, actual = rows[:, 2::2], rows[:, 3::2]
    plan = np.load(table)
    rigid = rigid_gap_mm(sockets_mm(*where, plan[0])[0], sockets_mm(*where, actual))
    return Record(rows[:, 0], rows[:, 1], commanded, actual, plan, killed_s, rigid, gone_s)


CASES: dict[str, tuple[str, ...]] = {
    "can-hold": ("lab-can", "motion", "hold"),
    "can-extrapolate": ("lab-can", "motion", "extrapolate"),
    "can-fault": ("lab-can", "motion", "fault"),
    "modbus": ("lab-modbus", "motion"),
    "can-cell": ("lab-can", "cell"),
    "modbus-cell": ("lab-modbus", "cell"),
}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Record]]:
    """Plays the cases three at a time, as most of it is waiting; gives the record of one."""
    with ThreadPoolExecutor(3) as pool:
        played: dict[str, Future[Record]] = {
            case: pool.submit(kill, tmp_path_factory.mktemp(case), *how) for case, how in CASES.items()
        }
        yield lambda case: played[case].result()


@pytest.mark.parametrize("case", ["can-hold", "can-extrapolate", "can-fault", "modbus"])
def test_axes_whose_motion_process_dies_stop_by_their_watchdogs(record: Callable[[str], Record], case: str) -> None:
    seen, name = record(case), CASES[case][0]
    heard_s = float(seen.heard_s[-1])
    speed = np.abs(seen.speed_mm_s())
    moving = speed > MOVING_MM_S
    assert moving.sum() >= 8
    # Nobody speaks after the end, and the watchdogs are no faster than they are set.
    assert heard_s <= seen.killed_s
    began_s = (seen.ramp_began_s(RAMP_S) if name == "lab-modbus" else seen.fast_until_s())[moving]
    assert began_s.max() - heard_s <= WATCHED_S[name], "the last to begin its stop"
    if case == "can-extrapolate":
        assert began_s.min() - heard_s >= 0.28 - SCATTER_S - 2.0 * ROW_S, "the first to begin its stop"
    assert seen.rest_s() - began_s.max() <= T_STOP_S[name] + 3.0 * ROW_S
    # All stop together but for the scatter of their clocks; a dead reckoning lasts until the watchdog at most.
    apart_s = 2.0 * SCATTER_S + 2.0 * ROW_S if case == "can-extrapolate" else 0.0
    bound_mm = 0.02 + float(np.linalg.norm(speed.reshape(-1, 3), axis=1).max()) * apart_s
    assert seen.rigid_mm.max() <= bound_mm
    assert path_gap_mm(seen.table_mm, seen.actual_mm[-1:]).max() <= 0.02 + float(np.linalg.norm(speed)) * apart_s


@pytest.mark.parametrize("case", ["can-cell", "modbus-cell"])
def test_axes_whose_cell_process_dies_stop_on_the_path(record: Callable[[str], Record], case: str) -> None:
    seen = record(case)
    moving = np.abs(seen.speed_mm_s()) > MOVING_MM_S
    # The end of the channel is seen at once, whatever is left of the lease; then path time slows down.
    assert seen.fast_until_s()[moving].max() - seen.killed_s <= 0.3
    assert seen.rest_s() - seen.killed_s <= 1.5
    start, end = seen.table_mm[0], seen.table_mm[-1]
    share = np.abs(seen.actual_mm[-1] - start).max() / np.abs(end - start).max()
    assert 0.3 <= share <= 0.9, "it stopped on the way"
    assert seen.rigid_mm.max() <= 0.02
    after = seen.actual_mm[seen.at(seen.killed_s) :: 5]
    assert path_gap_mm(seen.table_mm, after).max() <= 0.02
    # The axes are braked and released before the process ends.
    assert seen.gone_s - seen.killed_s <= 5.0
    assert seen.heard_s[-1] - seen.killed_s >= 0.1
