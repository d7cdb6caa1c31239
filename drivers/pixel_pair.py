"""A camera pair's vision computer over a serial or network line: implements `docking.ports.PointStream`.

Both cameras are exposed together. For each exposure and camera one line comes, in ASCII, without being asked for:

    $PX,CAMERA,NUMBER,MICROSECONDS,NAME,U,V,NAME,U,V...*CRC<CR><LF>

NUMBER rises with every exposure, MICROSECONDS is the computer's clock at the exposure, U and V are pixels; <CRC> is
CRC-16/ARC over everything between $ and *, four upper-case hexadecimal digits. Points that a camera does not see are
left out. The frames that go on hold triangulated points in W, each with its covariance.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable

import numpy as np

from docking.errors import BadReply, DeviceSilent, LinkError, LinkLost
from docking.ports import SerialLink
from docking.sightings import PointFrame, Sight, ToolSighting
from docking.tracking.stereo import StereoCamera, triangulate
from docking.types import Identity
from drivers.device_clock import DeviceClock
from drivers.garbage import GarbageWatch
from drivers.line_codec import crc16_arc

SILENT_S = 1.0
CONNECT_S = 3.0
LINE_MAX = 8192
KEPT = 8
"""Exposures that wait for the line of the other camera; older ones are given up as seen by one only."""
_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.\d{1,6})?")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,31}")
Pixels = dict[str, tuple[float, float]]


def decode(line: bytes) -> tuple[str, int, int, Pixels]:
    """Camera, number, microseconds and pixels by name of one line without its end. ValueError for anything else."""
    body, star, crc = line[1:].rpartition(b"*")
    if not line.startswith(b"$") or not star or crc != b"%04X" % crc16_arc(body):
        raise ValueError("checksum differs")
    fields = body.decode("ascii").split(",")
    if len(fields) < 4 or (len(fields) - 4) % 3 or fields[0] != "PX" or not all(f.isdecimal() for f in fields[2:4]):
        raise ValueError("not a line of pixels")
    pixels: Pixels = {}
    for name, u, v in zip(fields[4::3], fields[5::3], fields[6::3], strict=True):
        if not _NAME.fullmatch(name) or name in pixels or not (_NUMBER.fullmatch(u) and _NUMBER.fullmatch(v)):
            raise ValueError(f"not a point: {name[:32]}")
        pixels[name] = (float(u), float(v))
    return fields[1], int(fields[2]), int(fields[3]), pixels


class PixelPair:
    """`docking.ports.PointStream` on `link`; the two `cameras` are known by their names."""

    def __init__(self, link: SerialLink, cameras: tuple[StereoCamera, StereoCamera], name: str = "camera") -> None:
        self.on_frame: Callable[[PointFrame], None] = lambda frame: None
        self.on_lost: Callable[[LinkError], None] = lambda error: None
        self.bad_lines = self.incomplete = 0
        self._link, self._cameras, self._name = link, cameras, name
        self._garbage = GarbageWatch()
        self._rest = b""
        self._waiting: dict[int, dict[str, tuple[int, Pixels]]] = {}
        self._last = -1
        self._clock = DeviceClock()
        self._heard: asyncio.Event = asyncio.Event()
        self._heard_s = math.nan
        self._streaming = False
        self._watch: asyncio.TimerHandle | None = None
        self._failed: LinkError | None = None

    async def connect(self) -> Identity:
        """Open the line and wait for the first exposure of both cameras. Raises PortMissing, DeviceSilent, LinkLost."""
        self._link.on_bytes, self._link.on_lost = self._on_bytes, self._on_link_lost
        self._rest, self._last, self._failed, self._clock = b"", -1, None, DeviceClock()
        self._waiting.clear()
        self._garbage.reset()
        self._heard.clear()
        await self._link.open()
        try:
            async with asyncio.timeout(CONNECT_S):
                await self._heard.wait()
        except TimeoutError:
            self._link.close()
            cause = f"no exposure of both cameras came; {self.bad_lines} bad lines"
            raise DeviceSilent(self._name, cause, limit=CONNECT_S) from None
        except BaseException:
            self._link.close()
            raise
        return Identity(self._name, "pixel pair", " and ".join(camera.name for camera in self._cameras), "", "")

    async def start(self) -> None:
        """Hand frames on from now. Raises the error that ended the stream before."""
        if self._failed is not None:
            raise self._failed
        self._streaming = True
        self._heard_s = asyncio.get_running_loop().time()
        self._look()

    async def stop(self) -> None:
        self._streaming = False
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    async def close(self) -> None:
        await self.stop()
        self._link.close()

    # in ----------------------------------------------------------------------------------------------------------
    def _on_bytes(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-LINE_MAX:]
        bad = 0
        for line in lines:
            try:
                self._take(*decode(line.rstrip(b"\r")))
            except ValueError:
                bad += 1
        self.bad_lines += bad
        distrust = self._garbage.count(bad, asyncio.get_running_loop().time())
        if distrust:
            self._fail(BadReply(self._name, "garbage on the line", value=distrust))

    def _take(self, camera: str, number: int, microseconds: int, pixels: Pixels) -> None:
        if camera not in {one.name for one in self._cameras}:
            raise ValueError(f"no such camera: {camera[:32]}")
        if number <= self._last:
            if number < self._last - 100 * KEPT:
                self._fail(BadReply(self._name, "the exposures count anew: the computer has restarted", value=number))
            return
        both = self._waiting.setdefault(number, {})
        both[camera] = microseconds, pixels
        if len(both) == 2:
            del self._waiting[number]
            self._frame(number, both)
        for old in [n for n in self._waiting if n < max(self._last, number - KEPT)]:
            # One camera's line is lost: nothing is known of this exposure.
            del self._waiting[old]
            self.incomplete += 1

    def _frame(self, number: int, both: dict[str, tuple[int, Pixels]]) -> None:
        now_s = asyncio.get_running_loop().time()
        self._last, self._heard_s = number, now_s
        self._heard.set()
        (us, left), (_, right) = (both[camera.name] for camera in self._cameras)
        t_s = self._clock.loop_s(us * 1e-6, now_s)
        if not self._streaming:
            return
        names = [name for name in left if name in right]
        pixels = tuple(np.array([side[name] for name in names]).reshape(-1, 2) for side in (left, right))
        found = triangulate(*self._cameras, (pixels[0], pixels[1]))
        good = found.agreeing()
        nothing = np.full(4, np.nan)
        tools = tuple(
            ToolSighting(name, Sight.SEEN, found.xyz_W_mm[k], nothing, float(np.sqrt(found.chi2[k])), found.cov_mm2[k])
            for k, name in enumerate(names)
            if good[k]
        )
        self.on_frame(PointFrame(number, t_s, now_s, tools, np.zeros((0, 3))))

    # the end -----------------------------------------------------------------------------------------------------
    def _look(self) -> None:
        loop = asyncio.get_running_loop()
        silent_s = loop.time() - self._heard_s
        if silent_s > SILENT_S:
            cause = (
                f"no exposure of both cameras came; {self.bad_lines} bad lines, {self.incomplete} of one camera only"
            )
            self._fail(DeviceSilent(self._name, cause, limit=SILENT_S))
            return
        self._watch = loop.call_later(0.25 * SILENT_S, self._look)

    def _on_link_lost(self, reason: str) -> None:
        self._fail(LinkLost(self._name, reason))

    def _fail(self, error: LinkError) -> None:
        streaming, self._streaming = self._streaming, False
        self._failed = self._failed or error
        if streaming:
            self.on_lost(error)
