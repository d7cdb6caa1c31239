"""A tracker behind a gateway that speaks the line protocol (docs/line-protocol.md): implements `docking.ports.Tracker`.

One request is outstanding at a time. A reply counts only when its checksum holds, its sequence number is that of the
request, its target is the one asked for and its device time is later than any before; everything else is dropped and
counted. While it measures the device sends heartbeats, so silence is noticed within SILENCE_S, not at the deadline.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from docking.config.cell import TrackerConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, TargetLost, WrongIdentity
from docking.ports import SerialLink
from docking.types import Array, Identity, Reading
from drivers.garbage import GarbageWatch
from drivers.line_codec import (
    CHANGED,
    DEGRADED,
    FACE_2,
    OCCLUDED,
    SEQ_MODULUS,
    VALID,
    AckLine,
    HeartbeatLine,
    IdentityLine,
    LineParser,
    PointLine,
    RefusalLine,
    Reply,
    encode,
)
from drivers.readings import Covariance, FrozenWatch, reading_covariance

PROTOCOL_VERSION = 1
COMMAND_TIMEOUT_S = 1.0
SILENCE_S = 1.0
UM_PER_MM = 1000.0

NO_TARGET, BEAM_BROKEN = 10, 11
_TARGET_CODES = frozenset({NO_TARGET, BEAM_BROKEN})

ReplyT = TypeVar("ReplyT", AckLine, IdentityLine)


@dataclass
class LineCounts:
    """What the driver has thrown away since it was made."""

    stale: int = 0
    wrong_target: int = 0
    old_time: int = 0


@dataclass(frozen=True)
class _Request:
    """The one request that waits for its reply."""

    seq: int
    target: str
    reply: asyncio.Future[Reply]


class LineTracker:
    """`docking.ports.Tracker` over the line protocol.

    `covariance` is the noise model of the device class (see `drivers.readings`). The gateway aims by name, so the
    expected position is not sent. Error `where` is the target's name for what concerns a target, else "tracker".
    """

    def __init__(self, link: SerialLink, config: TrackerConfig, covariance: Covariance) -> None:
        self.two_face = config.two_face
        self.counts = LineCounts()
        self._link, self._covariance = link, covariance
        self._measure_timeout_s = config.measure_timeout_s
        self._parser = LineParser()
        self._frozen = FrozenWatch()
        self._turn = asyncio.Lock()
        self._request: _Request | None = None
        self._garbage = GarbageWatch()
        self._seq = 0
        self._newest_t_us = -1
        self._heard_at_s = 0.0
        self._lost: str | None = "not connected"

    @property
    def bad_lines(self) -> int:
        """Lines dropped for framing, checksum or grammar."""
        return self._parser.bad

    @property
    def noise_bytes(self) -> int:
        """Bytes received outside any line."""
        return self._parser.noise

    async def connect(self) -> Identity:
        """Open the line, end whatever an earlier session left running, ask the device who it is.

        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply, or WrongIdentity for another protocol version.
        """
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_lost
        await self._link.open()
        self._lost = None
        self._parser.reset()
        self._garbage.reset()
        self._newest_t_us = -1
        # Replies of an earlier session must not fit: the numbering starts where the clock happens to stand.
        self._seq = int(asyncio.get_running_loop().time() * 1000.0) % SEQ_MODULUS
        try:
            await self._command("STP", AckLine)
            who = await self._command("VER", IdentityLine)
            if who.protocol != PROTOCOL_VERSION:
                raise WrongIdentity(
                    "tracker",
                    "the device speaks another version of the line protocol",
                    value=who.protocol,
                    limit=PROTOCOL_VERSION,
                )
        except BaseException:
            await self.close()
            raise
        return Identity("tracker", who.vendor, who.product, who.serial, who.firmware)

    async def measure(self, target: str, near_T_mm: Array, face: int = 1) -> Reading:
        """Measure `target` once; see `docking.ports.Tracker.measure`. `near_T_mm` is not used.

        Raises TargetLost (no reflector, beam broken, invalid or all-zero coordinates), DeviceSilent, DeviceRefused,
        BadReply (garbage on the line, frozen sensor, wrong face) or LinkLost.
        """
        if face not in ((1, 2) if self.two_face else (1,)):
            raise DeviceRefused("tracker", "this instrument has one face", value=face)
        fields = (target, 1, face) if face == 2 else (target, 1)
        async with self._turn:
            reply = await self._exchange("MEA", fields, target, self._measure_timeout_s)
        if not isinstance(reply, PointLine):
            raise BadReply("tracker", f"{target}: another kind of reply to a measurement", value=type(reply).__name__)
        return self._reading(reply, face)

    async def close(self) -> None:
        """Release the line."""
        self._link.close()
        self._on_lost("closed")

    async def _command(self, kind: str, want: type[ReplyT]) -> ReplyT:
        """Send a command without fields and return its reply of type `want`."""
        async with self._turn:
            reply = await self._exchange(kind, (), "", COMMAND_TIMEOUT_S)
        if not isinstance(reply, want):
            raise BadReply("tracker", f"another kind of reply to {kind}", value=type(reply).__name__)
        return reply

    async def _exchange(self, kind: str, fields: tuple[str | int, ...], target: str, timeout_s: float) -> Reply:
        if self._lost is not None:
            raise LinkLost("tracker", self._lost)
        loop = asyncio.get_running_loop()
        self._seq = (self._seq + 1) % SEQ_MODULUS
        self._request = _Request(self._seq, target, loop.create_future())
        self._heard_at_s = loop.time()
        try:
            self._link.write(encode(kind, self._seq, *fields))
            reply = await self._wait(self._request.reply, timeout_s)
        finally:
            self._request = None
        if isinstance(reply, RefusalLine):
            if reply.code in _TARGET_CODES:
                raise TargetLost(target, reply.words)
            raise DeviceRefused("tracker", f"{kind} {target}: {reply.words}", value=reply.code)
        return reply

    async def _wait(self, reply: asyncio.Future[Reply], timeout_s: float) -> Reply:
        """The reply, or DeviceSilent after `timeout_s` or SILENCE_S after the last intact line."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + timeout_s
        while not reply.done():
            limit_s = min(deadline_s, self._heard_at_s + SILENCE_S)
            if loop.time() >= limit_s:
                what, limit = ("reply", timeout_s) if limit_s == deadline_s else ("intact line", SILENCE_S)
                raise DeviceSilent("tracker", f"no {what}; {self._heard()}", limit=limit)
            await asyncio.wait({reply}, timeout=limit_s - loop.time())
        return reply.result()

    def _heard(self) -> str:
        """What came instead of a reply, so far."""
        counts = self.counts
        return (
            f"so far {self.bad_lines} bad lines, {self.noise_bytes} bytes of noise, {counts.stale} replies under "
            f"another number, {counts.wrong_target} for another target, {counts.old_time} with an old time"
        )

    def _on_bytes(self, data: bytes) -> None:
        bad_before = self._parser.bad
        for reply in self._parser.feed(data):
            self._take(reply)
        distrust = self._garbage.count(self._parser.bad - bad_before, asyncio.get_running_loop().time())
        if distrust:
            self._fail(BadReply("tracker", "garbage on the line", value=distrust))

    def _take(self, reply: Reply) -> None:
        self._heard_at_s = asyncio.get_running_loop().time()
        if isinstance(reply, HeartbeatLine):
            return
        request = self._request
        if request is None or request.reply.done() or reply.seq != request.seq:
            self.counts.stale += 1
        elif isinstance(reply, PointLine) and reply.target != request.target:
            self.counts.wrong_target += 1
        elif isinstance(reply, PointLine) and reply.t_us <= self._newest_t_us:
            self.counts.old_time += 1
        else:
            if isinstance(reply, PointLine):
                self._newest_t_us = reply.t_us
            request.reply.set_result(reply)

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        self._fail(LinkLost("tracker", reason))

    def _fail(self, error: LinkError) -> None:
        if self._request is not None and not self._request.reply.done():
            self._request.reply.set_exception(error)

    def _reading(self, point: PointLine, face: int) -> Reading:
        """The noun, or TargetLost / BadReply when the line holds no usable point."""
        if not point.flags & VALID:
            cause = "the beam is blocked" if point.flags & OCCLUDED else "the instrument marks the reading invalid"
            raise TargetLost(point.target, cause)
        if point.flags & (OCCLUDED | CHANGED):
            raise TargetLost(point.target, "the beam was broken or the reflector changed during the measurement")
        if point.xyz_um == (0, 0, 0):
            raise TargetLost(point.target, "coordinates exactly zero: no distance was measured")
        if (2 if point.flags & FACE_2 else 1) != face:
            raise BadReply("tracker", f"{point.target}: measured in the other face", value=point.flags)
        self._frozen.check(point.target, tuple(map(float, point.xyz_um)))
        p_T_mm = np.array(point.xyz_um, dtype=np.float64) / UM_PER_MM
        degraded = bool(point.flags & DEGRADED)
        cov_mm2 = reading_covariance(
            self._covariance(p_T_mm), np.array(point.sigma_um) / UM_PER_MM, 1.0 / UM_PER_MM, degraded
        )
        return Reading(point.target, p_T_mm, cov_mm2, asyncio.get_running_loop().time(), face, degraded)
