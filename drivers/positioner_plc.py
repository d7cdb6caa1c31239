"""One positioner PLC over Modbus: identity, settings, commands, segments and read-back.

A command is sent once. When its reply does not come, the acknowledged number is read back before anything else.
A segment is sent again only after a read-back has shown that the PLC does not have it.
"""

from __future__ import annotations

import asyncio
import contextlib
from binascii import crc_hqx
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from docking.config.cell import ModbusBus, PositionerConfig
from docking.errors import (
    BadReply,
    DeviceRefused,
    DockingError,
    EnableFailed,
    LinkLost,
    OutcomeUnknown,
    PortMissing,
    ReadBackMismatch,
    SegmentRejected,
    WrongIdentity,
)
from docking.types import Identity
from drivers.modbus_requests import RegisterUnit
from drivers.path_clocks import Shown
from drivers.register_map import RegisterMap

ACKNOWLEDGE_S = 0.15
ACKNOWLEDGE_SCANS = 3
"""A command that has arrived is acknowledged after the next scan: after so many it has not. The heartbeats of the other
PLCs wait meanwhile."""
HOST_POLLS = 2.5  # to see that a host is alive
ENABLE_S, LOOK_AGAIN_S = 3.0, 0.005
RECONNECT_S, RECONNECT_FIRST_S, RECONNECT_MOST_S = 3.0, 0.05, 0.5
"""How long a broken connection is tried again, and the first and the longest wait between two tries."""
REPEATABLE = frozenset(("hold", "stop", "quick-stop", "disable"))
"""Commands that only slow down: sent once more, under the same number, when the read-back shows they did not arrive."""


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE (polynomial 1021h, start FFFFh)."""
    return crc_hqx(data, 0xFFFF)


def following(number: int) -> int:
    """The number after `number` in 1..65535, 1 again."""
    return number % 0xFFFF + 1


@dataclass(frozen=True)
class Status:
    """One read-back: `head` by the names of the map, `axes` one (position, following error, force, bits) each."""

    head: dict[str, int]
    axes: list[tuple[int, ...]]


@dataclass(frozen=True)
class Segments:
    """The knots of a plan for one positioner: `rows` (n) of raw positions, `dt_ms` apart."""

    plan_id: int
    dt_ms: int
    rows: tuple[tuple[int, ...], ...]


class PositionerPlc:
    """The PLC of one positioner behind `unit`."""

    def __init__(self, config: PositionerConfig, bus: ModbusBus, layout: RegisterMap, unit: RegisterUnit) -> None:
        self.config, self._bus, self._map, self.unit = config, bus, layout, unit
        self.where = unit.where
        self.mask = sum(1 << i for i, axis in enumerate(config.axes) if axis.driven)
        self._blocks = layout.blocks
        self._station = crc16(config.name.encode("ascii"))
        self._heartbeat = 0
        self._segments: Segments | None = None
        self._wanted = 0
        self.pushed = 0
        self.capacity = 0
        self.depth = 0
        self.status = Status({}, [])
        self._asked_s = self._heard_s = float("nan")
        self._armed = False

    # identity and settings -----------------------------------------------------------------------------------------
    async def bring_up(self, settings: Mapping[str, int]) -> Identity:
        """Connect; prove who answers, word order, scan, settings and strokes; leave the axes disabled.

        `settings` are the words of the settings block, by name and in its order.
        """
        await self.unit.connect()
        identity = await self._prove_identity()
        if not self._heartbeat:
            await self._require_no_host()
        await self.refresh()
        if self.state != "disabled" and self.state != "fault":
            await self.command("disable")
            await self.reach(ENABLE_S, "disabled")
        self._armed = False
        if self.state == "disabled":
            await self.arm(settings)
        await self._prove_strokes()
        return identity

    async def _require_no_host(self) -> None:
        """The first write would disable the axes of whoever keeps this PLC alive: then its echo counts. LinkLost."""
        before, _ = await self._read_block("status")
        await asyncio.sleep(HOST_POLLS * self._bus.poll_s)
        after, _ = await self._read_block("status")
        if after["hb_echo"] != before["hb_echo"]:
            raise LinkLost(self.where, "Another controller keeps it alive, nothing was written.")

    async def arm(self, settings: Mapping[str, int]) -> None:
        """Write and read back the settings, the watchdog among them, where this connection has not seen them yet.

        A controller may forget its watchdog with the connection. Raises ReadBackMismatch.
        """
        if not self._armed:
            await self._write_back("settings", settings)
            self._armed = True

    async def reconnect(self, settings: Mapping[str, int]) -> None:
        """Behind a broken connection: try again, at growing distances, and prove everything anew. PortMissing after
        RECONNECT_S."""
        if self.unit.connected:
            return
        loop = asyncio.get_running_loop()
        end_s, wait_s = loop.time() + RECONNECT_S, RECONNECT_FIRST_S
        while True:
            try:
                await self.bring_up(settings)
            except (PortMissing, LinkLost):
                if not loop.time() + wait_s < end_s:
                    raise
            else:
                return
            await asyncio.sleep(wait_s)
            wait_s = min(2.0 * wait_s, RECONNECT_MOST_S)

    async def _read_block(self, name: str) -> tuple[dict[str, Any], list[tuple[int, ...]]]:
        block = self._blocks[name]
        return block.unpack(await self.unit.read(block.address, block.count))

    async def _prove_identity(self) -> Identity:
        head, _ = await self._read_block("identity")
        if head["magic"] != self._map.magic:
            raise BadReply(self.where, "The word order differs.", value=f"{head['magic']:#x} for {self._map.magic:#x}")
        for key, wanted in (("station", self.config.name), ("map_version", self._map.version), ("n_axes", 3)):
            if head[key] != wanted:
                raise WrongIdentity(self.where, f"Compared: {key}.", value=head[key], limit=wanted)
        if head["scan_ms"] != round(self._bus.scan_s * 1000.0):
            raise ReadBackMismatch(f"{self.where}, scan_ms", value=head["scan_ms"], limit=self._bus.scan_s * 1000.0)
        self.capacity = head["capacity"]
        return Identity(self.where, head["vendor"], head["product"], head["serial"], head["firmware"])

    async def _write_back(self, name: str, wanted: Mapping[str, int]) -> None:
        """Write the block `name` and see that it reads back as written.

        A write whose reply is lost needs no second one: the read-back shows whether it arrived, and a setting that
        did not arrive raises ReadBackMismatch before anything moves.
        """
        block = self._blocks[name]
        with contextlib.suppress(OutcomeUnknown):
            await self.unit.write(block.address, block.pack(*wanted.values()))
        head, _ = await self._read_block(name)
        for key, value in wanted.items():
            if head[key] != value:
                raise ReadBackMismatch(f"{self.where}, {key}", value=head[key], limit=value)

    async def set_motion(self, quick_ramp_s: float, rate: float) -> None:
        """At standstill: how long a quick stop takes from rate 1, and the playback rate (over 0, to 1)."""
        permille = max(1, round(rate * self._map.scale["full_rate"]))
        await self._write_back("motion", {"quick_ramp_ms": round(quick_ramp_s * 1000.0), "rate_permille": permille})

    async def _prove_strokes(self) -> None:
        _, axes = await self._read_block("limits")
        per_mm = self._map.scale["position_per_mm"]
        for axis, (low, high, _speed) in zip(self.config.axes, axes, strict=True):
            wanted = tuple(round(end * per_mm) for end in axis.stroke_mm)
            if (low, high) != wanted:
                found, limit = f"{low}..{high} um", f"{wanted[0]}..{wanted[1]} um"
                raise ReadBackMismatch(f"{self.where}, stroke of {axis.name}", value=found, limit=limit)

    # read-back -----------------------------------------------------------------------------------------------------
    @property
    def state(self) -> str:
        """State as named in the map."""
        return self._map.states.get(self.status.head.get("state", 0), "unknown")

    @property
    def heartbeat(self) -> int:
        """The last heartbeat written."""
        return self._heartbeat

    async def refresh(self) -> None:
        """Write the heartbeat alone and read the status back."""
        await self._beat_and_read(self._blocks["heartbeat"].address, b"")

    async def _beat_and_read(self, address: int, window: bytes) -> None:
        self._heartbeat = (self._heartbeat + 1) & 0xFFFF
        block = self._blocks["status"]
        loop = asyncio.get_running_loop()
        asked_s = loop.time()
        data = self._heartbeat.to_bytes(2, "big") + window
        head, axes = block.unpack(await self.unit.exchange(address, data, block.address, block.count))
        if head["station"] != self._station:
            raise WrongIdentity(self.where, "Compared: station number.", value=head["station"], limit=self._station)
        self.status = Status(head, axes)
        self._asked_s, self._heard_s = asked_s, loop.time()
        self.depth = self.capacity - head["fifo_free"]

    async def reach(self, within_s: float, *states: str) -> None:
        """Wait until the PLC reports one of `states`; EnableFailed when it does not."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + within_s
        while self.state not in states:
            if self.state == "fault":
                raise EnableFailed(self.where, self.fault_words(), value="fault")
            if not loop.time() < end_s:
                raise EnableFailed(self.where, f"It did not become {states[0]} within {within_s} s.", value=self.state)
            await asyncio.sleep(2.0 * LOOK_AGAIN_S)
            await self.refresh()

    @property
    def fault(self) -> int:
        """Fault code; 0 is none."""
        return self.status.head.get("fault", 0)

    @property
    def comes_after(self) -> bool:
        """True when it is in fault only because another positioner is, or the host told it to."""
        return self.fault in self._map.consequences

    def fault_words(self) -> str:
        return self._map.fault(self.fault)

    # commands ------------------------------------------------------------------------------------------------------
    async def command(self, verb: str) -> None:
        """Have `verb` carried out once.

        Raises DeviceRefused when the PLC refuses it, OutcomeUnknown when no acknowledgement can be read back.
        """
        block = self._blocks["command"]
        sequence = following(self.status.head["cmd_ack"])
        data = block.pack(sequence, self._map.commands[verb], self.mask)
        arrived = await self._sent(data, sequence)
        if not arrived and verb in REPEATABLE:
            arrived = await self._sent(data, sequence)
        if not arrived:
            raise OutcomeUnknown(self.where, "It does not acknowledge the command.", value=verb)
        result = self.status.head["cmd_result"]
        if result:
            raise DeviceRefused(self.where, f"{verb}: {self._map.reject(result)} ({self.state})", value=result)

    async def _sent(self, data: bytes, sequence: int) -> bool:
        """Write the command once and look for its acknowledgement, also when the write was not answered."""
        try:
            await self.unit.write(self._blocks["command"].address, data)
        except OutcomeUnknown:
            await self._seen()
        loop = asyncio.get_running_loop()
        end_s = loop.time() + ACKNOWLEDGE_S
        first_scan: int | None = None
        while True:
            if await self._seen():
                head = self.status.head
                if head["cmd_ack"] == sequence:
                    return True
                first_scan = head["hb_plc"] if first_scan is None else first_scan
                if (head["hb_plc"] - first_scan) & 0xFFFF >= ACKNOWLEDGE_SCANS:
                    return False
            if not loop.time() < end_s:
                return False
            await asyncio.sleep(LOOK_AGAIN_S)

    async def _seen(self) -> bool:
        """Try one read-back; a lost reply is no proof of anything."""
        try:
            await self.refresh()
        except OutcomeUnknown:
            return False
        return True

    # segments ------------------------------------------------------------------------------------------------------
    def take(self, segments: Segments) -> None:
        """Have these segments pushed from now on; the PLC's queue is empty."""
        self._segments, self._wanted, self.pushed = segments, len(segments.rows), 0

    def abandon(self) -> None:
        """Push no more of the plan."""
        self._wanted = self.pushed

    @property
    def waiting(self) -> int:
        """Segments still to be pushed."""
        return self._wanted - self.pushed

    async def push(self) -> None:
        """Send the next segment with the heartbeat and read back whether the PLC has it."""
        if self._segments is None or not self.waiting:
            return await self.refresh()
        sequence = self._number(self.pushed + 1)
        await self._beat_and_read(self._blocks["heartbeat"].address, self._window(self._segments, sequence))
        rejected = self.status.head["seg_result"]
        if self.fault:
            return None
        if rejected:
            where = f"{self.where}, segment {self.pushed + 1}"
            raise SegmentRejected(where, self._map.reject(rejected), value=rejected)
        return self._settle(self._segments)

    async def look(self) -> None:
        """Read back after an unanswered push, before anything is sent again."""
        await self.refresh()
        if self._segments is not None and self.waiting:
            self._settle(self._segments)

    def _settle(self, segments: Segments) -> None:
        """Advance `pushed` to what the PLC says it has: the segment before or the one just sent."""
        last = self.status.head["last_seq"]
        if self.waiting and last == self._number(self.pushed + 1):
            self.pushed += 1
        elif last != self._number(self.pushed):
            raise ReadBackMismatch(f"{self.where}, last segment", value=last, limit=self._number(self.pushed))
        if self.pushed and self.status.head["plan_id"] != segments.plan_id:
            raise ReadBackMismatch(f"{self.where}, plan", value=self.status.head["plan_id"], limit=segments.plan_id)

    @staticmethod
    def _number(index: int) -> int:
        """seg_seq of the segment `index` (1, 2, ...); 0 is an empty queue."""
        return (index - 1) % 0xFFFF + 1 if index else 0

    def _window(self, segments: Segments, sequence: int) -> bytes:
        row = segments.rows[self.pushed]
        flags = self._map.flags["last_segment"] if self.waiting == 1 else 0
        payload = b"".join(value.to_bytes(4, "big", signed=True) for value in row)
        pack = self._blocks["segment"].pack
        head = pack(segments.plan_id, sequence, segments.dt_ms, flags, len(row), 0)[:-2]
        return head + crc16(head + payload).to_bytes(2, "big") + payload

    def path_time_s(self) -> float:
        """Path time this PLC has played of the plan; NaN without a plan."""
        if self._segments is None or not self.pushed:
            return float("nan")
        head = self.status.head
        behind = (self._number(self.pushed) - head["play_seq"]) % 0xFFFF
        played = self.pushed - behind - 1 + head["fraction"] / self._map.scale["fraction"]
        return played * self._segments.dt_ms / 1000.0

    def shown(self) -> Shown:
        """What the newest read-back tells of path time."""
        state = self.state
        moving = state in ("running", "stopping")
        scans = self.status.head["hb_plc"]
        return Shown(self.path_time_s(), state == "running", moving, scans, self._asked_s, self._heard_s)

    async def close(self) -> None:
        """Disable, wait for closed brakes, disconnect; a broken connection is only closed.

        Raises EnableFailed when the PLC is still connected and does not confirm that its axes are off and braked.
        """
        try:
            if self.unit.connected and self.state not in ("disabled", "unknown"):
                await self._switch_off()
        except EnableFailed:
            raise
        except DockingError as error:
            # Behind a broken connection the PLC's own watchdog stops and brakes the axes.
            if self.unit.connected:
                cause = f"It did not confirm that its axes are disabled and braked. {error}"
                raise EnableFailed(self.where, cause, value=self.state) from error
        finally:
            self.unit.close()

    async def _switch_off(self) -> None:
        """Disable and see the brakes closed; a PLC in fault has done so by itself."""
        if self.state != "fault":
            try:
                await self.command("disable")
            except DeviceRefused:
                if self.state != "fault":
                    raise
        await self.reach(ENABLE_S + self._bus.ramp_s, "disabled", "fault")
        self._require_brakes()

    def _require_brakes(self) -> None:
        """Every driven axis reports its brake closed. Raises EnableFailed."""
        bit = self._map.flags["axis_braked"]
        for axis, status in zip(self.config.axes, self.status.axes, strict=True):
            if axis.driven and not status[3] & bit:
                name = f"{self.config.name}.{axis.name}"
                raise EnableFailed(name, "It is disabled, but its brake is not reported closed.", value=self.state)
