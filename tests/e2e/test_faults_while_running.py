"""What breaks while a cell runs is named, stops everything on the path, and leaves nothing powered or open."""

from __future__ import annotations

import asyncio
import json
import logging

import numpy as np
import pytest

from docking import cli
from docking.assemble import runs
from docking.errors import (
    AxisNotEnabled,
    AxisStuck,
    BadReply,
    BallForceTrip,
    ConsistencyTrip,
    DeviceSilent,
    DriveFault,
    FeedbackMissing,
    FollowingErrorTrip,
    InternalForceTrip,
    LinkLost,
    PortMissing,
    TargetLost,
    WarpTrip,
)
from docking.journal import verify
from docking.operators import AutomaticOperator
from docking.state import Event, State
from docking.types import Plan
from sim.plc.registers import Fault
from sim.virtual_time import run_virtual
from tests.support.dry_cell import CELLS, DryCell, run_dry
from tests.support.rigid_figure import path_gap_mm


@pytest.fixture(autouse=True)
def _no_library_complains(caplog):
    caplog.set_level(logging.WARNING)
    yield
    assert not [r.getMessage() for r in caplog.records if r.name.partition(".")[0] in ("asyncio", "pymodbus", "can")]


def in_state(run: DryCell, name: str, call, *args, delay_s: float = 0.0, visit: int = 1) -> None:
    """Call when the cell has entered a state for the `visit`-th time, `delay_s` later."""
    seen = 0

    def hear(kind: str, body: dict) -> None:
        nonlocal seen
        if kind == "state" and body["to"] == name:
            seen += 1
            if seen == visit:
                run.loop.call_later(delay_s, call, *args)

    run.journal.hooks.append(hear)


def mid_move(run: DryCell, call, *args, share: float = 0.5) -> None:
    """Call in the middle of the first move."""

    def begin(plan: Plan) -> None:
        if len(run.plans) == 1:
            run.loop.call_later(share * plan.duration_s, call, *args)

    run.on_move(begin)


def assert_faulted(run: DryCell, kinds, where: str) -> None:
    """One alarm of one of `kinds` that names `where`; nothing moves, nothing is left on."""
    assert run.state is State.FAULT
    codes = {kind.code for kind in (kinds if isinstance(kinds, tuple) else (kinds,))}
    alarm = run.records("alarm")[0]
    assert alarm["code"] in codes, run.records("alarm")
    assert where in alarm["message"]
    assert alarm["remedy"]
    assert "Traceback" not in json.dumps(run.records("alarm")) + "".join(run.said)
    assert run.controller.situation.cause is not None
    assert run.drift_mm == 0.0
    verify(run.journal_path)


