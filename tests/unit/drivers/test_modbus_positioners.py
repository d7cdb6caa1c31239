"""The queue-playing positioners over Modbus: the whole chain driver, pymodbus, bytes, PLC, on virtual time."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import math
import struct
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from docking.config.cell import CellFile
from docking.errors import (
    BadArgument,
    BadReply,
    DeviceRefused,
    DeviceSilent,
    EnableFailed,
    LinkLost,
    OutcomeUnknown,
    ReadBackMismatch,
    SegmentRejected,
    WrongIdentity,
)
from docking.types import AxisState, Feedback
from drivers.modbus_positioners import ModbusPositioners
from sim.plc import registers as reg
from sim.plc.group import PlcGroup
from sim.plc.modbus_tcp import ModbusTcpConnection
from sim.plc.registers import State
from sim.virtual_time import run_virtual
from tests.support.modbus_cell import START_MM, StiffPlant, cell, chord_point, path_time_of, plan

PPM = (50.0, -50.0, 20.0, 0.0)


class Bench:
    """A driver, four PLCs and a stiff plant on one virtual loop."""

    def __init__(self, config: CellFile, ppm: tuple[float, ...], late_s: tuple[float, ...]) -> None:
        self.loop = asyncio.get_running_loop()
        self.plant = StiffPlant()
        self.group = PlcGroup(self.plant, config, ppm, self.loop, late_s)
        self.driver = ModbusPositioners(config)
        self.plan = plan(config)

    async def start(self) -> None:
        await self.group.serve()
        await self.driver.bring_up()
        await self.driver.enable()

    async def poll_for(self, seconds: float) -> Feedback:
        """Poll every 50 ms for this long, at once after a poll that took longer; return the last read-back."""
        end_s = self.loop.time() + seconds
        while True:
            begun_s = self.loop.time()
            feedback = await self.driver.poll()
            if self.loop.time() >= end_s - 1e-9:
                return feedback
            await asyncio.sleep(max(0.0, min(begun_s + 0.05, end_s) - self.loop.time()))

    async def run(self) -> None:
        await self.start()
        await self.driver.load(self.plan)
        await self.driver.command("run")

    def states(self) -> list[State]:
        return [plc.state for plc in self.group.plcs]


def play(
    scenario: Callable[[Bench], Coroutine[Any, Any, None]],
    ppm: tuple[float, ...] = PPM,
    late_s: tuple[float, ...] = (),
    passive: tuple[str, ...] = (),
    **bus: Any,
) -> None:
    async def main() -> None:
        bench = Bench(cell(passive, **bus), ppm, late_s)
        await scenario(bench)
        await bench.driver.close()
        await bench.group.close()

    run_virtual(main)


def assert_on_one_path_time(bench: Bench, skew_s: float) -> None:
    """Every positioner stands on the chords of the table as sent, all at one path time within the clock skew."""
    t_s, q = bench.plan.t_s, np.round(bench.plan.q_mm, 3)
    times = [path_time_of(t_s, q[:, 3 * i : 3 * i + 3], bench.plant.position_mm[3 * i : 3 * i + 3]) for i in range(4)]
    for i, at_s in enumerate(times):
        on_chord = chord_point(t_s, q[:, 3 * i : 3 * i + 3], at_s)
        assert np.abs(bench.plant.position_mm[3 * i : 3 * i + 3] - on_chord).max() < 1e-6
    moving = 0.5 < np.mean(times) < 7.5
    if moving:  # near the ends the table hardly moves and path time is not to be told from position
        assert max(times) - min(times) <= skew_s + 1e-4
    speed = np.abs(np.diff(q, axis=0)).max() / bench.driver.segment_s
    common = chord_point(t_s, q, float(np.mean(times)))
    assert np.abs(bench.plant.position_mm - common).max() <= speed * skew_s + 0.002


def test_a_second_host_is_refused_and_the_move_of_the_first_goes_on() -> None:
    """To bring a PLC up means to disable its axes first."""

    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        second = ModbusPositioners(bench.driver._cell)
        refused = asyncio.ensure_future(second.bring_up())
        feedback = await bench.poll_for(1.0)
        with pytest.raises(LinkLost, match="Another controller") as caught:
            await refused
        assert caught.value.where == "positioner A"
        await second.close()
        feedback = await bench.poll_for(bench.plan.duration_s - 2.0 + 0.5)
        assert feedback.fault is None
        assert bench.states() == [State.DONE] * 4
        assert bench.plant.position_mm == pytest.approx(bench.plan.q_mm[-1], abs=0.0006)

    play(scenario)


def test_a_whole_move_ends_on_the_last_row() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        seen: list[Feedback] = []
        while not seen or not seen[-1].path_time_s >= bench.plan.duration_s:
            seen.append(await bench.driver.poll())
            await asyncio.sleep(0.05)
            assert bench.loop.time() < 12.0
        assert bench.plant.position_mm == pytest.approx(bench.plan.q_mm[-1], abs=0.0006)
        times = [feedback.path_time_s for feedback in seen]
        assert all(a <= b for a, b in itertools.pairwise(times))
        assert bench.states() == [State.DONE] * 4
        middle = seen[len(seen) // 2]
        expected = chord_point(bench.plan.t_s, bench.plan.q_mm, middle.path_time_s)
        assert middle.position_mm == pytest.approx(expected, abs=0.01)
        assert middle.states == (AxisState.ENABLED,) * 12
        assert middle.force_n[0] == -3000.0
        assert np.isnan(middle.force_n[9:]).all(), "positioner D has no load cell"
        assert middle.fault is None
        assert not middle.age_cycles.any()

    play(scenario)


@settings(max_examples=15, deadline=None)
@example(2.0, "quick-stop", 0.05)
@given(st.floats(0.05, 7.9), st.sampled_from(["hold", "stop", "quick-stop"]), st.floats(0.05, 0.9))
def test_a_stop_at_any_moment_leaves_the_axes_on_the_path(at_s: float, verb: str, ramp_s: float) -> None:
    late_s = (0.0, 0.001, 0.0004, 0.0)

    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(at_s)
        await bench.driver.command(verb)
        await bench.poll_for(ramp_s + 0.4)
        before = bench.plant.position_mm.copy()
        await bench.poll_for(0.3)
        assert np.array_equal(before, bench.plant.position_mm), "at rest"
        assert_on_one_path_time(bench, skew_s=at_s * 1e-4 + 0.001)

    play(scenario, late_s=late_s, ramp_s=ramp_s)


def test_a_resume_takes_the_others_to_the_end_when_one_has_reached_it_in_its_ramp() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(7.6)
        await bench.driver.command("hold")
        await bench.poll_for(1.0)
        assert bench.states() == [State.DONE, State.HELD, State.HELD, State.HELD]
        await bench.driver.command("resume")
        await bench.poll_for(2.0)
        assert bench.states() == [State.DONE] * 4
        np.testing.assert_allclose(bench.plant.position_mm, bench.plan.q_mm[-1], atol=0.0006)

    play(scenario, ppm=(30000.0, 0.0, 0.0, 0.0))


def test_hold_and_resume_reach_the_end_with_the_path_never_left() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        for _ in range(4):
            feedback = await bench.poll_for(0.9)
            await bench.driver.command("hold")
            held = await bench.poll_for(0.8)
            assert held.path_time_s - feedback.path_time_s == pytest.approx(0.25, abs=0.05)
            await bench.driver.command("resume")
        await bench.poll_for(9.0)
        assert bench.plant.position_mm == pytest.approx(bench.plan.q_mm[-1], abs=0.0006)
        q = np.round(bench.plan.q_mm[:, :3], 3)
        for _, position in bench.plant.history[::5]:
            at_s = path_time_of(bench.plan.t_s, q, position[:3])
            assert np.abs(chord_point(bench.plan.t_s, q, at_s) - position[:3]).max() < 1e-6

    play(scenario)


def test_clock_skew_shows_as_path_times_apart() -> None:
    async def scenario(bench: Bench) -> None:
        bench.plan = plan(cell(), 30.0)
        await bench.run()
        feedback = await bench.poll_for(20.0)
        # 20 s at 2000 ppm between the fastest and the slowest; polled in step with the scans all but one are certain.
        assert 0.029 <= feedback.path_skew_s <= 0.0402
        assert feedback.path_times_s[0] - feedback.path_times_s[3] == pytest.approx(0.040, abs=0.0105)
        assert feedback.path_times_s[2] == feedback.path_times_s[0]

    play(scenario, ppm=(1000.0, -1000.0, 0.0, 0.0))


class Tamper:
    """Sits between the servers and one positioner: loses, delays or changes replies."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, bench: Bench, index: int) -> None:
        self.lose: Callable[[bytes], str] = lambda frame: ""
        victim = bench.group.plcs[index]
        original = ModbusTcpConnection.data_received

        def data_received(connection: ModbusTcpConnection, data: bytes) -> None:
            what = self.lose(data) if connection.serves(victim) else ""
            if what == "request":
                return
            if what == "reply":
                write, connection._transport.write = connection._transport.write, lambda data: None  # type: ignore[method-assign]
                original(connection, data)
                connection._transport.write = write  # type: ignore[method-assign]
                return
            original(connection, data)

        monkeypatch.setattr(ModbusTcpConnection, "data_received", data_received)


