"""`docking track CELL --live`: the pose of the part by camera, inertial sensor and positioners, live. Reads only."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from docking.assemble.live import live_settings
from docking.assemble.looking import Ends, LookRequest, load_looked_at, wires_of
from docking.assemble.real_time import on_interrupt, run_real
from docking.assemble.streams import streams_of
from docking.config import CellFile
from docking.config.load import default_job_path, load_job
from docking.errors import BadArgument, DockingError, LinkError
from docking.geometry import pose_to_vector
from docking.live import LiveStreams
from docking.live.pose import LivePose
from docking.live.settings import LiveSettings
from drivers.canopen.look import BusLook
from drivers.modbus_look import ModbusLook

PERIOD_S = 0.5
READ_S = 0.1
Show = Callable[[dict[str, Any]], None]


def look_live(request: LookRequest, seconds: float | None, show: Show) -> dict[str, Any]:
    """Call `show` with the pose twice a second, for `seconds` or until interrupted; returns the last values.

    Raises ConfigError, BadArgument for a cell without `[live]`, LinkError of a device, PoseUncertain.
    """
    cell = load_looked_at(request)
    if cell.live is None:
        raise BadArgument("--live", "the cell has no [live]", value=cell.name)
    settings = live_settings(cell, load_job(default_job_path(request.cell_path), cell), cell.live)

    async def main() -> dict[str, Any]:
        async with wires_of(request, cell) as ends:
            streams = streams_of(cell, request.cell_path.parent, ends.found)
            watch = _Watch(cell, ends, streams, LivePose(settings), show)
            return await watch.run(settings, seconds)

    return run_real(main, ticks=False)


class _Watch:
    """One look: `problems` are what the sources and the pose had to complain of, in their order."""

    def __init__(self, cell: CellFile, ends: Ends, streams: LiveStreams, live: LivePose, show: Show) -> None:
        self._cell, self._ends, self._streams, self._live, self._show = cell, ends, streams, live, show
        self._loop = asyncio.get_running_loop()
        self._problems: list[DockingError] = []
        self._asked_to_end = asyncio.Event()
        self._bus = BusLook(cell, ends.bus.can) if ends.bus.can is not None else None
        self._modbus = ModbusLook(cell, ends.bus.modbus, ends.tap, ends.bus.line)

    async def run(self, settings: LiveSettings, seconds: float | None) -> dict[str, Any]:
        on_interrupt(self._asked_to_end.set)
        async with self._streaming(), self._reading():
            await asyncio.sleep(settings.rest_s + 2.0 * READ_S)
            self._live.begin(None)
            began_s = self._loop.time()
            while True:
                await self._pause(PERIOD_S)
                values = self._values(settings.chosen, began_s)
                self._show(values)
                over = seconds is not None and not (values["t_s"] < seconds)
                if over or self._asked_to_end.is_set():
                    return values

    @asynccontextmanager
    async def _streaming(self) -> AsyncIterator[None]:
        """Camera and inertial sensor, told to the live pose."""
        self._streams.camera.on_frame = self._live.frame
        if self._streams.inertial is not None:
            self._streams.inertial.on_sample = self._live.sample
        try:
            for stream in self._streams.all:
                stream.on_lost = self._lost
                await stream.connect()
                await stream.start()
            yield
        finally:
            for stream in self._streams.all:
                await stream.close()

    @asynccontextmanager
    async def _reading(self) -> AsyncIterator[None]:
        """The positions of the axes, told to the live pose."""
        if self._bus is not None:
            await self._bus.open()
        reading = self._loop.create_task(self._read())
        try:
            yield
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            self._modbus.close()
            if self._bus is not None:
                self._bus.close()

    async def _read(self) -> None:
        streamed = self._bus is not None and self._cell.bus.kind == "canopen"
        while True:
            axes = await self._bus.axes() if self._bus is not None and streamed else await self._modbus.axes()
            q_mm = np.array([axis.position_mm for axis in axes])
            if np.all(np.isfinite(q_mm)):
                self._live.axes(self._loop.time(), q_mm)
            await asyncio.sleep(READ_S)

    def _lost(self, error: LinkError) -> None:
        self._problems.append(error)

    async def _pause(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._asked_to_end.wait()
        except TimeoutError:
            return

    def _values(self, method: str, began_s: float) -> dict[str, Any]:
        """One object of plain numbers; None where something is not known."""
        now_s = self._loop.time()
        failed = self._live.look(now_s)
        self._problems += self._live.alarms()
        if failed is not None and failed not in self._problems:
            self._problems.append(failed)
        state = self._live.state()
        values: dict[str, Any] = {"cell": self._cell.name, "method": method, "t_s": now_s - began_s}
        if state is not None:
            turn_sd = np.degrees(state.attitude_sd_rad)
            values |= {
                "pose": [float(v) for v in pose_to_vector(state.X_WB)],
                "com_W_mm": [float(v) for v in state.com_W_mm],
                "attitude_sd_deg": [float(v) if math.isfinite(v) else None for v in turn_sd],
                "predicted_sd_mm": state.predicted_sd_mm,
                "source": state.source,
                "blind_s": state.blind_s,
                "seen": int(state.seen.sum()),
                "points": len(state.seen),
            }
        figures = self._live.figures
        values |= {"frames": figures.frames, "deviation_mm": figures.last_mm}
        return values | {"alarms": [{"code": e.code, "message": e.text()} for e in self._problems]}


def live_text(values: dict[str, Any]) -> str:
    """One screen of values."""
    lines = [f"{values['cell']}  {values['t_s']:.1f} s  method {values['method']} (reads only)"]
    if "pose" in values:
        x, y, z, a, b, g = values["pose"]
        lines += [
            f"part   x {x:10.3f}  y {y:10.3f}  z {z:10.3f} mm   alpha {a:8.4f}  beta {b:8.4f}  gamma {g:8.4f} deg",
            f"known to {values['predicted_sd_mm']:.3f} mm at its worst point; source {values['source']}, "
            f"{values['seen']} of {values['points']} points seen, blind for {values['blind_s']:.2f} s",
            f"camera to read-backs {values['deviation_mm']:.3f} mm at the worst feature; {values['frames']} frames",
        ]
    lines += [f"ALARM {alarm['code']}: {alarm['message']}" for alarm in values["alarms"]]
    return "\n".join(lines)
