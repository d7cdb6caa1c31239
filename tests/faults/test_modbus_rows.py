"""Rows MB-01 to MB-08: the wires between the controller and the PLCs of a Modbus cell, and the PLCs' own watch.

Every case is a move of a ready cell in virtual time. Stops are asserted on the motors: at rest in time, rigid within
what chords and clocks may part, braked, and no command that starts motion sent twice.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from docking.errors import (
    AxisStuck,
    BadReply,
    ConsistencyTrip,
    DeviceRefused,
    DeviceSilent,
    DockingError,
    DriveFault,
    FeedbackMissing,
    LinkLost,
    MotionError,
    ReadBackMismatch,
    WrongIdentity,
)
from docking.kinematics import internal_force_matrix, socket_positions
from docking.kinematics.forces import consistency_projector
from docking.motion.triggers import Trigger
from docking.types import Array, Plan
from sim.plc import registers as reg
from tests.support.ready_modbus import ModbusScene, ReadyModbus, peak_mm_s, play_modbus

POLL_S, TIMEOUT_S, SCAN_S = 0.05, 0.05, 0.01
MISSING_CYCLES = 2
TOLD_S = 3.0 * SCAN_S
"""A command takes a scan to be obeyed; the motors follow a little later."""
LAB, FUSELAGE = ModbusScene(), ModbusScene("fuselage-modbus", shift_mm=8.0, speed_mm_s=5.0)


# what happens on the wire ------------------------------------------------------------------------------------------
def once(act: Any) -> Callable[[ReadyModbus], None]:
    """Do this to the next exchange with positioner B."""

    def fault(cell: ReadyModbus) -> None:
        def tamper(frame: bytes) -> Any:
            cell.tamper = lambda later: None
            return act

        cell.tamper = tamper

    return fault


def always(act: Any) -> Callable[[ReadyModbus], None]:
    """Do this to every exchange with positioner B from now on."""
    return lambda cell: setattr(cell, "tamper", lambda frame: act)


def exception(code: int) -> Callable[[bytes], bytes]:
    return lambda reply: reply[:4] + struct.pack(">HBBB", 3, reply[6], reply[7] | 0x80, code)


def cut(reply: bytes) -> bytes:
    return reply[: len(reply) // 2]


def late_by_one(cell: ReadyModbus) -> None:
    """Every reply comes behind the one of the request before."""
    kept = [b""]

    def behind(reply: bytes) -> bytes:
        before, kept[0] = kept[0], reply
        return before + reply

    cell.tamper = lambda frame: behind


def reset(cell: ReadyModbus) -> None:
    cell.group.drop_connections("B")


def reset_all(cell: ReadyModbus) -> None:
    for positioner in cell.cell.positioners:
        cell.group.drop_connections(positioner.name)


def freeze(cell: ReadyModbus) -> None:
    """The registers of B stand still, though it answers and its axes go on."""
    status = cell.victim._status()
    cell.victim._status = lambda: status  # type: ignore[method-assign]


def hang(cell: ReadyModbus) -> None:
    """B takes no heartbeat in, though it scans and answers."""
    cell.victim._beat = lambda count: None  # type: ignore[method-assign]


def other_unit(cell: ReadyModbus) -> None:
    """Behind B's address stands another PLC from now on."""
    other = cell.group.plcs[2]
    cell.victim._status = lambda: other._status()  # type: ignore[method-assign]


def press_limit(cell: ReadyModbus) -> None:
    cell.group.press_limit("B.Z")


@dataclass(frozen=True)
class Row:
    """`fault` at 0.5 of the move; it ends `done` where `error` is None, else with that cause, which names `where`.

    `told_s`: when the last controller has been told at the latest; its quick ramp and two scans come on top.
    """

    fault: Callable[[ReadyModbus], Any]
    error: type[DockingError] | None
    where: str
    told_s: float
    trigger: Trigger | None = None
    slow: bool = False


