"""An NDI camera over the Combined API: implements `docking.ports.PointStream`.

Bring-up: reset, line speed, initialise, identity, tool definitions, tools initialised and enabled, each proved by the
device's own list. Then tracking data is asked for as fast as the line carries it; every exposure is handed on once.
Places are good to about 0.1 mm and told to 0.01 mm: enough to guide and to watch, not for the final fit.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable

from docking.config.instruments import NdiConfig
from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, ReadBackMismatch
from docking.ports import SpeedLink
from docking.sightings import PointFrame, Sight, ToolSighting
from docking.types import Identity
from drivers.device_clock import DeviceClock
from drivers.ndi_codec import (
    ENABLED,
    INITIALISED,
    OUT_OF_VOLUME,
    PARTLY_OUT,
    STATUS_WORDS,
    STRAYS,
    TRANSFORMS,
    ToolReport,
    TrackReply,
    parse_handles,
    parse_track,
)
from drivers.ndi_line import NdiLine

TRACK_TIMEOUT_S = 0.5
START_TIMEOUT_S = 5.0
LOST_IN_A_ROW = 3
FROZEN_S = 1.0
ROM_BLOCK = 64
PASSIVE_PORT = "********01****"
"""Hardware, system, tool type, port and reserved characters of a tool that is not plugged in."""


def _ignore(_: object) -> None:
    """Default sink until the user sets its own."""


class NdiStream:
    """`docking.ports.PointStream` on `link`; `roms` holds the definition of each configured tool by its name."""

    def __init__(self, link: SpeedLink, config: NdiConfig, roms: dict[str, bytes], name: str = "camera") -> None:
        self.on_frame: Callable[[PointFrame], None] = _ignore
        self.on_lost: Callable[[LinkError], None] = _ignore
        self.line = NdiLine(link, name)
        self.repeated_frames = 0
        self._config, self._roms, self._name = config, roms, name
        self._tools: dict[str, str] = {}
        self._task: asyncio.Task[None] | None = None
        self._clock = DeviceClock()
        self._last_frame, self._fresh_at_s = -1, 0.0

    async def connect(self) -> Identity:
        """Reset, set the speed, identify, load and enable the tools.

        Raises PortMissing, DeviceSilent, DeviceRefused, BadReply, ReadBackMismatch or LinkLost.
        """
        try:
            await self.line.open(self._config.baud)
            version = await self.line.ask("VER", "4")
            await self._bring_up_tools()
        except BaseException:
            await self.close()
            raise
        return _identity(self._name, version)

    async def start(self) -> None:
        """Begin to track; frames go to `on_frame`. Raises as the commands."""
        await self.line.okay("TSTART", timeout_s=START_TIMEOUT_S)
        self._clock, self._last_frame = DeviceClock(), -1
        self._fresh_at_s = asyncio.get_running_loop().time()
        self._task = asyncio.create_task(self._track())

    async def stop(self) -> None:
        """End tracking. The answer on its way is waited for: replies carry no number."""
        task, self._task = self._task, None
        if task is not None:
            await task
        await self.line.okay("TSTOP", timeout_s=START_TIMEOUT_S)

    async def close(self) -> None:
        """Release the line."""
        task, self._task = self._task, None
        if task is not None and task is not asyncio.current_task():
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        self.line.close()

    # tools ------------------------------------------------------------------------------------------------------
    async def _bring_up_tools(self) -> None:
        self._tools = {}
        for handle in await self._handles("01"):
            await self.line.okay("PHF", handle)
        for name, rom in self._roms.items():
            await self._load(name, rom)
        for handle in await self._handles("02"):
            await self.line.okay("PINIT", handle, START_TIMEOUT_S)
            self._tools.setdefault(handle, await self._part_number(handle))
        for handle in await self._handles("03"):
            await self.line.okay("PENA", handle + "D")
        ready = await self._handles("04")
        self._prove(ready)

    async def _load(self, name: str, rom: bytes) -> None:
        """Reserve a handle for a tool that is not plugged in and write its definition, in blocks."""
        answer = await self.line.ask("PHRQ", PASSIVE_PORT)
        handle = answer[:2]
        if not re.fullmatch("[0-9A-F]{2}", answer):
            raise BadReply(self._name, f"handle for tool {name} expected", value=answer[:20])
        padded = rom.ljust(-(-len(rom) // ROM_BLOCK) * ROM_BLOCK, b"\0")
        for at in range(0, len(padded), ROM_BLOCK):
            await self.line.okay("PVWR", f"{handle}{at:04X}{padded[at : at + ROM_BLOCK].hex().upper()}")
        self._tools[handle] = name

    async def _part_number(self, handle: str) -> str:
        """The name of a tool that is plugged in: its part number, or its handle where it has none."""
        return (await self.line.ask("PHINF", handle + "0004")).strip() or f"port {handle}"

    async def _handles(self, which: str) -> dict[str, int]:
        text = await self.line.ask("PHSR", which)
        try:
            return parse_handles(text)
        except ValueError as error:
            raise BadReply(self._name, str(error), value=text[:40]) from error

    def _prove(self, ready: dict[str, int]) -> None:
        """Every tool is in the device's own list of enabled tools, and says so itself."""
        if not ready:
            raise DeviceRefused(self._name, "no tool is enabled: without one the frames carry no number", value=0)
        for handle, name in self._tools.items():
            status = ready.get(handle, 0)
            if status & (INITIALISED | ENABLED) != INITIALISED | ENABLED:
                raise ReadBackMismatch(
                    self._name,
                    f"tool {name} is not enabled",
                    value=f"{status:03X}",
                    limit=f"{INITIALISED | ENABLED:03X}",
                )

    # tracking ---------------------------------------------------------------------------------------------------
    async def _track(self) -> None:
        options = f"{TRANSFORMS | (STRAYS if self._config.strays else 0):04X}"
        lost = 0
        try:
            while self._task is not None:
                try:
                    text = await self.line.ask("TX", options, TRACK_TIMEOUT_S)
                    frame = self._frame(parse_track(text, self._config.strays))
                    lost = 0
                except (DeviceSilent, ValueError) as error:
                    lost += 1
                    if lost >= LOST_IN_A_ROW:
                        raise _as_link_error(self._name, error) from error
                    continue
                if frame is None:
                    await asyncio.sleep(0.25 / self._config.rate_hz)
                else:
                    self.on_frame(frame)
        except LinkError as error:
            if self._task is not None:
                self._task = None
                self.on_lost(error)

    def _frame(self, reply: TrackReply) -> PointFrame | None:
        """The frame, None when it is the one before. Raises BadReply when they no longer count up."""
        now_s = asyncio.get_running_loop().time()
        number = max((tool.frame for tool in reply.tools), default=0)
        if number < self._last_frame:
            raise BadReply(self._name, "the frames count anew: the camera has restarted", value=number)
        if number == self._last_frame:
            self.repeated_frames += 1
            if now_s - self._fresh_at_s > FROZEN_S:
                raise BadReply(self._name, f"the same frame for {FROZEN_S:g} s: the camera is frozen", value=number)
            return None
        self._last_frame, self._fresh_at_s = number, now_s
        return PointFrame(
            number=number,
            t_s=self._clock.loop_s(number / self._config.rate_hz, now_s),
            received_s=now_s,
            tools=tuple(self._sighting(tool) for tool in reply.tools),
            strays_T_mm=reply.strays_mm[[not out for out in reply.outside]],
            warnings=tuple(words for bit, words in STATUS_WORDS.items() if reply.status & bit),
        )

    def _sighting(self, tool: ToolReport) -> ToolSighting:
        name = self._tools.get(tool.handle, f"port {tool.handle}")
        if tool.word:
            sight = Sight.MISSING if tool.word == "MISSING" else Sight.DISABLED
        else:
            sight = Sight.OUTSIDE if tool.status & (OUT_OF_VOLUME | PARTLY_OUT) else Sight.SEEN
        return ToolSighting(name, sight, tool.p_mm, tool.turn, tool.error_mm)


def _as_link_error(name: str, error: Exception) -> LinkError:
    return error if isinstance(error, LinkError) else BadReply(name, str(error), value="TX")


def _identity(name: str, version: str) -> Identity:
    """What the lines of VER:4 say: product, serial number, firmware."""
    lines = version.splitlines() or [""]

    def after(label: str) -> str:
        found = re.search(rf"{label}\s*:\s*(\S.*)", version)
        return found[1].strip() if found else ""

    return Identity(name, "NDI", lines[0].strip(), after("S/N"), after("Freeze Tag"))