def busiest(plan: Plan) -> str:
    return plan.axes[int(np.argmax(np.abs(plan.displacement_mm)))]


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
@pytest.mark.parametrize(("share", "axis"), [(0.2, None), (0.5, "B.X"), (0.5, "D.Y")])
def test_a_jammed_axis_stops_all_on_the_path(name, share, axis, tmp_path):
    jammed: list[str] = []
    forces: list[float] = []

    def jam() -> None:
        jammed.append(axis or busiest(run_.plans[0]))
        run_.far.plant.jam(jammed[0])
        watch(100)

    def watch(left: int) -> None:
        forces.append(run_.far.plant.true_internal_force_n())
        if left:
            run_.loop.call_later(0.01, watch, left - 1)

    def scenario(run: DryCell) -> None:
        nonlocal run_
        run_ = run
        mid_move(run, jam, share=share)

    run_: DryCell
    run = run_dry(name, 2, tmp_path, scenario)
    coupling = (AxisStuck, FollowingErrorTrip, ConsistencyTrip, InternalForceTrip, WarpTrip, DriveFault)
    assert_faulted(run, coupling, "")
    alarm = run.records("alarm")[0]
    assert jammed[0] in alarm["message"]
    assert run.left_on == []
    plan = run.plans[0]
    moved = run.records("moved")[0]
    assert moved["result"] == "fault"
    assert moved["reaction"] == "fast path-preserving stop"
    assert "all axes were stopped: fast path-preserving stop" in run.said
    assert 0.0 < moved["path_time_s"] < plan.duration_s
    # I9: when it was found, when the commands changed for it, when all stood.
    stop, begun_s = alarm["stop"], next(r["t_mono_s"] for r in run.all_records() if r["kind"] == "intent")
    assert stop == moved["stop"]
    assert begun_s + share * plan.duration_s <= stop["found_s"] < alarm["t_s"]
    assert 0.0 <= stop["commanded_after_s"] <= (0.01 if run.bus is not None else 0.1)
    assert stop["commanded_after_s"] < stop["rest_after_s"] <= alarm["t_s"] - stop["found_s"] + 1e-9
    others = np.array([axis != jammed[0] for axis in plan.axes])
    if run.bus is not None:
        times, table = run.setpoints_mm()
        closing_s = next(r["t_mono_s"] for r in run.all_records() if r["kind"] == "moved")
        sent = table[times < closing_s]
        assert run.figure_gap_mm(sent, plan).max() <= 0.002
        assert path_gap_mm(plan.q_mm, np.unique(sent, axis=0)).max() <= 0.002
        # docs/mechanics.md (42): what the limit lets pass, three cycles to react, a stop at a_quick, eased by half.
        v_mm_s, a_quick = np.abs(np.diff(plan.q_mm, axis=0)).max() / plan.period_s, 200.0
        further_mm = v_mm_s * 0.03 + 1.5 * v_mm_s**2 / (2.0 * a_quick)
        assert 20.0 < max(forces) <= run.cell.limits.internal_force_n + 0.69 * 2000.0 * further_mm
    # The free axes stand where the path was left; the jammed one stays behind.
    table = plan.q_mm[:, others]
    assert path_gap_mm(table, run.rest_mm[others]).max() <= 0.02


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
@pytest.mark.parametrize(
    ("state", "delay_s", "visit"),
    [("measure-frame", 0.0, 1), ("measure-frame", 3.0, 1), ("measure", 0.55, 1), ("measure", 0.55, 2), ("fit", 0.0, 1)],
)
def test_a_tracker_that_falls_silent_is_named(name, state, delay_s, visit, tmp_path):
    def scenario(run: DryCell) -> None:
        in_state(run, state, setattr, run.tracker.faults, "silent", True, delay_s=delay_s, visit=visit)

    run = run_dry(name, 1, tmp_path, scenario)
    assert_faulted(run, (DeviceSilent, TargetLost), "")
    assert run.left_on == []
    assert len(run.plans) == (1 if visit == 2 or state == "fit" else 0)


def test_a_tracker_silent_from_the_start_is_named(tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: setattr(run.tracker.faults, "silent", True))
    assert_faulted(run, DeviceSilent, "tracker")
    assert run.left_on == []


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_a_tracker_cable_that_is_pulled_is_named(name, tmp_path):
    run = run_dry(name, 1, tmp_path, lambda run: in_state(run, "measure", run.serial.unplug, delay_s=1.0))
    assert_faulted(run, (LinkLost, PortMissing, DeviceSilent), "")
    assert run.left_on == []


def test_a_tracker_that_sends_rubbish_is_named(tmp_path):
    def scenario(run: DryCell) -> None:
        in_state(run, "measure", setattr, run.tracker.faults, "bad_crc", True)

    run = run_dry("lab-can", 1, tmp_path, scenario)
    assert_faulted(run, (BadReply, DeviceSilent), "")
    assert run.left_on == []


