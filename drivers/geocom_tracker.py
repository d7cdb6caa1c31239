"""A Leica total or laser station over GeoCOM: implements `docking.ports.Tracker`.

A point is taken as: clear the old distance, turn to where the target is expected, let the target recognition find the
reflector, measure a distance, read angles and distance. Without a checksum on the line a flipped digit is a valid
number, so the result is read twice and both must agree within three sigma.
"""

from __future__ import annotations

import asyncio
import math

import numpy as np

from docking.config.cell import TrackerConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkLost, TargetLost
from docking.ports import SerialLink
from docking.types import Array, Identity, Reading
from drivers.geocom_codec import (
    AUS_SET_USER_ATR,
    AUT_FINE_ADJUST,
    AUT_MAKE_POSITIONING,
    BUSY_CODES,
    COM_NULL_PROC,
    COM_SET_DOUBLE_PRECISION,
    CSV_INSTRUMENT_NAME,
    CSV_INSTRUMENT_NO,
    DEGRADED_CODES,
    REFUSAL_WORDS,
    RPC_NAMES,
    TARGET_CODES,
    TMC_DO_MEASURE,
    TMC_GET_SIMPLE_MEA,
    TRID_MODULUS,
    GeocomParser,
    GeocomReply,
    encode_request,
    number,
    point_from_polar,
    polar_from_point,
    words,
)
from drivers.readings import Covariance, FrozenWatch, reading_covariance

STATUS_TIMEOUT_S = 1.0
TURN_TIMEOUT_S = 20.0
WAIT_MARGIN_S = 0.5
BUSY_PAUSE_S = 0.2
DRAIN_S = 0.05
AWAKE_ATTEMPTS = 3
DOUBLE_DIGITS = 12
SEARCH_RAD = 0.02
AGREE_SIGMAS = 3.0

DEFAULT_DISTANCE, CLEAR_DISTANCE = 1, 3
AUTOMATIC_INCLINATION = 1