SILENT_S = POLL_S + 2.0 * TIMEOUT_S + TOLD_S
ROWS = {
    "MB-01 reply lost once": Row(once("reply"), None, "", 0.0),
    "MB-01 request lost once": Row(once("request"), None, "", 0.0),
    "MB-01 replies lost": Row(always("reply"), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING),
    "MB-01 requests lost": Row(
        always("request"), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING, slow=True
    ),
    "MB-02 busy once": Row(once(exception(6)), None, "", 0.0),
    "MB-02 busy": Row(always(exception(6)), DeviceRefused, "positioner B", 2.0 * POLL_S + TOLD_S, Trigger.DRIVE_FAULT),
    "MB-02 device failure": Row(
        once(exception(4)), DeviceRefused, "positioner B", POLL_S + TOLD_S, Trigger.DRIVE_FAULT
    ),
    "MB-03 connection reset": Row(reset, LinkLost, "positioner B", 0.005 + TOLD_S, Trigger.HEARTBEAT_LOST),
    "MB-03 all reset": Row(reset_all, LinkLost, "positioner", 0.12 + TOLD_S, Trigger.HEARTBEAT_LOST, slow=True),
    "MB-04 reply cut short": Row(once(cut), None, "", 0.0),
    "MB-04 replies cut short": Row(always(cut), DeviceSilent, "positioner B", SILENT_S, Trigger.FEEDBACK_MISSING),
    "MB-05 late replies": Row(late_by_one, None, "", 0.0),
    "MB-05 registers frozen": Row(
        freeze, FeedbackMissing, "B.X", (MISSING_CYCLES + 1.0) * POLL_S + TOLD_S, Trigger.FEEDBACK_MISSING
    ),
    "MB-05 heartbeat not taken": Row(hang, DriveFault, "B.X", 0.12 + TOLD_S, Trigger.HEARTBEAT_LOST, slow=True),
    "MB-06 other unit": Row(other_unit, WrongIdentity, "positioner B", POLL_S + TOLD_S, Trigger.DRIVE_FAULT),
    "AX-05 limit switch": Row(press_limit, MotionError, "B.Z", TOLD_S, Trigger.LIMIT_SWITCH),
}
"""Positioner B is the victim. `slow`: its own watchdog stops it, along the ordinary ramp; it takes the others along.
Frozen registers go on as if all were well, but for the number of the scan. A switch may be read before its PLC has
stopped for it: one trigger all the same.
"""


def run_row(scene: ModbusScene, row: Row, monkeypatch: pytest.MonkeyPatch, share: float = 0.5) -> ReadyModbus:
    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(share, row.fault)

    cell = play_modbus(scene, story, monkeypatch)
    cell.assert_no_second_start()
    assert cell.residual_mm() <= cell.stated_mm(), (cell.residual_mm(), cell.stated_mm())
    cell.assert_at_rest_and_braked()
    return cell


