"""Hold, resume and abort at any instant of a move, over the real bytes of both buses: the part stays in one piece."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np
import pytest

from docking.assemble.runs import OUTCOMES
from docking.cli import EXIT_OF_OUTCOME
from docking.journal import verify
from docking.state import Event, State
from docking.types import Array, Plan
from tests.support.dry_cell import DryCell, run_dry
from tests.support.rigid_figure import path_gap_mm

AS_SENT_MM = 0.002
"""Over CAN: counts of 0.1 um on twelve axes."""
AS_READ_MM = 0.004
"""What encoders and registers of 1 um leave of an exact position in the figure of four sockets."""

HOLD_SEEDS = {"lab-can": (1, 2, 3, 4), "lab-modbus": (1, 2, 3, 4)}
ABORTS = [(0, 0.07 * i) for i in range(14)] + [(1, 0.5), (2, 0.05), (2, 0.95)]
"""(number of the move, share of its time)"""


@pytest.fixture(autouse=True)
def _no_library_complains(caplog):
    caplog.set_level(logging.WARNING)
    yield
    assert not [r.getMessage() for r in caplog.records if r.name.partition(".")[0] in ("asyncio", "pymodbus", "can")]


class Holds:
    """Posts holds and resumes at random instants of every move and keeps what the axes did meanwhile."""

    def __init__(self, run: DryCell, seed: int, count: int) -> None:
        self.run, self.count = run, count
        self.rng = np.random.default_rng(seed)
        self.held: list[tuple[Plan, Array, float]] = []
        self.asked = 0
        run.on_move(self.begin)

    def begin(self, plan: Plan) -> None:
        at_s = 0.0
        for _ in range(self.count):
            at_s += float(self.rng.uniform(0.0, 1.1 * plan.duration_s / self.count))
            # Some resumes come inside the ramp of their hold.
            pause_s = float(self.rng.uniform(0.0, 2.0 * self.run.ramp_s + 0.6))
            self.run.loop.call_later(at_s, self.hold)
            self.run.loop.call_later(at_s + pause_s, self.resume, plan, pause_s)
            at_s += pause_s

    def hold(self) -> None:
        if self.run.controller.situation.state is State.MOVE:
            self.asked += 1
            self.run.controller.post(Event.HOLD)

    def resume(self, plan: Plan, pause_s: float) -> None:
        if self.run.controller.situation.state is not State.PAUSED:
            return
        if pause_s > self.run.ramp_s + 0.4:
            position = np.array(self.run.controller.procedure.motion.feedback().position_mm)
            self.held.append((plan, position, self.run.loop.time()))
        self.run.controller.post(Event.RESUME)


def moves_of(run: DryCell) -> list[tuple[Plan, float, float]]:
    """(plan, time of the intent, time of the next intent or of the end) of every move."""
    times = [record["t_mono_s"] for record in run.all_records() if record["kind"] == "intent"]
    return [(plan, *span) for plan, span in zip(run.plans, pairwise([*times, run.ended_at_s]), strict=True)]


def assert_sent_on_the_path(run: DryCell) -> None:
    """Every set-point of every move, as it left over CAN, lies on the rigid path of its plan."""
    times, table = run.setpoints_mm()
    assert run.plans
    for plan, begin_s, end_s in moves_of(run):
        sent = table[(times > begin_s) & (times < end_s)]
        assert np.isfinite(sent).all()
        assert run.figure_gap_mm(sent, plan).max() <= AS_SENT_MM
        distinct = np.unique(sent, axis=0)
        assert path_gap_mm(plan.q_mm, distinct).max() <= AS_SENT_MM
        speed = np.abs(np.diff(sent, axis=0)) / run.cell.bus.cycle_s
        assert (speed.max(axis=0) <= run.positioners.v_mm_s + 0.02).all()


def skew_mm(run: DryCell, plan: Plan) -> float:
    """How far axes on their own clocks may part: speed times start skew and drift of two clocks."""
    bus = run.cell.bus
    fastest = np.abs(np.diff(plan.q_mm, axis=0)).max() / plan.period_s
    return float(fastest * (bus.start_skew_s + 2e-6 * bus.clock_ppm * plan.duration_s))


def assert_read_on_the_path(run: DryCell, plan: Plan, position_mm: Array) -> None:
    """Reported positions at rest: inside the plan's chord bound and the skew of the clocks, on its way."""
    bound = plan.chord_error_mm + skew_mm(run, plan) + AS_READ_MM
    assert run.figure_gap_mm(position_mm[None], plan).max() <= bound
    assert path_gap_mm(plan.q_mm, position_mm).max() <= 4.0 * bound