@pytest.mark.parametrize("share", [0.46, 0.48, 0.5, 0.52])
def test_a_node_lost_in_a_move_is_named_and_all_drives_stop(share, tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: mid_move(run, run.drives.mute, "C.Y", share=share))
    # The load cells may feel that one axis stands before three cycles of silence have passed; the silence is told then.
    kinds = (FeedbackMissing, DriveFault, BallForceTrip, ConsistencyTrip, InternalForceTrip, WarpTrip)
    assert_faulted(run, kinds, "C.Y")
    assert run.records("moved")[0]["result"] == "fault"
    # A silent axis is not known to stand. Its heartbeat may be missed before the stop on the path has ended or after:
    # the chain is opened, and every drive holds by its own watchdog, or all others are switched off.
    moved = run.records("moved")[0]
    others = [axis for axis in run.left_on if axis != "C.Y"]
    if moved["reaction"] == "hardware chain":
        assert any("C.Y" in text and "no heartbeat" in text for text in moved["also"])
        assert any("the controller has to be started again" in text for text in run.said)
        assert len(others) == len(run.cell.axis_names) - 1
    else:
        assert moved["reaction"] == "fast path-preserving stop"
        assert others == []


@pytest.mark.parametrize(("state", "visit"), [("measure", 1), ("measure", 2), ("measure", 4)])
def test_a_node_lost_at_rest_is_named_before_anything_is_decided(state, visit, tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: in_state(run, state, run.drives.mute, "C.Y", visit=visit))
    assert_faulted(run, (FeedbackMissing, DriveFault), "C.Y")
    assert len(run.plans) == visit - 1
    assert run.states()[-2] in ("fit", "measure")


def test_a_drive_that_trips_in_a_move_is_named(tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: mid_move(run, run.drives.trip, "B.X", 0x2310))
    assert_faulted(run, DriveFault, "B.X")
    assert run.left_on == []


@pytest.mark.parametrize("state", ["measure", "confirm", "move"])
def test_an_axis_that_loses_its_torque_without_a_word_is_named_in_three_cycles(state, tmp_path):
    off_s: list[float] = []

    def scenario(run: DryCell) -> None:
        def take_torque() -> None:
            off_s.append(run.loop.time())
            run.drives.drives.disable_voltage(run.cell.axis_names.index("A.X"), run.loop.time())
            run.loop.call_later(3.5 * run.cell.bus.cycle_s, seen)

        def seen() -> None:
            if state == "move":
                return
            with pytest.raises(AxisNotEnabled, match=r"A\.X"):
                run.controller.procedure.motion.feedback()
            off_s.append(run.loop.time())

        in_state(run, state, take_torque, delay_s=0.0 if state == "confirm" else 0.5)

    run = run_dry("lab-can", 1, tmp_path, scenario)
    assert_faulted(run, AxisNotEnabled, "A.X")
    assert run.left_on == []
    assert len(off_s) == (1 if state == "move" else 2)
    moved = run.records("moved")
    if state == "measure":
        assert moved == run.plans == []
        _, table = run.setpoints_mm()
        assert np.ptp(table[-400:], axis=0).max() <= 0.002
    elif state == "move":
        assert moved[0]["result"] == "fault"


def test_a_drive_that_restarts_is_named(tmp_path):
    run = run_dry("lab-can", 1, tmp_path, lambda run: mid_move(run, run.drives.restart, "B.X"))
    assert_faulted(run, (DriveFault, FeedbackMissing), "B.X")
    assert run.left_on == []


@pytest.mark.parametrize("state", ["move", "measure", "confirm"])
def test_a_bus_that_is_cut_is_named_and_the_drives_stop_by_themselves(state, tmp_path):
    def scenario(run: DryCell) -> None:
        in_state(run, state, run.bus.cut, "the bus is off", delay_s=0.5 if state != "confirm" else 0.0)

    run = run_dry("lab-can", 1, tmp_path, scenario)
    assert_faulted(run, (LinkLost, FeedbackMissing), "")
    assert "serial line" not in run.left_on
    assert "bus" not in run.left_on


@pytest.mark.parametrize(("state", "delay_s"), [("move", 0.0), ("move", 0.8), ("measure", 1.0)])
def test_a_plc_whose_connection_drops_is_named_and_all_stop(state, delay_s, tmp_path):
    def scenario(run: DryCell) -> None:
        in_state(run, state, run.plcs.drop_connections, "B", delay_s=delay_s)

    run = run_dry("lab-modbus", 1, tmp_path, scenario)
    assert_faulted(run, (LinkLost, DeviceSilent), "positioner B")
    assert run.left_on == []
    if state == "move" and delay_s:
        plan = run.plans[0]
        assert path_gap_mm(plan.q_mm, run.rest_mm).max() <= 0.05