@pytest.mark.parametrize("name", ROWS)
def test_a_row_on_the_lab_cell(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_row(LAB, name, monkeypatch)


@pytest.mark.parametrize("name", ["MB-01 replies lost", "MB-03 connection reset", "AX-05 limit switch"])
def test_a_row_on_the_fuselage_cell(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_row(FUSELAGE, name, monkeypatch)


def assert_row(scene: ModbusScene, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]
    cell = run_row(scene, row, monkeypatch)
    result = cell.result
    assert result is not None, cell.refused
    if row.error is None:
        assert (result.result, result.cause) == ("done", None)
        last = cell.record.motors()[1][-1]
        assert np.abs(last - cell.plan.q_mm[-1]).max() <= 0.002
        return
    assert result.result == "fault"
    assert isinstance(result.cause, row.error), repr(result.cause)
    assert row.where in str(result.cause)
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is row.trigger
    ramp_s = cell.cell.bus.ramp_s if row.slow else cell.motion._bus.quick_ramp_s  # type: ignore[union-attr]
    bound_s = row.told_s + ramp_s + 2.0 * SCAN_S
    stood_s = cell.stood_s()
    print(f"{scene.name} {name}: at rest {stood_s:.3f} s after it, {bound_s:.3f} s stated; residual "
          f"{cell.residual_mm():.4f} of {cell.stated_mm():.4f} mm; {result.cause}")  # fmt: skip
    assert stood_s <= bound_s
    if row.fault is reset_all:
        return
    # Where the motors stand is where the result says that they stand.
    motor = cell.record.motors()[1][-1]
    assert np.abs(motor - result.commanded_mm).max() <= cell.stated_mm() + 0.01


def test_mb_04_replies_in_pieces_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sliced at every byte, each piece in a segment of its own."""

    class Sliced:
        def __init__(self) -> None:
            self.count = 0

    seen = Sliced()

    def fault(cell: ReadyModbus) -> None:
        connection = next(c for c in cell.group._connections if c.serves(cell.victim))
        write = connection._transport.write

        def sliced(data: bytes) -> None:
            seen.count += 1
            at = seen.count % len(data)
            write(data[:at])
            cell.loop.call_later(0.004, write, data[at:])

        connection._transport.write = sliced  # type: ignore[method-assign]

    cell = run_row(LAB, Row(fault, None, "", 0.0), monkeypatch)
    assert cell.result is not None
    assert cell.result.result == "done"
    assert seen.count > 40


# before anything moves ----------------------------------------------------------------------------------------------
def swap_hosts(cell: ReadyModbus) -> None:
    plcs = cell.group.plcs
    plcs[0]._identity, plcs[1]._identity = plcs[1]._identity, plcs[0]._identity


def swap_words(cell: ReadyModbus) -> None:
    identity = cell.victim._identity
    cell.victim._identity = identity[2:4] + identity[:2] + identity[4:]


def little_positions(cell: ReadyModbus) -> None:
    """Only the strokes have their words swapped."""
    words = struct.unpack(">18H", cell.victim._limits)
    cell.victim._limits = struct.pack(">18H", *(words[i ^ 1] for i in range(18)))


def no_watchdog(cell: ReadyModbus) -> None:
    take = cell.victim._set

    def without(settings: Any) -> None:
        settings.watchdog_ms = 0
        take(settings)

    cell.victim._set = without  # type: ignore[method-assign]


def five_seconds(cell: ReadyModbus) -> None:
    take = cell.victim._set

    def longer(settings: Any) -> None:
        settings.watchdog_ms = 5000
        take(settings)

    cell.victim._set = longer  # type: ignore[method-assign]


NOGO = {
    "MB-06 swapped hosts": (swap_hosts, WrongIdentity, "positioner A"),
    "MB-07 word order": (swap_words, BadReply, "positioner B"),
    "MB-07 words of positions": (little_positions, ReadBackMismatch, "positioner B, stroke of X"),
    "MB-08 watchdog off": (no_watchdog, ReadBackMismatch, "positioner B, watchdog_ms"),
    "MB-08 watchdog of 5 s": (five_seconds, ReadBackMismatch, "positioner B, watchdog_ms"),
}


@pytest.mark.parametrize("name", NOGO)
def test_nothing_is_powered_on_what_is_not_proved(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, error, where = NOGO[name]

    async def story(cell: ReadyModbus) -> None:
        change(cell)
        with pytest.raises(error) as refused:
            await cell.bring_up()
        assert where in str(refused.value)
        await asyncio.sleep(0.5)
        assert not any(tick.powered.any() for tick in cell.recorded.ticks)
        assert not cell.commands

    play_modbus(LAB, story, monkeypatch)


@pytest.mark.parametrize("scene", [LAB, FUSELAGE], ids=lambda scene: scene.name)
def test_mb_08_a_silent_host_is_noticed_by_every_plc(scene: ModbusScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The host dies as a process does: sockets stay open, nothing is said any more."""

    def die(cell: ReadyModbus) -> None:
        assert cell.motion._keeper is not None
        cell.motion._keeper.cancel()

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        begun = cell.loop.create_task(cell.move(0.5, die))
        await asyncio.sleep(0.5 * cell.plan.duration_s + 3.0)
        begun.cancel()
        await asyncio.gather(begun, return_exceptions=True)
        cell.watched_until_s = cell.loop.time()

    cell = play_modbus(scene, story, monkeypatch)
    t_s, target = cell.record.set_points(cell.fault_s)
    steps = np.abs(np.diff(target, axis=0)).max(axis=1) / np.diff(t_s)
    slowed_s = t_s[1:][steps < 0.97 * steps[0]][0] - cell.fault_s
    assert slowed_s <= 0.15
    assert cell.stood_s() <= 0.12 + cell.cell.bus.ramp_s + TOLD_S  # type: ignore[union-attr]
    assert cell.residual_mm() <= cell.stated_mm()
    assert {plc.fault for plc in cell.group.plcs} <= {reg.Fault.WATCHDOG, reg.Fault.GROUP_LINE}
    cell.assert_at_rest_and_braked()


def lose_scans(cell: ReadyModbus) -> None:
    """B plays nothing in three scans, as if its task had been overrun; then it goes on."""
    cell.victim.queue.lead_s = -3.0 * SCAN_S


def test_mb_05_path_times_apart_stop_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every axis is on its path and follows; only the places on the path are not one."""

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        await cell.move(0.5, lose_scans)

    cell = play_modbus(LAB, story, monkeypatch)
    assert cell.result is not None
    assert isinstance(cell.result.cause, ConsistencyTrip)
    assert cell.result.cause.where == "path times"
    assert "B is last" in str(cell.result.cause)
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is Trigger.COUPLING
    # Lost in three scans, told by the second read-back after that; nothing makes up for it.
    assert cell.stood_s() <= 3.0 * SCAN_S + 2.0 * POLL_S + TOLD_S + cell.motion._bus.quick_ramp_s + 2.0 * SCAN_S
    speed = float(np.linalg.norm(peak_mm_s(cell.plan).reshape(-1, 3), axis=1).max())
    assert cell.residual_mm() <= 3.0 * SCAN_S * speed + cell.stated_mm()
    cell.assert_at_rest_and_braked()


# a dying axis -------------------------------------------------------------------------------------------------------
def at_peak(plan: Plan, k: int) -> float:
    """Where axis k is fastest, as a share of the move's time."""
    speed = np.abs(np.diff(plan.q_mm[:, k]))
    fastest = np.flatnonzero(speed >= 0.999 * speed.max())
    return float(fastest[len(fastest) // 2] / len(speed))


@dataclass(frozen=True)
class Stated:
    """Formula 3 at the planned peak speed of an axis: mm at the worst ball, N of internal force."""

    residual_mm: float
    force_n: float


def stated(cell: ReadyModbus, faster: float = 1.0) -> list[Stated]:
    """d = stuck + v (2 scans + lag) + v t / 2, t = max(2 scans, max_i v_i / a_i); times the column of each axis.

    `faster` is how many times the plan's own speeds.
    """
    axes, bus = cell.positioners, cell.cell.bus
    peak = faster * peak_mm_s(cell.plan)
    ramp_s = max(2.0 * SCAN_S, float(np.max(peak / axes.a_quick_mm_s2)))
    d_mm = cell.cell.limits.stuck_mm + peak * (2.0 * SCAN_S + bus.servo_lag_s + 0.5 * ramp_s)
    balls = socket_positions(axes, cell.plan.q_mm[0])
    to_ball = np.zeros((len(axes.axes), len(axes.axes)))
    for i, columns in enumerate(axes.axes_W):
        to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = columns
    residual = worst_balls(consistency_projector(balls) @ to_ball)
    force = worst_balls(internal_force_matrix(axes, balls))
    return [Stated(float(d * r), float(d * f)) for d, r, f in zip(d_mm, residual, force, strict=True)]


def worst_balls(columns: Array) -> Array:
    worst: Array = np.linalg.norm(columns.reshape(len(columns) // 3, 3, -1), axis=1).max(axis=0)
    return worst


@dataclass(frozen=True)
class Jam:
    """An axis seizes where it is fastest (or at `share`), at the worst phase of a scan unless one is given.

    `tight`: the plant has no play between motor and ball, which takes up some of the force.
    """

    cell: str
    axis: str
    speed_mm_s: float
    tight: bool = True
    share: float | None = None
    phase: float | None = None

    def scene(self) -> ModbusScene:
        shift_mm = 3.0 if self.speed_mm_s <= 1.0 else 8.0 if self.cell == "lab-modbus" else 16.0
        off = PLAY if self.tight else ()
        return ModbusScene(
            self.cell, seed=3, shift_mm=shift_mm, turn_deg=0.1, speed_mm_s=self.speed_mm_s, errors_off=off
        )


PLAY = ("ball_clearance", "backlash", "stick_slip", "repeatability")
SPAN = 1.5
"""The stated bound may be this much above the worst that is measured, the speed this much ..."""
SLOWER = 0.8
"""... below what the formula lets: no bound is met by crawling."""
FEW_JAMS = (
    Jam("fuselage-modbus", "A.X", 5.0),
    Jam("fuselage-modbus", "C.Z", 5.0, tight=False),
    Jam("fuselage-modbus", "D.Y", 1.0, share=0.5),
    Jam("wing-modbus", "A.X", 8.0),
)


def jam_cases() -> list[Any]:
    """A few by default; in full every axis of the large cells, tight and with play, over the phases of a scan, at its
    peak and elsewhere, fast and slow."""
    whole = [
        Jam(name, f"{station}.{axis}", speed, tight, share, phase)
        for name, stations in (("fuselage-modbus", "ABCD"), ("wing-modbus", "ABC"))
        for station in stations
        for axis in "XYZ"
        for speed, tight, share, phase in (
            *((8.0, True, None, phase) for phase in (None, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)),
            (8.0, False, None, None),
            *((5.0, True, share, None) for share in (0.2, 0.35, 0.6)),
            (1.0, True, None, None),
        )
    ]
    return [pytest.param(jam, id=jam_name(jam)) for jam in FEW_JAMS] + [
        pytest.param(jam, id=jam_name(jam), marks=pytest.mark.full) for jam in whole if jam not in FEW_JAMS
    ]


def jam_name(jam: Jam) -> str:
    parts = [jam.cell, jam.axis, f"{jam.speed_mm_s:g}", "tight" if jam.tight else "play"]
    parts += [f"at{jam.share}"] * (jam.share is not None) + [f"phase{jam.phase}"] * (jam.phase is not None)
    return "-".join(parts)


def seize(jam: Jam, monkeypatch: pytest.MonkeyPatch) -> ReadyModbus:
    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        k = cell.index(jam.axis)
        phase = worst_phase(cell, k) if jam.phase is None else jam.phase
        share = at_peak(cell.plan, k) if jam.share is None else jam.share
        await cell.move(share, lambda cell: cell.recorded.seize_within(jam.axis, phase), weigh=True)

    return play_modbus(jam.scene(), story, monkeypatch)


def worst_phase(cell: ReadyModbus, k: int) -> float:
    """The axis hangs back by just less than `stuck_mm` when it is looked at, and is seen one scan later."""
    scans = cell.cell.limits.stuck_mm / (SCAN_S * float(peak_mm_s(cell.plan)[k]))
    return float(min(np.ceil(scans) - scans + 0.05, 0.99))


@pytest.mark.parametrize("jam", jam_cases())
def test_ax_08_a_seized_axis_costs_no_more_than_the_formula(jam: Jam, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = seize(jam, monkeypatch)
    k, plan, limits = cell.index(jam.axis), cell.plan, cell.cell.limits
    bound, peak = stated(cell)[k], float(peak_mm_s(plan)[k])
    force_n, residual_mm = cell.force_rise_n(), cell.residual_mm()
    print(f"AX-08 {jam_name(jam)}: peak {peak:.2f} mm/s, {residual_mm:.3f} of {bound.residual_mm:.3f} mm "
          f"(x {bound.residual_mm / residual_mm:.2f}), {force_n:.0f} of {bound.force_n:.0f} N "
          f"(x {bound.force_n / max(force_n, 1.0):.2f}); {plan.speed_limited_by}")  # fmt: skip
    assert cell.result is not None
    # A crawling axis may be found by the host's own watch before it hangs back far enough for its PLC.
    assert isinstance(cell.result.cause, DriveFault | AxisStuck)
    assert jam.axis in str(cell.result.cause)
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is Trigger.STUCK
    assert residual_mm <= bound.residual_mm + cell.stated_mm()
    assert force_n <= bound.force_n + NOISE_N
    if jam.share is None and jam.phase is None and bound.force_n > 5.0 * NOISE_N:
        assert bound.residual_mm <= SPAN * residual_mm
        assert not jam.tight or bound.force_n <= SPAN * force_n
    assert_planned_to_the_formula(cell)
    # It is seen when it hangs back by stuck_mm, which takes a crawling axis its time.
    row = int((at_peak(plan, k) if jam.share is None else jam.share) * plan.duration_s / plan.period_s)
    there_mm_s = abs(plan.q_mm[row + 1, k] - plan.q_mm[row, k]) / plan.period_s
    assert cell.stood_s(jam.axis) <= 1.2 * limits.stuck_mm / there_mm_s + 0.1
    cell.assert_at_rest_and_braked()
    cell.assert_no_second_start()


NOISE_N = 60.0
"""What read-backs in micrometres and the friction of tilting balls make of forces, whatever the axes do."""


def assert_planned_to_the_formula(cell: ReadyModbus) -> None:
    """The planner states what the formula says, keeps the limits by it, and goes as fast as it lets."""
    plan, limits = cell.plan, cell.cell.limits
    bounds, own = plan.bounds, stated(cell)
    assert bounds is not None
    np.testing.assert_allclose(bounds.jam_mm, [one.residual_mm for one in own], rtol=0.05, atol=0.001)
    np.testing.assert_allclose(bounds.jam_n, [one.force_n for one in own], rtol=0.05, atol=5.0)
    assert bounds.jam_n.max() <= 1.001 * limits.internal_force_n
    assert bounds.jam_mm.max() <= 1.001 * limits.ball_residual_mm
    if "jammed" in plan.speed_limited_by:
        beyond = stated(cell, 1.0 / SLOWER)
        over = max(max(b.force_n / limits.internal_force_n, b.residual_mm / limits.ball_residual_mm) for b in beyond)
        assert over >= 1.0


FAILED = [("fuselage-modbus", "A.X", True), ("lab-modbus", "C.Z", False)]


def failed_cases() -> list[Any]:
    cells = ("fuselage-modbus", "ABCD"), ("lab-modbus", "ABCD"), ("wing-modbus", "ABC")
    whole = [(name, f"{s}.{a}", torque) for name, row in cells for s in row for a in "XYZ" for torque in (True, False)]
    return [
        pytest.param(*case, id="-".join(map(str, case)), marks=[] if case in FAILED else [pytest.mark.full])
        for case in whole
    ]


@pytest.mark.parametrize(("name", "axis", "torque"), failed_cases())
def test_ax_08_a_drive_in_fault_ramps_by_itself_and_takes_the_others_along(
    name: str, axis: str, torque: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own ramp, or its brake where the torque is gone, begins a scan before its PLC knows."""
    scene = Jam(name, axis, 8.0).scene()

    async def story(cell: ReadyModbus) -> None:
        await cell.bring_up()
        await cell.ready()
        share = at_peak(cell.plan, cell.index(axis))
        await cell.move(share, lambda cell: cell.group.fail_drive(axis, torque), weigh=True)

    cell = play_modbus(scene, story, monkeypatch)
    k = cell.index(axis)
    t_s, motor = cell.record.motors(cell.fault_s - 2.0 * SCAN_S)
    speed = np.abs(np.diff(motor, axis=0)) / SCAN_S
    stopped_s = [float(t_s[1:][speed[:, i] > 0.02][-1]) for i in (k, (k + 3) % len(cell.positioners.axes))]
    print(f"AX-08 drive in fault {name} {axis} torque {torque}: {cell.residual_mm():.4f} mm, "
          f"{cell.force_rise_n():.0f} N; at rest {stopped_s[0] - cell.fault_s:.3f} s, another "
          f"{stopped_s[1] - cell.fault_s:.3f} s after it")  # fmt: skip
    assert cell.result is not None
    assert isinstance(cell.result.cause, DriveFault)
    assert cell.result.cause.where == axis
    assert cell.motion.arbiter.first is not None
    assert cell.motion.arbiter.first.trigger is Trigger.DRIVE_FAULT
    # It has left the path: it rests before the others, on a ramp of its own.
    assert stopped_s[0] < stopped_s[1]
    assert cell.stood_s() <= TOLD_S + cell.motion._bus.quick_ramp_s + 2.0 * SCAN_S
    assert cell.residual_mm() <= 0.1
    assert cell.force_rise_n() <= cell.cell.limits.internal_force_n
    cell.assert_at_rest_and_braked()