def test_lost_replies_cost_nothing_and_every_segment_enters_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        await bench.driver.load(bench.plan)
        tamper = Tamper(monkeypatch, bench, 1)
        pushed: list[int] = []
        queue = bench.group.plcs[1].queue
        push = queue.push

        def count(knot: Any, last: bool) -> None:
            pushed.append(len(pushed))
            push(knot, last)

        queue.push = count  # type: ignore[method-assign]
        before = queue.last_seq
        await bench.driver.command("run")
        turn = iter(range(10**6))
        tamper.lose = lambda frame: ("reply", "", "", "request", "", "", "")[next(turn) % 7]
        feedback = await bench.poll_for(9.5)
        tamper.lose = lambda frame: ""
        assert feedback.path_time_s == pytest.approx(8.0)
        assert before + len(pushed) == len(bench.plan.t_s)
        assert bench.plant.position_mm == pytest.approx(bench.plan.q_mm[-1], abs=0.0006)

    play(scenario)


def test_two_lost_replies_in_a_row_are_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        Tamper(monkeypatch, bench, 2).lose = lambda frame: "request"
        feedback = await bench.driver.poll()
        assert feedback.age_cycles.tolist() == [0.0] * 6 + [1.0] * 3 + [0.0] * 3
        await asyncio.sleep(0.02)
        with pytest.raises(DeviceSilent, match="positioner C"):
            await bench.driver.poll()
        # Its axes may be under power for all that is known: told, when the others are off.
        with pytest.raises(EnableFailed, match="positioner C"):
            await bench.driver.close()
        assert {bench.states()[i] for i in (0, 1, 3)} <= {State.DISABLED, State.FAULT}
        assert not bench.plant.powered.any()
        assert not any(unit.unit.connected for unit in bench.driver._plcs)

    play(scenario)


