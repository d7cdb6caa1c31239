"""Positioner PLCs that play a queue of segments after one common start edge (docking.ports.QueuedPositioners)."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TypeVar, cast

import numpy as np

from docking.config.cell import CellFile, ModbusBus
from docking.errors import (
    BadArgument,
    DeviceRefused,
    DeviceSilent,
    DockingError,
    EnableFailed,
    LinkLost,
    OutcomeUnknown,
    SegmentRejected,
)
from docking.ports import SerialLink
from docking.types import Array, AxisState, FaultKind, Feedback, Identity, Plan
from drivers.modbus_client import Tap
from drivers.modbus_wires import require_line, units_of
from drivers.path_clocks import PathClock, apart_s
from drivers.plc_watch import PlcWatch
from drivers.positioner_plc import ENABLE_S, PositionerPlc, Segments
from drivers.register_map import load_map

RESERVE_S = 1.0
"""Path time kept in the queues beyond what a stop needs."""
PUSHES_A_POLL, PREFILL_TRIES = 4, 10
MISSES = 2
START_MM, BUSY = 0.01, 6
VERBS = ("run", "hold", "resume", "stop", "quick-stop", "reset")
T = TypeVar("T")
_MOVING = ("armed", "running", "held", "done", "enabled")


def _shown(plc: PositionerPlc) -> AxisState:
    """What the driven axes of this PLC are doing."""
    state = plc.state
    if state == "stopping":
        return AxisState.STOPPING
    if state == "fault" or plc.fault:
        return AxisState.FAULT
    return AxisState.ENABLED if state in _MOVING else AxisState.DISABLED


class ModbusPositioners:
    """All positioners of a cell, one PLC each; construct and use it inside one running loop.

    `addresses` overrides host and port of the cell file by positioner name, `link` its serial line; `tap` hears all
    bytes of TCP connections.
    """

    def __init__(
        self,
        cell: CellFile,
        addresses: Mapping[str, tuple[str, int]] | None = None,
        tap: Tap | None = None,
        link: SerialLink | None = None,
    ) -> None:
        if not isinstance(cell.bus, ModbusBus):
            raise BadArgument("bus", "this cell has no Modbus positioners", value=cell.bus.kind)
        self._cell, self._bus, self._tap, self._link = cell, cell.bus, tap, link
        self._driven = np.array(cell.driven)
        self._a_quick = np.array([axis.a_quick_mm_s2 for p in cell.positioners for axis in p.axes])
        self.axes = cell.axis_names
        self.segment_s = self._bus.segment_s
        self._map = load_map(self._bus.map)
        require_line(self._bus, self._map, len(cell.positioners))
        given = addresses or {}
        self._addresses = {p.name: given.get(p.name, (p.host or "127.0.0.1", p.port or 502)) for p in cell.positioners}
        self._min_fill = math.ceil((0.5 * self._bus.ramp_s + 0.5 * RESERVE_S) / self.segment_s) + 2
        self._depth = math.ceil((0.5 * self._bus.ramp_s + RESERVE_S) / self.segment_s) + 2
        self._plcs: tuple[PositionerPlc, ...] = ()
        self._watches: tuple[PlcWatch, ...] = ()
        self._clocks: tuple[PathClock, ...] = ()
        self._alone = asyncio.Lock()
        self.on_lost: Callable[[], None] = lambda: None
        self._stuck_mm = cell.limits.stuck_mm
        self.ramp_s = self.quick_ramp_s = self._bus.ramp_s
        self._rate = 1.0
        self._told_quick_stop = False
        um = 1.0 / self._map.scale["position_per_mm"]
        self._units = np.array([[um], [um], [self._map.scale["force_n"]]])
        self._shown: list[AxisState] = []
        self._axis_states: tuple[AxisState, ...] = ()

    async def bring_up(self) -> tuple[Identity, ...]:
        """Connect to every PLC, prove identity, scan, settings and strokes; axes stay disabled."""
        self._plcs = tuple(
            PositionerPlc(p, self._bus, self._map, unit)
            for p, unit in zip(
                self._cell.positioners,
                units_of(self._cell, self._bus, self._addresses, self._tap, self._link),
                strict=True,
            )
        )
        self._watches = tuple(PlcWatch(self._bus.scan_s) for _ in self._plcs)
        # Two controllers, or one and the host: each off by no more than the cell's clocks are.
        drift = 2e-6 * self._bus.clock_ppm
        self._clocks = tuple(PathClock(self._bus.scan_s, self._bus.ramp_s, drift) for _ in self._plcs)
        settings = self._settings()
        identities = tuple(await self._all(plc.bring_up(settings) for plc in self._plcs))
        for plc in self._plcs:
            plc.unit.on_lost = lambda: self.on_lost()
        return identities

    def _settings(self) -> dict[str, int]:
        """The settings block by names of the map. A watchdog of 0 ms would be none."""
        return {
            "watchdog_ms": max(1, round(self._bus.watchdog_s * 1000.0)),
            "ramp_ms": round(self._bus.ramp_s * 1000.0),
            "min_fill": self._min_fill,
            "stuck_um": round(self._stuck_mm * 1000.0),
            "servo_lag_us": round(self._bus.servo_lag_s * 1e6),
        }

    async def enable(self) -> Feedback:
        """Enable the driven axes where they stand; EnableFailed names a PLC that is in fault or does not follow."""
        self._require_up()
        settings = self._settings()
        async with self._alone:
            await self._reconnect()
            await self._all(plc.refresh() for plc in self._plcs)
            ill = [plc for plc in self._plcs if plc.state == "fault"]
            for plc in sorted(ill, key=lambda plc: plc.comes_after):
                raise EnableFailed(plc.where, plc.fault_words(), value="fault")
            await self._all(plc.arm(settings) for plc in self._plcs if plc.state == "disabled")
            await self._all(plc.command("enable") for plc in self._plcs)
            await self._all(plc.reach(ENABLE_S, "enabled", "held", "done") for plc in self._plcs)
            self._told_quick_stop = False
            return self._feedback()

    def _require_up(self) -> None:
        if not self._plcs:
            raise LinkLost(f"positioner {self._cell.positioners[0].name}", "not brought up")

    async def _reconnect(self) -> None:
        """On request only: whatever has lost its connection is proved anew."""
        await self._all(plc.reconnect(self._settings()) for plc in self._plcs)
        for plc in self._plcs:
            plc.unit.on_lost = lambda: self.on_lost()

    async def load(self, plan: Plan) -> None:
        """Clear all queues, write the quick ramp of `plan` and fill them with its start. Nothing moves.

        Raises SegmentRejected when the plan does not begin at the read-back (0.01 mm) or a PLC rejects a segment.
        """
        if plan.axes != self.axes or not abs(plan.period_s - self.segment_s) <= 1e-9:
            raise BadArgument(
                "plan", "axes or period differ from the cell's", value=plan.period_s, limit=self.segment_s
            )
        if not np.isfinite(plan.q_mm).all():
            raise BadArgument("plan", "a position is no number", value=float("nan"))
        self._require_up()
        async with self._alone:
            await self._all(plc.command("stop") for plc in self._plcs)
            await self._all(plc.reach(self._bus.ramp_s + ENABLE_S, "enabled") for plc in self._plcs)
            self._check_start(plan)
            self.quick_ramp_s = self._quick_ramp_of(plan)
            await self._set_motion()
            per_mm = self._map.scale["position_per_mm"]
            raw = np.rint(plan.q_mm * per_mm).astype(np.int64)
            for i, plc in enumerate(self._plcs):
                rows = tuple(map(tuple, raw[:, 3 * i : 3 * i + 3].tolist()))
                plc.take(Segments(plan.plan_id & 0xFFFFFFFF, round(self.segment_s * 1000), rows))
                self._clocks[i].forget()
            await self._all(self._prefill(plc) for plc in self._plcs)

    def _quick_ramp_of(self, plan: Plan) -> float:
        """Time in which no axis brakes harder than its quick-stop deceleration from its peak speed in `plan`.

        One time for all, so that all stop at one place of the path: max_i v_i / a_i, up to a whole scan, at least two.
        """
        peak_mm_s = np.abs(np.diff(plan.q_mm, axis=0)).max(axis=0) / plan.period_s
        time_s = float(np.max((peak_mm_s / self._a_quick)[self._driven]))
        scan_s = self._bus.scan_s
        quick_s = max(2, math.ceil(time_s / scan_s - 1e-9)) * scan_s
        if not quick_s <= self._bus.ramp_s:
            cause = "An ordinary stop would be harder than the axes' quick stop."
            raise BadArgument("ramp_s", cause, value=self._bus.ramp_s, limit=quick_s)
        return quick_s

    async def _set_motion(self) -> None:
        await self._all(plc.set_motion(self.quick_ramp_s, self._rate) for plc in self._plcs)

    async def override(self, rate: float) -> None:
        """Playback rate (over 0, to 1) from the next run or resume on; path time must stand still."""
        if not 0.0 < rate <= 1.0:
            raise BadArgument("rate", "over 0, at most 1", value=rate, limit=1.0)
        self._require_up()
        async with self._alone:
            self._rate = rate
            await self._set_motion()

    def _check_start(self, plan: Plan) -> None:
        off_mm = np.where(self._driven, np.abs(plan.q_mm[0] - self._position_mm()), 0.0)
        worst = int(np.argmax(off_mm))
        if not off_mm[worst] <= START_MM:
            cause = f"the plan begins {off_mm[worst]:.4f} mm from where the axis stands"
            raise SegmentRejected(self.axes[worst], cause, value=6)

    async def _prefill(self, plc: PositionerPlc) -> None:
        for _ in range(PREFILL_TRIES * self._depth):
            if not plc.waiting or plc.depth >= self._depth:
                return
            await self._push_or_look(plc)
        raise SegmentRejected(plc.where, f"it acknowledged only {plc.pushed} segments", value="silent")

    @staticmethod
    async def _push_or_look(plc: PositionerPlc) -> None:
        """Push; when the reply is lost, read back once. A second loss in a row is raised."""
        try:
            await plc.push()
        except OutcomeUnknown:
            await plc.look()

    async def command(self, verb: str) -> None:
        """`run`, `hold`, `resume`, `stop`, `quick-stop` or `reset` on every PLC.

        All PLCs are tried before an error is raised. A `run` or `resume` that one PLC did not take is withdrawn from
        the others: the common line cannot rise before all have taken it.
        """
        if verb not in VERBS:
            raise BadArgument("verb", f"one of {', '.join(VERBS)}", value=verb)
        self._require_up()
        async with self._alone:
            self._told_quick_stop = verb == "quick-stop" or self._told_quick_stop
            if verb in ("stop", "quick-stop"):
                for plc in self._plcs:
                    plc.abandon()
            if verb == "reset":
                await self._reconnect()
            try:
                await self._all(plc.command(verb) for plc in self._plcs if self._concerns(verb, plc))
            except DockingError:
                if verb in ("run", "resume"):
                    await asyncio.gather(*(plc.command("hold") for plc in self._plcs), return_exceptions=True)
                raise

    @staticmethod
    def _concerns(verb: str, plc: PositionerPlc) -> bool:
        """A reset is for those in fault; a resume for those that a hold caught before the end of their queue."""
        return plc.state == "fault" if verb == "reset" else not (verb == "resume" and plc.state == "done")

    async def poll(self, *, surviving: bool = False) -> Feedback:
        """One cycle: heartbeat and next segment out, status in, from all PLCs at once.

        Raises DeviceSilent after two lost replies in a row, LinkLost on a broken connection or a heartbeat that
        stands still, SegmentRejected when a PLC rejects a segment. With `surviving` a PLC that fails is only shown as
        old, by its `age_cycles`.
        """
        self._require_up()
        async with self._alone:
            cycles = [self._cycle(plc, watch) for plc, watch in zip(self._plcs, self._watches, strict=True)]
            if surviving:
                results = await asyncio.gather(*cycles, return_exceptions=True)
                for watch, result in zip(self._watches, results, strict=True):
                    watch.misses += isinstance(result, DockingError) and not isinstance(result, DeviceSilent)
            else:
                await self._all(cycles)
            if any(plc.fault for plc in self._plcs) and self._ill() is None and not self._told_quick_stop:
                # Those that were read first show only that the line fell; the one that dropped it has its fault by now.
                await asyncio.gather(*(plc.refresh() for plc in self._plcs), return_exceptions=True)
            return self._feedback()

    def _ill(self) -> PositionerPlc | None:
        """The first PLC with a fault of its own."""
        return next((plc for plc in self._plcs if plc.fault and not plc.comes_after), None)

    async def _cycle(self, plc: PositionerPlc, watch: PlcWatch) -> None:
        try:
            if watch.misses:
                await plc.look()
            elif self._wants(plc, self._depth):
                await plc.push()
            else:
                await plc.refresh()
            watch.misses = 0
            for _ in range(PUSHES_A_POLL - 1):
                if not self._wants(plc, self._depth - 1):
                    break
                await plc.push()
        except OutcomeUnknown:
            watch.misses += 1
            if watch.misses >= MISSES:
                raise DeviceSilent(
                    plc.where, f"{watch.misses} replies lost in a row", limit=self._bus.timeout_s
                ) from None
            return
        except DeviceRefused as refusal:
            # Busy: what was written may have been taken or not, so the next cycle only looks. Once.
            watch.misses += 1
            if refusal.value != BUSY or watch.misses >= MISSES:
                raise
            return
        head = plc.status.head
        complaint = watch.complaint(plc.heartbeat, head["hb_echo"], head["hb_plc"], asyncio.get_running_loop().time())
        if complaint:
            raise LinkLost(plc.where, complaint)

    @staticmethod
    def _wants(plc: PositionerPlc, depth: int) -> bool:
        """True when the queue is shorter than `depth` and the PLC takes segments."""
        return plc.waiting > 0 and plc.depth < depth and plc.state in _MOVING and not plc.fault

    @property
    def braked(self) -> bool:
        """True when every driven axis reports its brake closed, as last read."""
        bit = self._map.flags["axis_braked"]
        bits = np.array([axis[3] for plc in self._plcs for axis in plc.status.axes])
        return bool(((bits & bit) != 0)[self._driven].all())

    def go_silent(self) -> None:
        """Drop all connections: every PLC misses its heartbeat, ramps down and brakes."""
        for plc in self._plcs:
            plc.unit.close()

    async def close(self) -> None:
        """Disable all axes (ramp, brakes, power) and disconnect.

        Raises EnableFailed naming a positioner that did not confirm, when all the others are closed.
        """
        async with self._alone:
            await self._all(plc.close() for plc in self._plcs)

    @staticmethod
    async def _all(tasks: Iterable[Awaitable[T]]) -> list[T]:
        """Run all to their end together, then raise the first error."""
        results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return cast(list[T], results)

    # read-back -----------------------------------------------------------------------------------------------------
    def _position_mm(self) -> Array:
        per_mm = self._map.scale["position_per_mm"]
        return np.array([axis[0] for plc in self._plcs for axis in plc.status.axes]) / per_mm

    def _feedback(self) -> Feedback:
        words = np.array([axis for plc in self._plcs for axis in plc.status.axes], dtype=np.float64).T
        raw = words[:3] * self._units
        raw[2, words[2] == self._map.scale["no_force"]] = np.nan
        times = [plc.path_time_s() for plc in self._plcs]
        heard = [k for k, watch in enumerate(self._watches) if not watch.age]
        fault = self._fault()
        at_limit = (words[3].astype(np.int64) & self._map.flags["axis_limit"]) != 0
        return Feedback(
            t_s=asyncio.get_running_loop().time(),
            position_mm=raw[0],
            following_error_mm=raw[1],
            force_n=raw[2],
            states=self._states(),
            age_cycles=np.repeat([float(watch.age) for watch in self._watches], 3),
            path_time_s=min(times[k] for k in heard or range(len(times))),
            fault=fault,
            at_limit=at_limit if at_limit.any() else None,
            fault_kind=self._map.kind(fault[1]) if fault is not None else FaultKind.DRIVE_FAULT,
            path_times_s=np.repeat(times, 3),
            path_skew_s=self._skew_s(heard),
        )

    def _skew_s(self, heard: list[int]) -> float:
        """By how much the path times of those that were heard in this cycle are apart for certain."""
        for k in heard:
            self._clocks[k].see(self._plcs[k].shown(), self._rate)
        now_s = asyncio.get_running_loop().time()
        return apart_s((self._clocks[k] for k in heard), now_s, self._rate)

    def _states(self) -> tuple[AxisState, ...]:
        """State of each axis; a passive axis follows the component and counts as disabled."""
        shown = [_shown(plc) for plc in self._plcs]
        if shown != self._shown:
            self._shown = shown
            self._axis_states = tuple(
                state if axis.driven else AxisState.DISABLED
                for plc, state in zip(self._plcs, shown, strict=True)
                for axis in plc.config.axes
            )
        return self._axis_states

    def _fault(self) -> tuple[str, int, str] | None:
        """The fault that came first; one that something else caused only when nobody has the cause, nor the host."""
        plc = self._ill() or next((plc for plc in self._plcs if plc.fault), None)
        if plc is None or (plc.comes_after and self._told_quick_stop):
            return None
        bit = self._map.flags["axis_fault"]
        axes = plc.config.axes
        index = next((i for i, axis in enumerate(plc.status.axes) if axis[3] & bit), None)
        if index is None:
            index = next((i for i, axis in enumerate(axes) if axis.driven), 0)
        return f"{plc.config.name}.{axes[index].name}", plc.fault, plc.fault_words()