@pytest.mark.parametrize(("name", "seed"), [(name, seed) for name, seeds in HOLD_SEEDS.items() for seed in seeds])
def test_holds_rest_on_the_path_and_resumes_end_docked(name, seed, tmp_path):
    holds: list[Holds] = []
    run = run_dry(name, seed, tmp_path, lambda run: holds.append(Holds(run, seed, 3)))
    assert run.state is State.DOCKED
    assert run.alarms() == []
    assert holds[0].asked >= 5
    assert len(holds[0].held) >= 2
    if run.bus is None:
        for plan, position, _ in holds[0].held:
            assert_read_on_the_path(run, plan, position)
        return
    assert_sent_on_the_path(run)
    times, table = run.setpoints_mm()
    for plan, position, at_s in holds[0].held:
        # Long before a late resume the set-points stand still, and the drives with them.
        resting = np.unique(table[(times > at_s - 0.3) & (times < at_s)], axis=0)
        assert len(resting) == 1
        assert np.abs(position - resting[0]).max() <= 0.002
        assert run.figure_gap_mm(position[None], plan).max() <= AS_READ_MM


def abort_in(run: DryCell, number: int, share: float) -> None:
    """Abort the move `number` (0 is the first) after `share` of its time."""

    def begin(plan: Plan) -> None:
        if len(run.plans) == number + 1:
            run.loop.call_later(share * plan.duration_s, run.controller.post, Event.ABORT)

    run.on_move(begin)


def assert_stopped(run: DryCell, number: int) -> None:
    """Stopped by the operator during the move `number`, everything at rest and closed."""
    assert run.state is State.RECOVER
    assert EXIT_OF_OUTCOME[OUTCOMES[run.state]] == 4
    assert run.alarms() == []
    assert run.states()[-2:] == ["stopping", "recover"]
    assert len(run.plans) == number + 1
    moved = run.records("moved")
    assert [m["result"] for m in moved] == ["done"] * number + [moved[-1]["result"]]
    assert run.drift_mm == 0.0
    assert run.left_on == []
    verify(run.journal_path)


@pytest.mark.parametrize(
    ("name", "number", "share"), [("lab-can", *abort) for abort in ABORTS] + [("lab-modbus", *a) for a in ABORTS[::2]]
)
def test_an_abort_stops_on_the_path_for_good(name, number, share, tmp_path):
    run = run_dry(name, 1, tmp_path, lambda run: abort_in(run, number, share))
    assert_stopped(run, number)
    plan = run.plans[-1]
    result = run.records("moved")[-1]
    if run.bus is not None:
        assert_sent_on_the_path(run)
    else:
        assert_read_on_the_path(run, plan, run.rest_mm)
    if result["result"] == "stopped":
        assert 0.0 <= result["path_time_s"] < plan.duration_s
        gone = np.abs(run.rest_mm - plan.q_mm[0]).max()
        assert gone <= np.abs(plan.displacement_mm).max() + 0.002
    else:
        assert share > 0.5


def test_the_section_of_a_fuselage_is_held_and_stopped_in_one_piece(tmp_path):
    def scenario(run: DryCell) -> None:
        holds = Holds(run, 11, 4)

        def begin(plan: Plan) -> None:
            run.loop.call_later(0.97 * plan.duration_s, run.controller.post, Event.ABORT)

        run.on_move(begin)
        run.holds = holds

    run = run_dry("fuselage-can", 1, tmp_path, scenario)
    assert_stopped(run, 0)
    assert run.holds.asked >= 2
    assert_sent_on_the_path(run)
