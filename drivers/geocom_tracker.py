"""A Leica total or laser station over GeoCOM: implements `docking.ports.Tracker`.

A point is taken as: clear the old distance, turn to where the target is expected, let the target recognition find the
reflector (over a wider window where that is allowed), measure a distance, read it twice by two procedures. Without a
checksum on the line a flipped digit is a valid number, so both readings must agree within three sigma. The second one
brings the instrument's own sigma of the angles and the time of the distance, which must be a fresh one.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass

import numpy as np

from docking.config.cell import TrackerConfig
from docking.config.instruments import GeocomConfig
from docking.errors import BadReply, DeviceRefused, TargetLost
from docking.ports import SerialLink
from docking.types import Array, Identity, Reading
from drivers.geocom_codec import (
    AUT_FINE_ADJUST,
    AUT_MAKE_POSITIONING,
    AUT_SEARCH,
    DEGRADED_CODES,
    NOT_FOUND_CODES,
    NOT_OFFERED,
    TMC_DO_MEASURE,
    TMC_GET_FULL_MEAS,
    TMC_GET_SIMPLE_MEA,
    GeocomReply,
    number,
    point_from_polar,
    polar_from_point,
)
from drivers.geocom_line import GeocomLine
from drivers.geocom_setup import set_up
from drivers.readings import Covariance, FrozenWatch, across_at_least, reading_covariance

TURN_TIMEOUT_S = 20.0
WAIT_MARGIN_S = 0.5
FINE_WINDOW_RAD = 0.02
AGREE_SIGMAS = 3.0
SIGMA_MAX_RAD = 1e-3
"""No instrument that measures angles is as bad as this; a larger value is a broken line."""

DEFAULT_DISTANCE, CLEAR_DISTANCE = 1, 3
AUTOMATIC_INCLINATION = 1


@dataclass(frozen=True)
class _Polar:
    """One reading: Hz, V (rad), slope distance (m); with sigma of the angles (rad) and time (ms) where it has them."""

    hz: float
    v: float
    slope_m: float
    degraded: bool
    sigma_rad: float = 0.0
    taken_ms: float | None = None

    def point_mm(self) -> Array:
        """(3,) mm in the station frame."""
        return point_from_polar(self.hz, self.v, self.slope_m)


class GeocomTracker:
    """`docking.ports.Tracker` over GeoCOM; two faces. `covariance` is the noise model of the device class.

    Station frame: x east, y north, z up, Hz clockwise from north. Error `where` is the target's name for what concerns
    a target, else "tracker".
    """

    def __init__(self, link: SerialLink, config: TrackerConfig, covariance: Covariance) -> None:
        self.two_face = config.two_face
        self._settings = config.geocom or GeocomConfig()
        self.line = GeocomLine(link, self._settings.checksum)
        self._covariance = covariance
        self._measure_timeout_s = config.measure_timeout_s
        self._frozen = FrozenWatch()
        self._turn = asyncio.Lock()
        self._has_full = True
        self._taken_ms: float | None = None

    async def connect(self) -> Identity:
        """Open the line, wake the instrument, ask who it is, write the settings and read them back.

        Raises PortMissing, DeviceSilent, DeviceRefused, ReadBackMismatch or BadReply.
        """
        self._has_full, self._taken_ms = True, None
        try:
            async with self._turn:
                await self.line.open()
                return await set_up(self.line, self._settings)
        except BaseException:
            await self.close()
            raise

    async def measure(self, target: str, near_T_mm: Array, face: int = 1) -> Reading:
        """Measure `target`, found near `near_T_mm` (3,); see `docking.ports.Tracker.measure`.

        Raises TargetLost (no reflector, no distance), DeviceSilent, DeviceRefused, BadReply or LinkLost.
        """
        if face not in ((1, 2) if self.two_face else (1,)):
            raise DeviceRefused("tracker", "this instrument is set up for one face", value=face)
        async with self._turn:
            self.line.deadline_s = asyncio.get_running_loop().time() + self._measure_timeout_s
            try:
                await self._aim(target, near_T_mm, face)
                await self.line.ask(TMC_DO_MEASURE, DEFAULT_DISTANCE, AUTOMATIC_INCLINATION, target=target)
                first = _simple(target, await self._read(TMC_GET_SIMPLE_MEA, target))
                second = await self._read_again(target)
            finally:
                self.line.deadline_s = math.inf
        return self._reading(target, first, second, face)

    async def close(self) -> None:
        """Release the line."""
        self.line.close()

    async def _aim(self, target: str, near_T_mm: Array, face: int) -> None:
        hz, v = polar_from_point(near_T_mm, face)
        # A distance left from another target would be returned with the angles of this one.
        await self.line.ask(TMC_DO_MEASURE, CLEAR_DISTANCE, AUTOMATIC_INCLINATION, target=target)
        await self.line.ask(AUT_MAKE_POSITIONING, hz, v, 0, 0, 0, target=target, timeout_s=TURN_TIMEOUT_S)
        try:
            await self._fine_adjust(target)
        except TargetLost as lost:
            if self._settings.search_deg == 0.0 or lost.value not in NOT_FOUND_CODES:
                raise
            window = math.radians(self._settings.search_deg)
            await self.line.ask(AUT_SEARCH, window, window, 0, target=target, timeout_s=TURN_TIMEOUT_S)
            await self._fine_adjust(target)

    async def _fine_adjust(self, target: str) -> None:
        window = FINE_WINDOW_RAD
        await self.line.ask(AUT_FINE_ADJUST, window, window, 0, target=target, timeout_s=TURN_TIMEOUT_S)

    async def _read(self, rpc: int, target: str) -> GeocomReply:
        left_s = self.line.left_s()
        wait_s = max(0.1, left_s - WAIT_MARGIN_S)
        return await self.line.ask(rpc, round(wait_s * 1000.0), AUTOMATIC_INCLINATION, target=target, timeout_s=left_s)

    async def _read_again(self, target: str) -> _Polar:
        """The same distance by the procedure that tells more, or by the simple one where the firmware is older."""
        if self._has_full:
            try:
                return _full(target, await self._read(TMC_GET_FULL_MEAS, target))
            except DeviceRefused as refused:
                if refused.value != NOT_OFFERED:
                    raise
                self._has_full = False
        return _simple(target, await self._read(TMC_GET_SIMPLE_MEA, target))

    def _reading(self, target: str, first: _Polar, second: _Polar, face: int) -> Reading:
        """The noun from two readings that must agree, or TargetLost / BadReply."""
        p_T_mm = second.point_mm()
        if not (first.slope_m > 0.0 and second.slope_m > 0.0):
            raise TargetLost(target, "distance exactly zero: none was measured")
        if (1 if second.v < math.pi else 2) != face:
            raise BadReply("tracker", f"{target}: measured in the other face", value=math.degrees(second.v))
        if second.taken_ms is not None and second.taken_ms == self._taken_ms:
            raise BadReply("tracker", f"{target}: the distance is that of the point before", value=second.taken_ms)
        self._taken_ms = second.taken_ms
        degraded = first.degraded or second.degraded
        model_mm2 = across_at_least(self._covariance(p_T_mm), p_T_mm, second.sigma_rad)
        cov_mm2 = reading_covariance(model_mm2, np.zeros(3), 0.0, degraded)
        apart_mm = np.abs(first.point_mm() - p_T_mm)
        if not np.all(apart_mm <= AGREE_SIGMAS * np.sqrt(np.diag(cov_mm2))):
            raise BadReply(
                "tracker", f"{target}: two readings of one measurement differ, mm", value=float(np.max(apart_mm))
            )
        self._frozen.check(target, (second.hz, second.v, second.slope_m))
        return Reading(target, p_T_mm, cov_mm2, asyncio.get_running_loop().time(), face, degraded)


def _numbers(target: str, reply: GeocomReply, count: int) -> list[float]:
    """The `count` numbers of a reply."""
    try:
        values = [number(p) for p in reply.params]
    except ValueError as error:
        raise BadReply("tracker", f"{target}: {error}", value=",".join(reply.params)) from error
    if len(values) != count:
        raise BadReply("tracker", f"{target}: {count} values expected", value=len(values))
    return values


def _simple(target: str, reply: GeocomReply) -> _Polar:
    """Hz, V, slope distance of a GetSimpleMea reply."""
    hz, v, slope_m = _numbers(target, reply, 3)
    return _Polar(hz, v, slope_m, reply.rc in DEGRADED_CODES)


def _full(target: str, reply: GeocomReply) -> _Polar:
    """Hz, V, their sigma, three tilt values that are not used, slope distance and time of a GetFullMeas reply."""
    hz, v, sigma_rad, _, _, _, slope_m, taken_ms = _numbers(target, reply, 8)
    if not 0.0 <= sigma_rad <= SIGMA_MAX_RAD:
        raise BadReply("tracker", f"{target}: accuracy of the angles out of range, rad", value=sigma_rad)
    return _Polar(hz, v, slope_m, reply.rc in DEGRADED_CODES, sigma_rad, taken_ms)
