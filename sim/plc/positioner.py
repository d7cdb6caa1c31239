"""One positioner PLC: its registers and what it does with them in each scan.

Power and brakes: power on, then brakes open; to disable: standstill, brakes closed, then power off. Every stop is a
ramp of the playback rate. Two lines are common to all PLCs, each high only while all release it: a PLC that stops holds
RUN low, and all ramp and wait; one with an axis in fault drops GROUP_OK, and all take the quick ramp, brake and go off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from docking.config.cell import PositionerConfig
from sim.plc import registers as reg
from sim.plc.axes import AxisGuard
from sim.plc.modbus_tcp import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusRefusal
from sim.plc.playback import Playback, Point
from sim.plc.registers import Command, Fault, Reject, State
from sim.plc.segments import Segment, SegmentGate
from sim.plc.sensors import Sensors

SCAN_S = 0.01
CAPACITY = 256
POWER_ON_S, BRAKE_S, RUN_LINE_WAIT_S = 0.05, 0.15, 1.0
STANDSTILL_S = 0.1
"""Time between the end of a ramp and the closing of the brakes: the axes lag behind their set-points."""
RELEASING = frozenset((State.ARMED, State.RUNNING, State.DONE))
POWERED = frozenset(State) - {State.DISABLED, State.FAULT}
UNBRAKED = POWERED - {State.ENABLING, State.DISABLING}
STANDING = frozenset((State.DISABLED, State.ENABLED, State.HELD, State.DONE))


class Lines(NamedTuple):
    """The two common lines, high or low, as all PLCs see them in one scan."""

    run: bool
    group_ok: bool


@dataclass
class Settings:
    """What the host sets while the PLC is disabled."""

    watchdog_ms: int = 0
    ramp_ms: int = 500
    min_fill: int = 2
    stuck_um: int = 20
    servo_lag_us: int = 0

    def possible(self) -> bool:
        in_time = self.watchdog_ms <= 5000 and 50 <= self.ramp_ms <= 5000
        return in_time and 2 <= self.min_fill <= CAPACITY and self.stuck_um >= 1


class PositionerPlc:
    """Registers, FIFO and state of one positioner. `late_s` is its delay on the common start edge."""

    def __init__(
        self,
        config: PositionerConfig,
        sensors: Sensors,
        trip_mm: float,
        clock: Callable[[], float],
        late_s: float = 0.0,
    ) -> None:
        self._config, self._sensors, self._clock, self._late_s = config, sensors, clock, late_s
        self._gate = SegmentGate(config)
        self.guard = AxisGuard(self._gate.driven, sensors, trip_mm)
        self.queue = Playback(CAPACITY)
        self.settings = Settings()
        self._quick_ramp_ms, self._rate_permille = self.settings.ramp_ms, reg.FULL_RATE
        self.state, self.fault = State.DISABLED, Fault.NONE
        self.braked, self.forgets_watchdog = True, False
        self.target_mm: Point = sensors.point_mm()
        self._after_stop = State.HELD
        self._clear_after_stop = False
        self._since_s = clock()
        self._plan_id = self._command_ack = 0
        self._segment_result, self._command_result = Reject.NONE, Reject.NONE
        self._pending: tuple[int, int, int] | None = None
        self._heartbeat, self._heartbeat_s, self._heartbeat_seen = 0, clock(), False
        self._lines = Lines(run=False, group_ok=True)
        self._drops_group, self._fault_axis = False, -1
        self._start_rate, self._scans = 0.0, 0
        self._station = reg.crc16(config.name.encode("ascii"))
        self._identity = self._identity_block()
        self._limits = b"".join(
            reg.LIMITS.pack(round(a.stroke_mm[0] * 1000), round(a.stroke_mm[1] * 1000), round(a.v_mm_s * 1000))
            for a in config.axes
        )

    def _identity_block(self) -> bytes:
        name = self._config.name.encode("ascii")
        return reg.IDENTITY.pack(
            reg.MAGIC, reg.MAP_VERSION, reg.AXES, round(SCAN_S * 1000), CAPACITY, name,
            b"SimPositioner", b"PLC-3", b"SP-" + name[:12], b"1.0",
        )  # fmt: skip

    # registers -----------------------------------------------------------------------------------------------------
    def read(self, address: int, count: int) -> bytes:
        """Registers of one block; a span that leaves its block is refused."""
        for start, block in (
            (reg.STATUS_AT, self._status),
            (reg.MOTION_AT, self._motion_block),
            (reg.SETTINGS_AT, self._settings_block),
            (reg.IDENTITY_AT, lambda: self._identity),
            (reg.LIMITS_AT, lambda: self._limits),
        ):
            if address >= start:
                data = block()[2 * (address - start) : 2 * (address - start + count)]
                if len(data) == 2 * count:
                    return data
        raise ModbusRefusal(ILLEGAL_ADDRESS)

    def write(self, address: int, data: bytes) -> None:
        """A whole block only: a command, a segment, the settings or a heartbeat. No single word moves an axis."""
        if address == reg.HEARTBEAT_AT and len(data) in (2, 2 + reg.SEGMENT_BYTES):
            self._beat(int.from_bytes(data[:2], "big"))
            if len(data) > 2:
                self._take_segment(data[2:])
        elif address == reg.COMMAND_AT and len(data) == reg.COMMAND.size:
            self._pending = reg.COMMAND.unpack(data)
        elif address == reg.SEGMENT_AT and len(data) == reg.SEGMENT_BYTES:
            self._take_segment(data)
        elif address == reg.SETTINGS_AT and len(data) == reg.SETTINGS.size:
            self._set(Settings(*reg.SETTINGS.unpack(data)))
        elif address == reg.MOTION_AT and len(data) == reg.MOTION.size:
            self._set_motion(*reg.MOTION.unpack(data))
        else:
            raise ModbusRefusal(ILLEGAL_ADDRESS)

    def opened(self) -> None:
        """A host has connected: some controllers forget the watchdog of the connection before."""
        if self.forgets_watchdog:
            self.settings = replace(self.settings, watchdog_ms=0)

    def _beat(self, count: int) -> None:
        if count != self._heartbeat:
            self._heartbeat, self._heartbeat_s, self._heartbeat_seen = count, self._clock(), True

    def _set(self, settings: Settings) -> None:
        if self.state is not State.DISABLED or not settings.possible():
            raise ModbusRefusal(ILLEGAL_VALUE)
        self.settings = settings
        self.queue.ramp_s = settings.ramp_ms / 1000.0
        self.guard.stuck_mm, self.guard.lag_s = settings.stuck_um / 1000.0, settings.servo_lag_us / 1e6
        self._set_motion(min(self._quick_ramp_ms, settings.ramp_ms), self._rate_permille)

    def _set_motion(self, quick_ramp_ms: int, rate_permille: int) -> None:
        """Quick ramp and rate, only while path time stands still: on the way they would differ for a scan."""
        possible = 2000.0 * SCAN_S <= quick_ramp_ms <= self.settings.ramp_ms and 1 <= rate_permille <= reg.FULL_RATE
        if self.state not in STANDING or not possible:
            raise ModbusRefusal(ILLEGAL_VALUE)
        self._quick_ramp_ms, self._rate_permille = quick_ramp_ms, rate_permille
        self.queue.quick_ramp_s = quick_ramp_ms / 1000.0

    def _take_segment(self, data: bytes) -> None:
        """Enter the segment, absorb a repetition of the last one, or say why not."""
        segment = Segment.decode(data)
        repeated = segment.sequence == self.queue.last_seq != 0 and segment.plan_id == self._plan_id
        if repeated and segment.intact:
            self._segment_result = Reject.NONE
            return
        if self.state not in UNBRAKED:
            self._segment_result = Reject.NOT_ENABLED
            return
        self._segment_result = self._gate.judge(segment, self.queue, self._plan_id, self._sensors.point_mm())
        if self._segment_result is Reject.NONE:
            self._plan_id = segment.plan_id
            self.queue.period_s = segment.dt_ms / 1000.0
            self.queue.push(segment.point_mm, segment.last)

    def _settings_block(self) -> bytes:
        s = self.settings
        return reg.SETTINGS.pack(s.watchdog_ms, s.ramp_ms, s.min_fill, s.stuck_um, s.servo_lag_us)

    def _motion_block(self) -> bytes:
        return reg.MOTION.pack(self._quick_ramp_ms, self._rate_permille)

    def _status(self) -> bytes:
        queue = self.queue
        flags = reg.STATUS_RUN_LINE * self._lines.run | reg.STATUS_GROUP_LINE * self._lines.group_ok
        flags |= reg.STATUS_WATCHDOG_ARMED * self._watchdog_armed
        head = reg.STATUS_HEAD.pack(
            self._scans & 0xFFFF, self._heartbeat, self.state, self.fault,
            self._command_ack, self._command_result, self._plan_id, queue.last_seq, queue.play_seq,
            min(int(queue.fraction * reg.FRACTION), reg.FRACTION - 1), queue.free, self._segment_result, flags,
            self._station,
        )  # fmt: skip
        rows = zip(self._sensors.words(), self._axis_bits(), strict=True)
        return head + b"".join([reg.STATUS_AXIS.pack(*row, bits) for row, bits in rows])

    def _axis_bits(self) -> list[int]:
        live = reg.AXIS_POWERED * self.powered | reg.AXIS_BRAKED * self.braked
        bits = [live if i in self._gate.driven else reg.AXIS_PASSIVE for i in range(reg.AXES)]
        if self._fault_axis >= 0:
            bits[self._fault_axis] |= reg.AXIS_FAULT
        return [b | reg.AXIS_LIMIT * pressed for b, pressed in zip(bits, self.guard.limit, strict=True)]

    # scan ----------------------------------------------------------------------------------------------------------
    @property
    def powered(self) -> bool:
        return self.state in POWERED

    @property
    def heard_s(self) -> float:
        """When the host's heartbeat changed last; NaN before the first."""
        return self._heartbeat_s if self._heartbeat_seen else float("nan")

    @property
    def _watchdog_armed(self) -> bool:
        return self.settings.watchdog_ms > 0 and self._heartbeat_seen

    @property
    def releases_run_line(self) -> bool:
        """False while this PLC pulls the RUN line low."""
        return self.state in RELEASING

    @property
    def releases_group_line(self) -> bool:
        """False while this PLC pulls the GROUP_OK line low."""
        return not self._drops_group

    def think(self, now_s: float) -> None:
        """First half of a scan: commands, watchdogs, timers."""
        self._scans += 1
        if self._pending is not None:
            self._execute(*self._pending, now_s)
            self._pending = None
        state = self.state
        if state is State.DISABLED or state is State.FAULT:
            return
        if self._watchdog_expired(now_s):
            self._trip(Fault.WATCHDOG, now_s)
        elif state is State.ENABLING:
            if now_s - self._since_s >= POWER_ON_S + BRAKE_S:
                self._enter(State.ENABLED, now_s)
        elif state is State.DISABLING:
            self.braked = self.braked or now_s - self._since_s >= STANDSTILL_S
            if now_s - self._since_s >= STANDSTILL_S + BRAKE_S:
                self._enter(State.FAULT if self.fault else State.DISABLED, now_s)
        elif state is not State.ENABLED:
            self._supervise(now_s)

    def play(self, lines: Lines, now_s: float, dt_s: float) -> None:
        """Second half of a scan, with the lines as all PLCs see them: `dt_s` of this PLC's clock pass."""
        self._lines = lines
        if not (lines.group_ok or self._drops_group) and self.state in POWERED and self.state is not State.DISABLING:
            self._trip(Fault.GROUP_LINE, now_s)
        if self.state is State.ARMED and lines.run:
            self._enter(State.RUNNING, now_s)
            goal = self._rate_permille / reg.FULL_RATE
            self.queue.start(self._start_rate * goal, goal, self._late_s)
            self.guard.commanded(self.target_mm, self.target_mm, 0.0)
            return
        if self.state is State.RUNNING and not lines.run:
            self._stop(State.HELD, now_s)
        if self.state is State.RUNNING or self.state is State.STOPPING:
            before_mm = self.target_mm
            self.queue.advance(dt_s)
            self.target_mm = self.queue.point()
            self.guard.commanded(before_mm, self.target_mm, dt_s)
            self._settle(now_s)

    def _settle(self, now_s: float) -> None:
        if self.state is State.RUNNING and self.queue.at_end:
            self._enter(State.DONE, now_s)
        elif self.state is State.STOPPING and (self.queue.rate == 0.0 or self.queue.remaining_s <= 0.0):
            finished = self.queue.at_end and self._after_stop is State.HELD
            if self._clear_after_stop:
                self.queue.clear()
            self._enter(State.DONE if finished else self._after_stop, now_s)

    def _watchdog_expired(self, now_s: float) -> bool:
        if self.fault or self.state is State.DISABLING:
            return False
        return not (now_s - self._heartbeat_s) * 1000.0 <= self.settings.watchdog_ms

    def _supervise(self, now_s: float) -> None:
        """Faults of an enabled PLC; an axis that fails in a ramp makes it a quick one."""
        state = self.state
        if state is State.ARMED:
            if now_s - self._since_s > RUN_LINE_WAIT_S:
                self._trip(Fault.RUN_LINE, now_s)
        elif (state is State.RUNNING or state is State.STOPPING) and not self._drops_group:
            found = self.guard.complaint()
            if found is not None:
                self._fault_axis = found[1]
                self._trip(found[0], now_s)
            elif state is State.RUNNING and self.queue.runs_dry(2.0 * SCAN_S):
                self._trip(Fault.UNDERRUN, now_s)

    def _enter(self, state: State, now_s: float) -> None:
        self.state, self._since_s = state, now_s
        self._drops_group = self._drops_group or (state is State.DISABLING and self.fault is not Fault.NONE)
        if state is not State.DISABLING:
            self.braked = state not in UNBRAKED

    def _trip(self, fault: Fault, now_s: float) -> None:
        """Stop, brake and switch off; the first fault is the one that is kept."""
        self.fault = self.fault or fault
        if fault not in reg.RAMPED:
            self._drops_group = True
            self.queue.stop(quick=True)
        self._stop(State.DISABLING, now_s)

    def _stop(self, then: State, now_s: float, clear: bool = False) -> None:
        """Ramp down if path time runs, then go to `then`; a stop that asks for more overrides a weaker one."""
        if self.state is State.STOPPING and self._after_stop is State.DISABLING:
            return
        self._after_stop, self._clear_after_stop = then, clear or self._clear_after_stop
        if self.state is State.RUNNING or self.state is State.STOPPING:
            self.queue.stop()
            self._enter(State.STOPPING, now_s)
            return
        if clear:
            self.queue.clear()
        self._enter(then, now_s)

    # commands ------------------------------------------------------------------------------------------------------
    def _execute(self, sequence: int, code: int, mask: int, now_s: float) -> None:
        """Carry out a command once: a repetition of the last number is absorbed, a gap is refused."""
        if sequence == self._command_ack:
            return
        if sequence != reg.following(self._command_ack):
            self._command_result = Reject.COMMAND_SEQUENCE
            return
        self._command_ack = sequence
        try:
            command = Command(code)
        except ValueError:
            self._command_result = Reject.UNKNOWN
            return
        self._command_result = self._obey(command, mask, now_s)

    def _obey(self, command: Command, mask: int, now_s: float) -> Reject:
        if command is Command.ENABLE:
            return self._enable(mask, now_s)
        if command is Command.RUN:
            return self._arm(State.ENABLED, 1.0, now_s)
        if command is Command.RESUME:
            return self._arm(State.HELD, 0.0, now_s)
        if command is Command.FAULT_RESET:
            return self._reset(now_s)
        return self._halt(command, now_s)

    def _enable(self, mask: int, now_s: float) -> Reject:
        if mask != sum(1 << i for i in self._gate.driven):
            return Reject.MASK
        if not self._watchdog_armed:
            return Reject.WATCHDOG
        if not self._lines.group_ok:
            return Reject.GROUP_LINE
        if self.state is State.DISABLED:
            self.target_mm = self._sensors.point_mm()
            self.queue.clear()
            self._clear_after_stop = False
            self._enter(State.ENABLING, now_s)
        elif self.state is State.FAULT or self.state is State.DISABLING:
            return Reject.STATE
        return Reject.NONE

    def _arm(self, origin: State, rate: float, now_s: float) -> Reject:
        """Release the RUN line; path time runs when all others have released it too."""
        if self.state is not origin:
            return Reject.STATE
        queue = self.queue
        if not queue.knots or not (queue.complete or len(queue.knots) >= self.settings.min_fill):
            return Reject.TOO_FEW
        self._start_rate = rate
        self._clear_after_stop = False
        self._enter(State.ARMED, now_s)
        return Reject.NONE

    def _reset(self, now_s: float) -> Reject:
        if self.state is not State.FAULT:
            return Reject.STATE
        self.fault, self._fault_axis, self._drops_group = Fault.NONE, -1, False
        self._enter(State.DISABLED, now_s)
        return Reject.NONE

    def _halt(self, command: Command, now_s: float) -> Reject:
        """Hold, clear, disable and quick stop; nothing to do is no error."""
        state = self.state
        if state is State.DISABLED or state is State.FAULT or state is State.DISABLING:
            return Reject.NONE
        if command is Command.HOLD:
            if state is State.ARMED or state is State.RUNNING:
                self._stop(State.HELD, now_s)
        elif command is Command.CLEAR:
            if state is State.ENABLING:
                return Reject.STATE
            self._stop(State.ENABLED, now_s, clear=True)
        elif command is Command.QUICK_STOP:
            self._trip(Fault.QUICK_STOP, now_s)
        else:
            self._stop(State.DISABLING, now_s, clear=True)
        return Reject.NONE
