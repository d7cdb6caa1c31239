"""CanopenPositioners: axes on a CAN bus that take one set-point each cycle and apply all at one SYNC."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import numpy as np

from docking.config.cell import CellFile
from docking.errors import (
    AxisUnreferenced,
    ConfigInvalid,
    DeviceSilent,
    EnableFailed,
    HomingRefused,
    LinkLost,
    ReadBackMismatch,
)
from docking.ports import CanFrame, CanLink
from docking.types import Array, Feedback, Identity, readonly
from drivers.canopen import cia402, codec
from drivers.canopen.bring_up import NodeBringUp, quantities
from drivers.canopen.cia402 import DriveState
from drivers.canopen.company import Company
from drivers.canopen.cyclic import CyclicImage
from drivers.canopen.homing import HomingGroup, HomingRules
from drivers.canopen.keeper import Keeper
from drivers.canopen.nodes import axis_nodes, can_bus_of
from drivers.canopen.power import PowerGroup
from drivers.canopen.ramps import QuickStopRamps
from drivers.canopen.router import Router
from drivers.canopen.watch import NodeWatch
from drivers.canopen.watchdogs import WatchdogProof
from drivers.maps.objects import load_object_map

_START_UP_S = 1.0
_EDGE_CYCLES = 3
"""SYNCs for a drive to see an edge in its controlword."""
NOT_HOMED = "The drive does not know its zero: home it, free of any component."


class CanopenPositioners:
    """The `StreamedPositioners` port over CiA 402 drives. `unhomed` are the axes whose zero is not to be trusted.

    Someone must send SYNC every `cycle_s` from bring-up to closing. Until the first `send` after enabling, and while
    enabling or closing, this class does so itself; then the caller's tick does, and its end is the end of SYNC and of
    the heartbeat that the drives watch.
    """

    def __init__(self, cell: CellFile, link: CanLink) -> None:
        self._bus, self._limits, self._link = can_bus_of(cell), cell.limits, link
        self._wire = ", ".join(self._bus.channels)
        self._homing = cell.homing
        self.unhomed: set[str] = set()
        self._map = load_object_map(self._bus.map)
        self._nodes = axis_nodes(cell, self._map.host_node)
        self.axes: tuple[str, ...] = cell.axis_names
        self.cycle_s: float = self._bus.cycle_s
        self.a_quick_mm_s2: Array = readonly([node.axis.a_quick_mm_s2 for node in self._nodes])
        self._image = CyclicImage(self._nodes, self._map, self._bus.counts_per_mm, self._bus.cycle_s)
        self._watch = NodeWatch(self._nodes, self._map, self._bus.heartbeat_s)
        self._power = PowerGroup(self._image, self._step, self._cause_of)
        self._setups = tuple(NodeBringUp(node, self._bus, self._map, link.send) for node in self._nodes)
        ramp = self._map.objects["quick_stop_deceleration"]
        self._ramps = QuickStopRamps(self._setups, ramp, self.a_quick_mm_s2, self._bus.counts_per_mm)
        self._heartbeat = codec.heartbeat(self._map.host_node)
        self._loop: asyncio.AbstractEventLoop
        self._router = Router(self._setups, self._image, self._watch)
        self._sync_s = self._beat_s = self._beat_due_s = 0.0
        self._keeper = Keeper(self.cycle_s, self._cycle, self._sent_s, lambda: self._lost is not None)
        self._lost: str | None = None
        self._open = self._live = self._first = self._sequencing = self._stopping = self._silent = False

    # the port ----------------------------------------------------------------------------------------------------
    async def bring_up(self) -> tuple[Identity, ...]:
        """Prove identity and settings of every node; leave the axes disabled and reporting.

        Raises PortMissing; LinkLost where another controller is heard; as `NodeBringUp.run`, naming the axis.
        """
        self._loop = asyncio.get_running_loop()
        self._link.on_frames, self._link.on_lost = self._on_frames, self._on_lost
        await self._link.open()
        self._open = True
        await Company(self._nodes, self._map.host_node).require_none(self._link, self._bus.heartbeat_s, self._wire)
        self._send([codec.nmt(codec.NMT_PRE_OPERATIONAL, node.node) for node in self._nodes])
        identities = await self._together([self._prepare(setup) for setup in self._setups])
        self._send([codec.nmt(codec.NMT_START, node.node) for node in self._nodes])
        self._keeper.begin()
        await self._all_reporting()
        self._refuse_powered_passive()
        await self._settle_power()
        if self._bus.prove_watchdog:
            await self.prove_watchdogs()
        self._watch.rearm()
        return identities

    async def prove_watchdogs(self) -> dict[str, float]:
        """Withhold the heartbeat until every drive says that it misses it; SYNC goes on. Seconds that each took.

        After bring-up, axes disabled and braked. Drives that keep this as a fault stay disabled until somebody resets
        them. Raises WatchdogUnproved naming the axis, also where one is enabled or not braked; LinkLost.
        """
        self._require_link()
        bus = self._bus
        proof = WatchdogProof(self._image, self._watch, self._map.host_lost, bus.drive_timeout_s, bus.cycle_s)
        self._watch.rearm()
        proof.require_still()
        try:
            self._keeper.begin()
            self._beat_due_s = math.inf
            took = await proof.run(self._step, lambda: self._beat_s)
        finally:
            self._beat_due_s = 0.0
        await self._all_reporting()
        self._watch.rearm()
        return took

    async def enable(self) -> Feedback:
        """Enable the driven axes as one group, each first commanded to where it stands; return their read-back.

        Raises EnableFailed naming the axis; then all axes are disabled again. Never resets a fault.
        """
        if not self._open:
            raise EnableFailed(self._wire, "the bus has not been brought up", value="bus closed")
        if self._silent:
            raise EnableFailed(self._wire, "the hardware chain was opened: start again", value="silent")
        if self.unhomed:
            raise AxisUnreferenced(", ".join(n.name for n in self._nodes if n.name in self.unhomed), NOT_HOMED)
        self._live, self._stopping, self._sequencing = False, False, True
        self._watch.rearm()
        try:
            self._keeper.begin()
            await self._all_reporting()
            await self._power.enable(self._limits.following_error_rest_mm, self._limits.reaction_min_fraction)
            self._live = self._first = True
        except LinkLost as error:
            raise EnableFailed(error.where, error.cause, value="link lost") from error
        finally:
            self._sequencing = False
        return self._image.feedback(self._sync_s, self._watch)

    async def home(self, axes: Sequence[str], asked_to_stop: Callable[[], str | None] = lambda: None) -> None:
        """Home these driven axes together; free of any component, disabled. After bring-up, before enabling.

        `asked_to_stop` is looked at in every cycle: a reason halts the group. Raises HomingRefused before anything
        moves; HomingFailed naming an axis after all stand, none of them homed then; as bring-up where a drive cannot be
        prepared; LinkLost.
        """
        self._require_link()
        if self._homing is None:
            raise ConfigInvalid(self._wire, ("homing: missing in the cell file",))
        if self._sequencing or self._live:
            cause = "Its axes are being enabled, moved or homed."
            raise HomingRefused(self._wire, cause, value="busy", limit="at rest")
        setups = [setup for setup in self._setups if setup.node.name in axes and setup.node.driven]
        watched = self._step, self._trouble, asked_to_stop, lambda: self.latest().force_n
        rules = HomingRules(self._homing, self._map, self._bus.counts_per_mm, *watched)
        group, done = HomingGroup(self._image, setups, rules), False
        self._keeper.begin()
        self._watch.rearm()
        self._sequencing = True
        try:
            await group.run()
            done = True
        finally:
            self._sequencing = False
            if group.begun:
                (self.unhomed.difference_update if done else self.unhomed.update)(s.node.name for s in setups)

    def latest(self) -> Feedback:
        """The newest read-back."""
        return self._image.feedback(self._sync_s, self._watch)

    def send(self, setpoint_mm: Array) -> None:
        """Send one set-point (m,) per axis and the common SYNC. Passive entries are ignored.

        Raises LinkLost, AxisLimitExceeded, and ReadBackMismatch when the first set-point after enabling is not where
        the axes stand; nothing is sent then.
        """
        self._require_link()
        if not self._sequencing:
            self._keeper.end()
        if self._live:
            self._image.aim_mm(setpoint_mm)
            if self._first:
                self._check_first()
        self._cycle()

    async def arm_stops(self, peak_mm_s: Array, t_stop_s: float) -> None:
        """Set the drives' own quick-stop ramps for a move with peak speeds (m,); call at standstill.

        Raises AxisLimitExceeded, ReadBackMismatch, DeviceSilent, DeviceRefused, LinkLost: each names the axis.
        """
        self._require_link()
        await self._ramps.arm(peak_mm_s, t_stop_s)

    async def restore_stops(self) -> None:
        """Write the full quick-stop decelerations back. Raises as `arm_stops`."""
        self._require_link()
        await self._ramps.restore()

    def quick_stop(self) -> None:
        """Tell every drive to stop by itself at once; it stays so until `enable`. Never waits, never raises."""
        self._live, self._stopping = False, True
        self._image.command_all(cia402.QUICK_STOP)
        if self._open and not self._silent and self._lost is None:
            self._cycle()

    async def brake(self) -> None:
        """At standstill: close all brakes, then take the torque where they report closed; `send` goes on meanwhile.

        Raises EnableFailed naming an axis whose brake does not report closed; that axis keeps its torque.
        """
        self._live = self._stopping = False
        await self._power.disable()

    def go_silent(self) -> None:
        """Send nothing any more, neither SYNC nor heartbeat, not even on closing. Never waits, never raises."""
        self._live, self._silent = False, True
        self._keeper.end()

    async def reset_faults(self) -> None:
        """Reset drives that are in fault and forget what the nodes reported; `send` goes on meanwhile.

        On a person's order only. The axes stay as they are, those in fault disabled. Raises EnableFailed, LinkLost.
        """
        faulted = [i for i in self._image.powered if self._image.state(i) is DriveState.FAULT]
        self._live = self._stopping = False
        for word in (cia402.DISABLE_VOLTAGE, cia402.FAULT_RESET, cia402.DISABLE_VOLTAGE) if faulted else ():
            for index in faulted:
                self._image.command(index, word)
            for _ in range(_EDGE_CYCLES):
                await self._step()
        for index in faulted:
            if self._image.state(index) is DriveState.FAULT:
                raise EnableFailed(self._nodes[index].name, self._cause_of(index), value=DriveState.FAULT.value)
        self._watch.rearm()

    async def close(self) -> None:
        """Disable the axes, brakes confirmed first, restore their quick-stop ramps, then release the bus.

        Raises EnableFailed where a brake is not reported closed; that axis keeps its torque, and its drive stops and
        holds by itself when it misses the heartbeat. Raises as `restore_stops` where a ramp could not be restored.
        """
        if not self._open:
            return
        try:
            if self._lost is None and not self._silent and self._image.cycles:
                self._keeper.begin()
                await self._settle_power()
                await self._ramps.restore()
                self._watch.disarm()
                self._send([codec.nmt(codec.NMT_PRE_OPERATIONAL, node.node) for node in self._nodes])
        except LinkLost:
            self._live = False
        finally:
            self._keeper.end()
            self._open = False
            self._link.close()

    # bring-up ----------------------------------------------------------------------------------------------------
    async def _prepare(self, setup: NodeBringUp) -> Identity:
        identity = await setup.run(quantities(setup.node, self._bus, self._limits, self._map))
        statusword, position = await setup.standing()
        self._image.seed(setup.node.index, statusword, position)
        self._image.choose(setup.node.index, setup.position_mode)
        if self._homing is not None and setup.node.driven and not await setup.is_homed():
            self.unhomed.add(setup.node.name)
        return identity

    async def _together(self, jobs: Sequence[Coroutine[Any, Any, Identity]]) -> tuple[Identity, ...]:
        """Run the nodes' jobs side by side; raise the first error in axis order after all have ended."""
        results = await asyncio.gather(*jobs, return_exceptions=True)
        errors = [result for result in results if isinstance(result, BaseException)]
        if self._lost is not None:
            raise LinkLost(self._wire, self._lost)
        if errors:
            raise errors[0]
        return tuple(result for result in results if isinstance(result, Identity))

    async def _all_reporting(self) -> None:
        """Wait until every node's read-back is fresh, its heartbeat alive, its force known. Raises DeviceSilent."""
        deadline = self._loop.time() + _START_UP_S + 3.0 * self._bus.heartbeat_s
        first = self._image.cycles + 2
        while True:
            await self._step()
            mute = self._watch.missing_heartbeat(self._loop.time())
            late = [(node, "no read-back") for node in self._nodes if not (self._image.age_cycles(node.index) <= 1)]
            late += [] if mute is None else [(mute, "no heartbeat")]
            late += [(node, "no force") for node in self._nodes if self._image.lacks_force(node.index)]
            if not late and self._image.cycles > first:
                return
            if late and not (self._loop.time() < deadline):
                node, what = late[0]
                raise DeviceSilent(node.name, f"{what} from node {node.node}", limit=_START_UP_S)

    def _refuse_powered_passive(self) -> None:
        for node in self._nodes:
            state = self._image.state(node.index)
            if not node.powered and cia402.AXIS_STATES[state].value in ("enabled", "stopping"):
                off = DriveState.SWITCH_ON_DISABLED.value
                raise ReadBackMismatch(node.name, "a passive axis must be free", value=state.value, limit=off)

    async def _settle_power(self) -> None:
        self._live, self._stopping, self._sequencing = False, False, True
        try:
            await self._power.disable()
        finally:
            self._sequencing = False

    # the cycle ---------------------------------------------------------------------------------------------------
    def _cycle(self) -> None:
        """Send this cycle's frames and, when due, the heartbeat; look after the nodes' heartbeats at the same rate."""
        if not self._live:
            self._image.aim_at_read_back()
        now_s = self._loop.time()
        frames = self._image.frames()
        # By time, not by cycles: ticks that come late must not stretch what the drives' watchdogs live on.
        if self._image.cycles == 0 or now_s >= self._beat_due_s:
            self._beat_s, self._beat_due_s = now_s, now_s + self._bus.heartbeat_s - 0.5 * self.cycle_s
            frames = [*frames, self._heartbeat]
            self._watch.check(now_s)
        self._image.cycles += 1
        self._sync_s = now_s
        self._link.send(frames)

    def _check_first(self) -> None:
        limit_mm = self._limits.following_error_rest_mm
        distance = np.abs(self._image.first_step_mm())
        if not (distance.max() <= limit_mm):
            row = int(np.argmax(~(distance <= limit_mm)))
            self._live = False
            raise ReadBackMismatch(
                self._nodes[int(self._image.driven[row])].name,
                "the first set-point after enabling is not where the axis stands",
                value=float(distance[row]),
                limit=limit_mm,
            )
        self._first = False

    def _sent_s(self) -> float:
        return self._sync_s if self._image.cycles else math.nan

    async def _step(self) -> None:
        """Let one cycle pass. Raises LinkLost, or EnableFailed when a quick stop came in between."""
        await asyncio.sleep(self.cycle_s)
        if self._lost is not None:
            raise LinkLost(self._wire, self._lost)
        if self._stopping:
            raise EnableFailed(self.axes[0], "a quick stop was commanded meanwhile", value="quick stop")

    def _require_link(self) -> None:
        if self._lost is not None or self._silent or not self._open:
            raise LinkLost(self._wire, self._lost or ("gone silent" if self._silent else "the bus is not open"))

    def _send(self, frames: list[CanFrame]) -> None:
        self._link.send(frames)
        if self._lost is not None:
            raise LinkLost(self._wire, self._lost)

    def _trouble(self, indices: Sequence[int]) -> tuple[str, str] | None:
        """The first node that is not well, and why: any that complains, one of `indices` that is not heard."""
        if self._watch.worst is not None:
            name, code, text = self._watch.worst
            return name, f"{text} ({code:04X}h)."
        for index in indices:
            if self._image.state(index) in (DriveState.FAULT, DriveState.FAULT_REACTION):
                return self._nodes[index].name, self._cause_of(index)
            if not (self._image.age_cycles(index) <= self._limits.missing_cycles):
                return self._nodes[index].name, "Its read-backs are missing."
        return None

    def _cause_of(self, index: int) -> str:
        _, code, text = self._watch.fault_of(index)
        return f"{text} ({code:04X}h)"

    # frames from the bus -----------------------------------------------------------------------------------------
    def _on_frames(self, batch: list[CanFrame]) -> None:
        rest = self._image.take_batch(batch)
        if rest:
            self._router.take(rest, self._loop.time())

    def _on_lost(self, reason: str) -> None:
        if self._lost is None:
            self._stop_what_is_left()
            self._lost = reason

    def _stop_what_is_left(self) -> None:
        """One of several buses is gone: axes on the others carry the same part and must not go on without its axes."""
        if not self._bus.further_channels:
            return
        enabled = [i for i in self._image.powered if self._image.state(i) is DriveState.OPERATION_ENABLED]
        for index in enabled:
            self._image.command(index, cia402.QUICK_STOP)
        if enabled and self._open and not self._silent:
            self._link.send(self._image.frames())