def test_a_plc_that_faults_is_named_and_the_others_stop_with_it(tmp_path):
    def scenario(run: DryCell) -> None:
        mid_move(run, lambda: run.plcs.plcs[3]._trip(Fault.UNDERRUN, run.loop.time()))

    run = run_dry("lab-modbus", 1, tmp_path, scenario)
    assert_faulted(run, DriveFault, "D.X")
    assert run.left_on == []
    plan = run.plans[0]
    assert run.figure_gap_mm(run.rest_mm[None], plan).max() <= 0.01
    assert path_gap_mm(plan.q_mm, run.rest_mm).max() <= 0.02


@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_a_run_that_is_cancelled_in_a_move_stops_on_the_path(name, share, tmp_path):
    async def main() -> DryCell:
        run = DryCell(name, 1, tmp_path / "run.jsonl")
        await run.build()
        docking = asyncio.get_running_loop().create_task(run.controller.dock())
        mid_move(run, docking.cancel, share=share)
        with pytest.raises(asyncio.CancelledError):
            await docking
        await asyncio.sleep(0.5)
        run.rest_mm = run.far.plant.encoder_mm()
        run.left_on = run._left_on()
        await asyncio.sleep(3.0)
        run.drift_mm = float(np.abs(run.far.plant.encoder_mm() - run.rest_mm).max())
        await run.far.close()
        run.journal.close()
        assert not run.defects, run.defects
        return run

    run = run_virtual(main)
    assert run.left_on == []
    assert run.drift_mm == 0.0
    plan = run.plans[0]
    assert 0.001 < np.abs(run.rest_mm - plan.q_mm[0]).max() < 0.999 * np.abs(plan.displacement_mm).max() + 0.01
    if run.bus is not None:
        _, table = run.setpoints_mm()
        assert run.figure_gap_mm(table, plan).max() <= 0.002
        assert path_gap_mm(plan.q_mm, np.unique(table, axis=0)).max() <= 0.002
    else:
        assert run.figure_gap_mm(run.rest_mm[None], plan).max() <= 0.01


class Aborting(AutomaticOperator):
    """Aborts half a second after the first confirmation."""

    def attend(self, post, override) -> None:
        self._post = post

    async def confirm(self, plan, shown) -> Event:
        asyncio.get_running_loop().call_later(0.5, self._post, Event.ABORT)
        return Event.CONFIRMED


class Declining(AutomaticOperator):
    """Says no to the first plan."""

    async def confirm(self, plan, shown) -> Event:
        return Event.DECLINED


class Withholding(AutomaticOperator):
    """Does not give the first permissive that it is asked for."""

    async def permissives(self, names):
        return names[:1]


@pytest.mark.parametrize(
    ("operator", "outcome", "code"), [(Aborting, "stopped", 4), (Declining, "stopped", 4), (Withholding, "fault", 1)]
)
@pytest.mark.parametrize("name", ["lab-can", "lab-modbus"])
def test_the_command_says_how_a_run_ended(name, operator, outcome, code, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(runs, "AutomaticOperator", operator)
    journal = tmp_path / "run.jsonl"
    exit_code = cli.call(["dry-run", str(CELLS / f"{name}.toml"), "--json", "--journal", str(journal)])
    told = json.loads(capsys.readouterr().out)
    assert (told["outcome"], exit_code) == (outcome, code)
    assert told["moves"] == (0 if operator is Declining else 1)
    if operator is Withholding:
        assert [alarm["code"] for alarm in told["alarms"]] == [2112]
        # The only one that is not wired: the first stage does not ask for it.
        assert told["alarms"][0]["where"] == "reflectors_off"
    else:
        assert told["alarms"] == []
    verify(journal)