def test_a_brake_that_is_not_reported_closed_is_told_when_all_are_off() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        plc = bench.group.plcs[1]
        bits = plc._axis_bits
        plc._axis_bits = lambda: [b & ~reg.AXIS_BRAKED if i == 2 else b for i, b in enumerate(bits())]  # type: ignore[method-assign]
        with pytest.raises(EnableFailed, match=r"B\.Z.*brake"):
            await bench.driver.close()
        assert bench.states() == [State.DISABLED] * 4
        assert not any(unit.unit.connected for unit in bench.driver._plcs)

    play(scenario)


def test_a_lost_answer_to_run_is_settled_by_reading_back(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        await bench.driver.load(bench.plan)
        tamper = Tamper(monkeypatch, bench, 0)
        tamper.lose = lambda frame: "reply" if frame[7] == 16 else ""
        await bench.driver.command("run")
        tamper.lose = lambda frame: ""
        await bench.poll_for(0.5)
        assert bench.states() == [State.RUNNING] * 4

    play(scenario)


def test_run_that_one_plc_never_gets_is_not_repeated_and_nothing_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        await bench.driver.load(bench.plan)
        tamper = Tamper(monkeypatch, bench, 3)
        writes: list[bytes] = []

        def lose_run(frame: bytes) -> str:
            if frame[7] == 16 and frame[15:17] == bytes((0, reg.Command.RUN)):
                writes.append(frame)
                return "request"
            return ""

        tamper.lose = lose_run
        with pytest.raises(OutcomeUnknown, match="positioner D"):
            await bench.driver.command("run")
        assert len(writes) == 1
        await bench.poll_for(1.5)
        assert np.array_equal(bench.plant.position_mm, START_MM)
        assert State.ARMED not in bench.states(), "the others have been told to hold"

    play(scenario)


def test_hold_is_sent_once_more_when_the_read_back_shows_it_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        tamper = Tamper(monkeypatch, bench, 0)
        lost: list[bytes] = []

        def lose_first(frame: bytes) -> str:
            if frame[7] == 16 and not lost:
                lost.append(frame)
                return "request"
            return ""

        tamper.lose = lose_first
        await bench.driver.command("hold")
        await bench.poll_for(1.0)
        assert bench.states() == [State.HELD] * 4

    play(scenario)


def test_a_cut_connection_is_told_by_the_next_poll() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        bench.group.drop_connections("B")
        await asyncio.sleep(0.01)
        at_s = bench.loop.time()
        with pytest.raises(LinkLost, match="positioner B"):
            await bench.driver.poll()
        assert bench.loop.time() - at_s < 0.01
        with pytest.raises(LinkLost):
            await bench.driver.command("hold")
        await asyncio.sleep(1.0)
        assert {bench.states()[i] for i in (0, 2, 3)} <= {State.HELD, State.FAULT}
        assert_on_one_path_time(bench, skew_s=0.0002)

    play(scenario)


def test_a_plc_that_scans_no_more_is_noticed() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(0.5)
        bench.group.plcs[1].think = lambda now_s: None  # type: ignore[method-assign]
        with pytest.raises(LinkLost, match="stood still"):
            await bench.poll_for(0.5)
        with pytest.raises(EnableFailed, match="positioner B"):
            await bench.driver.close()

    play(scenario)


def test_a_frozen_echo_is_noticed() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        await bench.poll_for(0.5)
        bench.group.plcs[1]._beat = lambda count: None  # type: ignore[method-assign]
        bench.group.plcs[1].settings.watchdog_ms = 5000
        with pytest.raises(LinkLost, match="lags"):
            await bench.poll_for(0.5)

    play(scenario)


def test_a_fault_of_one_plc_comes_as_feedback_with_words() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        bench.plant.jammed[7] = True
        feedback = await bench.poll_for(1.0)
        assert feedback.fault == ("C.Y", 5, "stuck axis"), "not one of those that the fallen line took along"
        assert feedback.states == (AxisState.FAULT,) * 12
        assert bench.plant.braked.all()
        assert not bench.plant.powered.any()
        with pytest.raises(EnableFailed, match=r"positioner C.*stuck axis"):
            await bench.driver.enable()
        bench.plant.jammed[7] = False
        await bench.driver.command("reset")
        assert (await bench.driver.enable()).fault is None

    play(scenario)


def test_the_cause_is_looked_for_when_only_the_fallen_line_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        seen: list[tuple[int, int]] = []
        status = bench.group.plcs[2]._status

        def late_by_one_reading() -> bytes:
            # As if C were read just before the scan in which its axis jams, the others just after it.
            whole = status()
            seen.append(struct.unpack(">HH", whole[4:8]))
            if seen[-1][1] == 5 and [fault for _, fault in seen].count(5) == 1:
                return whole[:6] + b"\0\0" + whole[8:]
            return whole

        bench.group.plcs[2]._status = late_by_one_reading  # type: ignore[method-assign]
        bench.plant.jammed[7] = True
        faults = set()
        for _ in range(10):
            faults.add((await bench.poll_for(0.05)).fault)
        assert faults == {None, ("C.Y", 5, "stuck axis")}

    play(scenario)


def test_the_quick_ramp_follows_the_plan_and_the_axes() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        for factor in (1.0, 0.5, 0.01):
            start, q = bench.plan.q_mm[0], bench.plan.q_mm
            table = dataclasses.replace(bench.plan, plan_id=round(1000 * factor), q_mm=start + factor * (q - start))
            await bench.driver.load(table)
            # 5.4 to 5.6 mm/s at 200 mm/s^2 take 28 ms: three scans; 20 ms are the least.
            peak_mm_s = np.abs(np.diff(table.q_mm, axis=0)).max() / 0.1
            wanted_ms = max(20, 10 * math.ceil(peak_mm_s / 200.0 * 100.0))
            assert {plc._quick_ramp_ms for plc in bench.group.plcs} == {wanted_ms}

    play(scenario)


def test_an_override_is_written_at_standstill_and_slows_path_time() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(2.0)
        with pytest.raises(DeviceRefused, match="illegal value"):
            await bench.driver.override(0.4)
        await bench.driver.command("hold")
        held = await bench.poll_for(0.8)
        await bench.driver.override(0.4)
        await bench.driver.command("resume")
        await bench.poll_for(0.3)
        before = await bench.poll_for(0.05)
        after = await bench.poll_for(1.0)
        assert after.path_time_s - before.path_time_s == pytest.approx(0.4, abs=0.006)
        assert before.path_time_s - held.path_time_s == pytest.approx(0.4 * (0.35 - 0.1), abs=0.02)
        await bench.driver.command("quick-stop")
        await bench.poll_for(0.5)
        assert_on_one_path_time(bench, skew_s=0.001)
        for wrong in (0.0, 1.01, float("nan")):
            with pytest.raises(BadArgument):
                await bench.driver.override(wrong)

    play(scenario)


def test_a_pressed_limit_switch_is_reported_and_stops_all_in_a_move() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        feedback = await bench.driver.poll()
        assert feedback.at_limit is None
        bench.group.press_limit("D.Z")
        feedback = await bench.poll_for(0.5)
        assert feedback.fault == ("D.Z", 6, "limit switch")
        assert feedback.at_limit is not None
        assert np.flatnonzero(feedback.at_limit).tolist() == [11]
        assert_on_one_path_time(bench, skew_s=0.0003)

    play(scenario)


def test_a_plan_that_begins_elsewhere_is_refused_before_anything_is_sent() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        bench.plant.offset_mm[4] = 0.011
        await bench.poll_for(0.1)
        with pytest.raises(SegmentRejected, match=r"B\.Y"):
            await bench.driver.load(bench.plan)
        assert {plc.queue.last_seq for plc in bench.group.plcs} == {0}
        bench.plant.offset_mm[4] = 0.009
        await bench.poll_for(0.1)
        await bench.driver.load(bench.plan)

    play(scenario)


def test_passive_axes_are_masked_and_reported() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        bench.plant.position_mm[[3, 10]] += 7.0  # they float with the component
        await bench.poll_for(0.1)
        await bench.driver.load(bench.plan)
        await bench.driver.command("run")
        feedback = await bench.poll_for(9.0)
        assert feedback.states[3] is AxisState.DISABLED
        assert feedback.states[4] is AxisState.ENABLED
        assert feedback.position_mm[3] == pytest.approx(START_MM[3] + 7.0)
        assert feedback.path_time_s == pytest.approx(8.0)

    play(scenario, passive=("B.X", "D.Y"))


def test_more_than_65535_segments_wrap(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        await bench.driver.load(bench.plan)
        for plc, unit in zip(bench.group.plcs, bench.driver._plcs, strict=True):
            # Both sides as after a long plan: shift what is queued to just before the wrap.
            shift = 65535 - unit.pushed
            plc.queue.last_seq += shift
            plc.queue.play_seq += shift
            rows = ((unit._segments.rows[0],) * shift) + unit._segments.rows  # type: ignore[union-attr]
            unit._segments = type(unit._segments)(unit._segments.plan_id, 100, rows)  # type: ignore[union-attr,misc]
            unit.pushed += shift
            unit._wanted += shift
        await bench.driver.command("run")
        feedback = await bench.poll_for(9.0)
        assert feedback.path_time_s == pytest.approx((65535 - 0) * 0.1 + 8.0 - 0.1 * 14, abs=0.2)
        assert bench.plant.position_mm == pytest.approx(bench.plan.q_mm[-1], abs=0.0006)

    play(scenario)


def test_close_brakes_before_it_leaves() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.run()
        await bench.poll_for(1.0)
        await bench.driver.close()
        assert bench.states() == [State.DISABLED] * 4
        assert bench.plant.braked.all()
        assert_on_one_path_time(bench, skew_s=0.0002)

    play(scenario)


def bring_up_raises(kind: type[Exception], match: str, change: Callable[[Bench], None]) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.group.serve()
        change(bench)
        with pytest.raises(kind, match=match):
            await bench.driver.bring_up()

    play(scenario)


def test_bring_up_proves_identity_word_order_settings_and_strokes() -> None:
    def swapped_hosts(bench: Bench) -> None:
        plcs = bench.group.plcs
        plcs[0]._identity, plcs[1]._identity = plcs[1]._identity, plcs[0]._identity

    def other_scan(bench: Bench) -> None:
        identity = bench.group.plcs[1]._identity
        bench.group.plcs[1]._identity = identity[:8] + b"\0\x14" + identity[10:]

    def old_stuck_limit(bench: Bench) -> None:
        plc = bench.group.plcs[3]
        take = plc._set
        plc._set = lambda settings: take(dataclasses.replace(settings, stuck_um=100))  # type: ignore[method-assign]

    def swapped_words(bench: Bench) -> None:
        identity = bench.group.plcs[0]._identity
        bench.group.plcs[0]._identity = identity[2:4] + identity[:2] + identity[4:]

    def watchdog_ignored(bench: Bench) -> None:
        bench.group.plcs[2]._set = lambda *values: None  # type: ignore[method-assign]

    def other_stroke(bench: Bench) -> None:
        plc = bench.group.plcs[3]
        plc._limits = plc._limits[:-8] + (400_002).to_bytes(4, "big") + plc._limits[-4:]

    bring_up_raises(WrongIdentity, "found B, expected A", swapped_hosts)
    bring_up_raises(BadReply, "0x56781234", swapped_words)
    bring_up_raises(ReadBackMismatch, "positioner C, watchdog_ms: read back 0, expected 120", watchdog_ignored)
    bring_up_raises(ReadBackMismatch, "positioner B, scan_ms: read back 20, expected 10", other_scan)
    bring_up_raises(ReadBackMismatch, "positioner D, stuck_um: read back 100, expected 20", old_stuck_limit)
    bring_up_raises(ReadBackMismatch, "positioner D, stroke of Z", other_stroke)


def test_a_plc_that_ignores_segments_ends_the_loading() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        bench.group.plcs[1]._take_segment = lambda data: None  # type: ignore[method-assign]
        with pytest.raises(SegmentRejected, match=r"positioner B.*only 0 segments"):
            await bench.driver.load(bench.plan)

    play(scenario)


def test_a_refused_command_names_the_reason() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.start()
        with pytest.raises(DeviceRefused, match="too few segments"):
            await bench.driver.command("run")
        assert math.isnan((await bench.driver.poll()).path_time_s)

    play(scenario)
