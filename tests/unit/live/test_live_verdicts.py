"""When the live pose stops a move and when it does not: each limit by itself, on made-up frames of a known part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from docking.assemble.live import live_settings
from docking.config.load import load_cell, load_job
from docking.errors import DockingError, LiveDeviation, PoseUncertain
from docking.kinematics import axis_positions
from docking.live.pose import LivePose
from docking.live.settings import LiveSettings
from docking.sightings import PointFrame, Sight, ToolSighting
from docking.types import Array, Pose
from tests.support.dry_cell import CELLS

BEGIN_S, SPEED_MM_S, FRAME_S = 1.0, 4.0, 0.05
Change = Callable[[int, dict[str, Array]], None]


@pytest.fixture(scope="module")
def settings() -> LiveSettings:
    cell = load_cell(CELLS / "lab-can-tracked.toml")
    job = load_job(CELLS / "lab-can-tracked.job.toml", cell)
    assert cell.live is not None
    found = live_settings(cell, job, cell.live)
    # Every point is a tool: which marker is which is not what is asked here.
    return replace(found, tools=frozenset(found.body.names), deviation_mm=0.5, frames=3, blind_s=30.0)


class Bench:
    """A part that rests until BEGIN_S and then goes along X as planned; `change(k, seen)` spoils frame k, whose points
    are by name in the camera's frame, before it is shown. Read-backs end at `last_s`."""

    def __init__(self, settings: LiveSettings, change: Change = lambda k, seen: None, late_s: float = 0.0) -> None:
        self.s, self.change, self.late_s = settings, change, late_s
        self.rng = np.random.default_rng(3)
        self.live = LivePose(settings)
        self.frames = 0

    def pose(self, t_s: float) -> Pose:
        return Pose(np.eye(3), np.array([450.0 + SPEED_MM_S * max(t_s - BEGIN_S, 0.0), 0.0, 1000.0]))

    def q_mm(self, t_s: float) -> Array:
        positioners = self.s.positioners
        return axis_positions(positioners, self.pose(t_s).apply(positioners.balls_C_mm))

    def show(self, t_s: float) -> None:
        """The frame taken at `t_s`, stamped `late_s` later."""
        places = self.s.X_WT.inverse().apply(self.pose(t_s).apply(self.s.body.points_B_mm))
        places = places + self.rng.normal(0.0, 0.05, places.shape)
        seen = dict(zip(self.s.body.names, places, strict=True))
        self.change(self.frames, seen)
        self.frames += 1
        tools = tuple(ToolSighting(name, Sight.SEEN, p, np.full(4, np.nan), 0.0) for name, p in seen.items())
        stamp = t_s + self.late_s
        self.live.frame(PointFrame(self.frames, stamp, stamp, tools, np.zeros((0, 3))))

    def run(self, to_s: float, last_s: float = 1e9) -> DockingError | None:
        """The first verdict, looked for ten times a second; None where there is none."""
        self.live.axes(0.0, self.q_mm(0.0))
        rows = np.array([self.q_mm(BEGIN_S + 0.1 * k) for k in range(200)])
        begun = False
        for k in range(1, round(to_s / 0.01)):
            t = 0.01 * k
            if t <= last_s:
                self.live.axes(t, self.q_mm(t))
            if k % 5 == 0:
                self.show(t - 0.02)
            if not begun and t >= BEGIN_S - 0.05:
                plan: Any = SimpleNamespace(q_mm=rows)
                self.live.begin(plan)
                begun = True
            if begun and k % 10 == 0 and (error := self.live.look(t)) is not None:
                self.stopped_s = t
                return error
        return None


def shifted(first: int, count: int, by_mm: float) -> Change:
    """All points off along X in `count` frames from `first`."""

    def change(k: int, seen: dict[str, Array]) -> None:
        if first <= k < first + count:
            for name in seen:
                seen[name] = seen[name] + np.array([0.0, by_mm, 0.0])

    return change