class GeocomTracker:
    """`docking.ports.Tracker` over GeoCOM; two faces. `covariance` is the noise model of the device class.

    `checksum` uses the CRC form of the lines, where the instrument has it. Station frame: x east, y north, z up, Hz
    clockwise from north. Error `where` is the target's name for what concerns a target, else "tracker".
    """

    def __init__(
        self, link: SerialLink, config: TrackerConfig, covariance: Covariance, *, checksum: bool = False
    ) -> None:
        self.two_face = config.two_face
        self.stale_replies = 0
        self._link, self._covariance, self._checksum = link, covariance, checksum
        self._measure_timeout_s = config.measure_timeout_s
        self._parser = GeocomParser(checksum)
        self._frozen = FrozenWatch()
        self._turn = asyncio.Lock()
        self._trid = 0
        self._reply: asyncio.Future[GeocomReply] | None = None
        self._deadline_s = math.inf
        self._lost: str | None = "not connected"

    @property
    def bad_lines(self) -> int:
        """Lines dropped for framing, checksum or grammar."""
        return self._parser.bad

    async def connect(self) -> Identity:
        """Open the line, wake the instrument, ask who it is, set precision and target recognition.

        Raises PortMissing, DeviceSilent, DeviceRefused or BadReply.
        """
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_lost
        await self._link.open()
        self._lost = None
        self._deadline_s = math.inf
        # Replies of an earlier session must not fit: the numbering starts where the clock happens to stand.
        self._trid = int(asyncio.get_running_loop().time() * 1000.0) % TRID_MODULUS
        try:
            async with self._turn:
                await self._wake()
                serial = await self._ask(CSV_INSTRUMENT_NO)
                name = await self._ask(CSV_INSTRUMENT_NAME)
                await self._ask(COM_SET_DOUBLE_PRECISION, DOUBLE_DIGITS)
                await self._ask(AUS_SET_USER_ATR, 1)
                identity = Identity("tracker", "Leica", words(_only(name)), words(_only(serial)), "")
        except BaseException:
            await self.close()
            raise
        return identity

    async def measure(self, target: str, near_T_mm: Array, face: int = 1) -> Reading:
        """Measure `target`, found near `near_T_mm` (3,); see `docking.ports.Tracker.measure`.

        Raises TargetLost (no reflector, no distance), DeviceSilent, DeviceRefused, BadReply or LinkLost.
        """
        if face not in ((1, 2) if self.two_face else (1,)):
            raise DeviceRefused("tracker", "this instrument is set up for one face", value=face)
        async with self._turn:
            loop = asyncio.get_running_loop()
            self._deadline_s = loop.time() + self._measure_timeout_s
            try:
                await self._aim(target, near_T_mm, face)
                await self._ask(TMC_DO_MEASURE, DEFAULT_DISTANCE, AUTOMATIC_INCLINATION, target=target)
                first, second = await self._read(target), await self._read(target)
            finally:
                self._deadline_s = math.inf
        return self._reading(target, first, second, face)

    async def close(self) -> None:
        """Release the line."""
        self._link.close()
        self._on_lost("closed")

    async def _wake(self) -> None:
        """The first request after a change of port may meet an instrument asleep or bytes in its buffer."""
        for attempt in range(AWAKE_ATTEMPTS):
            self._link.write(b"\n")
            try:
                await self._ask(COM_NULL_PROC)
                return
            except DeviceSilent:
                if attempt == AWAKE_ATTEMPTS - 1:
                    raise

    async def _aim(self, target: str, near_T_mm: Array, face: int) -> None:
        hz, v = polar_from_point(near_T_mm, face)
        # A distance left from another target would be returned with the angles of this one.
        await self._ask(TMC_DO_MEASURE, CLEAR_DISTANCE, AUTOMATIC_INCLINATION, target=target)
        await self._ask(AUT_MAKE_POSITIONING, hz, v, 0, 0, 0, target=target, timeout_s=TURN_TIMEOUT_S)
        await self._ask(AUT_FINE_ADJUST, SEARCH_RAD, SEARCH_RAD, 0, target=target, timeout_s=TURN_TIMEOUT_S)

    async def _read(self, target: str) -> GeocomReply:
        left_s = self._left_s()
        wait_s = max(0.1, left_s - WAIT_MARGIN_S)
        return await self._ask(
            TMC_GET_SIMPLE_MEA, round(wait_s * 1000.0), AUTOMATIC_INCLINATION, target=target, timeout_s=left_s
        )

    def _left_s(self) -> float:
        return self._deadline_s - asyncio.get_running_loop().time()

    async def _ask(
        self, rpc: int, *params: int | float, target: str = "", timeout_s: float = STATUS_TIMEOUT_S
    ) -> GeocomReply:
        """One procedure call, repeated while the instrument is busy and there is time; refusals become errors."""
        give_up_s = asyncio.get_running_loop().time() + min(timeout_s, self._left_s())
        while True:
            reply = await self._exchange(rpc, params, give_up_s)
            busy = reply.com in BUSY_CODES or reply.rc in BUSY_CODES
            if not busy or asyncio.get_running_loop().time() + BUSY_PAUSE_S >= give_up_s:
                break
            await asyncio.sleep(BUSY_PAUSE_S)
        _raise_refusal(rpc, reply, target)
        return reply

    async def _exchange(self, rpc: int, params: tuple[int | float, ...], give_up_s: float) -> GeocomReply:
        if self._lost is not None:
            raise LinkLost("tracker", self._lost)
        loop = asyncio.get_running_loop()
        wait_s = max(0.0, give_up_s - loop.time())
        self._trid = (self._trid + 1) % TRID_MODULUS
        self._reply = loop.create_future()
        try:
            self._link.write(encode_request(rpc, self._trid, params, self._checksum))
            await asyncio.wait({self._reply}, timeout=wait_s)
            if self._reply.done():
                return self._reply.result()
            # The leading line feed empties the instrument's buffer; a late reply is dropped by its number.
            self._link.write(b"\n")
            await asyncio.sleep(DRAIN_S)
        finally:
            self._reply = None
        self._parser.reset()
        name = RPC_NAMES.get(rpc, str(rpc))
        cause = f"no reply to {name}; {self.bad_lines} bad lines so far"
        raise DeviceSilent("tracker", cause, limit=round(wait_s, 3))

    def _on_bytes(self, data: bytes) -> None:
        for reply in self._parser.feed(data):
            if self._reply is None or self._reply.done() or reply.trid != self._trid:
                self.stale_replies += 1
            else:
                self._reply.set_result(reply)

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(LinkLost("tracker", reason))

    def _reading(self, target: str, first: GeocomReply, second: GeocomReply, face: int) -> Reading:
        """The noun from two replies that must agree, or TargetLost / BadReply."""
        hz, v, slope_m = _polar(target, second)
        p_T_mm = point_from_polar(hz, v, slope_m)
        if slope_m <= 0.0:
            raise TargetLost(target, "distance exactly zero: none was measured")
        if (1 if v < math.pi else 2) != face:
            raise BadReply("tracker", f"{target}: measured in the other face", value=math.degrees(v))
        degraded = bool({first.rc, second.rc} & DEGRADED_CODES)
        cov_mm2 = reading_covariance(self._covariance(p_T_mm), np.zeros(3), 0.0, degraded)
        apart_mm = np.abs(point_from_polar(*_polar(target, first)) - p_T_mm)
        if not np.all(apart_mm <= AGREE_SIGMAS * np.sqrt(np.diag(cov_mm2))):
            raise BadReply(
                "tracker", f"{target}: two readings of one measurement differ, mm", value=float(np.max(apart_mm))
            )
        self._frozen.check(target, (hz, v, slope_m))
        return Reading(target, p_T_mm, cov_mm2, asyncio.get_running_loop().time(), face, degraded)


def _only(reply: GeocomReply) -> str:
    """The one parameter of a reply."""
    if len(reply.params) != 1:
        raise BadReply("tracker", "one parameter expected", value=len(reply.params))
    return reply.params[0]


def _polar(target: str, reply: GeocomReply) -> tuple[float, float, float]:
    """Hz, V (rad) and slope distance (m) of a GetSimpleMea reply."""
    try:
        hz, v, slope_m = (number(p) for p in reply.params)
    except ValueError as error:
        raise BadReply("tracker", f"{target}: {error}", value=",".join(reply.params)) from error
    return hz, v, slope_m


def _raise_refusal(rpc: int, reply: GeocomReply, target: str) -> None:
    """Turn return codes into errors; OK and the accuracy warnings of a measurement pass."""
    name = RPC_NAMES.get(rpc, str(rpc))
    if reply.com != 0:
        cause = REFUSAL_WORDS.get(reply.com, "communication error")
        raise DeviceRefused("tracker", f"{name}: {cause}", value=reply.com)
    if reply.rc == 0 or (rpc == TMC_GET_SIMPLE_MEA and reply.rc in DEGRADED_CODES):
        return
    if target and reply.rc in TARGET_CODES:
        raise TargetLost(target, f"{TARGET_CODES[reply.rc]} (code {reply.rc})")
    raise DeviceRefused("tracker", f"{name}: {REFUSAL_WORDS.get(reply.rc, 'unknown return code')}", value=reply.rc)