def hidden(first: int, count: int = 10**6) -> Change:
    return lambda k, seen: seen.clear() if first <= k < first + count else None


def test_a_part_that_goes_as_planned_goes_on(settings: LiveSettings) -> None:
    bench = Bench(settings)
    assert bench.run(4.0) is None
    assert bench.live.alarms() == []
    assert bench.live.figures.deviation_mm < 0.15
    assert bench.live.figures.ignored == 0


@pytest.mark.parametrize(("by_mm", "frames", "stops"), [(0.8, 2, False), (0.8, 3, True), (0.3, 30, False)])
def test_a_deviation_stops_in_so_many_frames_running_and_no_fewer(
    settings: LiveSettings, by_mm: float, frames: int, stops: bool
) -> None:
    bench = Bench(settings, shifted(40, frames, by_mm))
    error = bench.run(4.0)
    if not stops:
        assert error is None
        return
    assert isinstance(error, LiveDeviation)
    assert error.value == pytest.approx(by_mm, abs=0.15)
    assert bench.stopped_s < 40 * FRAME_S + 0.35


def test_a_view_lost_for_longer_than_permitted_stops_however_well_the_pose_is_known(settings: LiveSettings) -> None:
    bench = Bench(replace(settings, blind_s=1.5), hidden(30))
    error = bench.run(6.0)
    assert isinstance(error, PoseUncertain)
    assert "1.5 s" in error.text()
    assert bench.stopped_s == pytest.approx(29 * FRAME_S + 1.5, abs=0.25)
    assert Bench(replace(settings, blind_s=1.5), hidden(30, 25)).run(6.0) is None


def test_the_limit_of_the_predicted_error_stops_by_itself(settings: LiveSettings) -> None:
    error = Bench(replace(settings, predicted_sd_mm=1e-3)).run(3.0)
    assert isinstance(error, PoseUncertain)
    assert "0.001 mm" in error.text()


def test_all_sources_lost_stops_at_once(settings: LiveSettings) -> None:
    bench = Bench(settings, hidden(40))
    error = bench.run(6.0, last_s=2.0)
    assert isinstance(error, PoseUncertain)
    assert "All sources are lost" in error.text()
    assert bench.stopped_s < 3.0


def test_a_stated_delay_of_the_camera_is_taken_off(settings: LiveSettings) -> None:
    """0.4 s at 4 mm/s would be 1.6 mm behind the plan."""
    assert Bench(replace(settings, delay_s=0.4), late_s=0.4).run(4.0) is None
    assert isinstance(Bench(settings, late_s=0.4).run(4.0), LiveDeviation)


def test_swapped_tools_are_told_and_neither_stop_the_move_nor_bend_the_pose(settings: LiveSettings) -> None:
    def change(k: int, seen: dict[str, Array]) -> None:
        if 40 <= k < 60:  # of four points the two swapped ones outvote nobody, but are not outvoted either
            for name in [name for name in seen if name not in ("nose", "tail")][2:]:
                del seen[name]
            seen["nose"], seen["tail"] = seen["tail"], seen["nose"]

    bench = Bench(settings, change)
    assert bench.run(4.0) is None
    assert [error.code for error in bench.live.alarms()] == [3054]
    assert bench.live.figures.deviation_mm < 0.2


def test_one_point_that_is_something_else_is_left_out(settings: LiveSettings) -> None:
    def change(k: int, seen: dict[str, Array]) -> None:
        if k >= 40:
            seen["nose"] = seen["nose"] + np.array([3.0, 2.0, -4.0])

    bench = Bench(settings, change)
    assert bench.run(4.0) is None
    assert bench.live.figures.deviation_mm < 0.2
    state = bench.live.state()
    assert state is not None
    assert not state.seen[settings.body.names.index("nose")]
    assert state.seen.sum() == len(settings.body.names) - 1
