"""In-memory positioners for the tests of the motion side: set-points in, read-backs out, faults at will."""

from __future__ import annotations

import asyncio
from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import DeviceRefused
from docking.kinematics import Load, Positioners
from docking.motion.monitors import Watch, WatchLimits
from docking.types import Array, AxisState, Feedback, Identity, Plan

LIMITS = WatchLimits(
    following_rest_mm=0.1,
    following_vmax_mm=0.5,
    ball_residual_mm=0.1,
    internal_force_n=1500.0,
    warp_force_n=300.0,
    missing_cycles=2,
)
LOAD = Load(6000.0, 0.0, np.array([600.0, 200.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, -9.80665]))


LATE_CYCLES = 20


def watch_of(positioners: Positioners, limits: WatchLimits = LIMITS, load_cells: ArrayLike | None = None) -> Watch:
    """The watch of positioners without load cells, or with one under each axis of the mask (m,)."""
    fitted = np.zeros(len(positioners.axes), dtype=bool) if load_cells is None else load_cells
    return Watch(positioners, LOAD, limits, fitted)


def read_back(position_mm: Array, **changes: object) -> Feedback:
    """A healthy read-back of axes at `position_mm` (m,); `changes` by field name."""
    count = len(position_mm)
    fields: dict[str, object] = {
        "t_s": 0.0,
        "position_mm": position_mm,
        "following_error_mm": np.zeros(count),
        "force_n": np.full(count, np.nan),
        "states": (AxisState.ENABLED,) * count,
        "age_cycles": np.zeros(count),
    }
    return Feedback(**(fields | changes))  # type: ignore[arg-type]


class StreamedFake:
    """Drives that stand where the set-point of two cycles ago told them to."""

    def __init__(self, axes: tuple[str, ...], start_mm: Array, cycle_s: float = 0.01) -> None:
        self.axes, self.cycle_s = axes, cycle_s
        self.a_quick_mm_s2 = np.full(len(axes), 200.0)
        self.sent: list[Array] = []
        self.sent_at_s: list[float] = []
        self.changes: dict[str, object] = {}
        self.offset_mm = np.zeros(len(axes))
        self.error: Exception | None = None
        self.quick_stops = self.enables = self.brakes = 0
        self.brake_s = 0.2
        self.armed: list[tuple[Array, float]] = []
        self.closed = self.silent = False
        self._pipe = deque([start_mm] * 2, maxlen=2)

    async def bring_up(self) -> tuple[Identity, ...]:
        return (Identity("axis A.X", "fake", "drive", "1", "1"),)

    async def enable(self) -> Feedback:
        await asyncio.sleep(2.0 * self.cycle_s)
        self.enables += 1
        return read_back(self._pipe[0] + self.offset_mm)

    def latest(self) -> Feedback:
        return read_back(self._pipe[0] + self.offset_mm, **self.changes)

    def send(self, setpoint_mm: Array) -> None:
        if self.error is not None:
            raise self.error
        self._pipe.append(setpoint_mm)
        self.sent.append(np.array(setpoint_mm))
        self.sent_at_s.append(asyncio.get_running_loop().time())

    async def arm_stops(self, peak_mm_s: Array, t_stop_s: float) -> None:
        self.armed.append((np.array(peak_mm_s), t_stop_s))

    async def restore_stops(self) -> None:
        self.armed.clear()

    def quick_stop(self) -> None:
        self.quick_stops += 1

    async def brake(self) -> None:
        await asyncio.sleep(self.brake_s)
        self.brakes += 1

    def go_silent(self) -> None:
        self.silent = True

    async def reset_faults(self) -> None:
        self.changes.pop("fault", None)

    async def close(self) -> None:
        self.closed = True


class QueuedFake:
    """Controllers that play one queue along chords; a stop takes `ramp_s`, a resume before its end is refused."""

    def __init__(self, axes: tuple[str, ...], start_mm: Array, segment_s: float = 0.1, ramp_s: float = 0.5) -> None:
        self.axes, self.segment_s, self.ramp_s = axes, segment_s, ramp_s
        self.quick_ramp_s = 0.04
        self.on_lost = lambda: None
        self.braked = self.silent = False
        self.rate = 1.0
        self.verbs: list[str] = []
        self.changes: dict[str, object] = {}
        self.offset_mm = np.zeros(len(axes))
        self.error: Exception | None = None
        self.closed = False
        self.loaded: Plan | None = None
        self._start_mm = start_mm
        self._path_s = self._rate = self._goal = self._seen_s = 0.0
        self._slope_s = ramp_s

    async def bring_up(self) -> tuple[Identity, ...]:
        return (Identity("positioner A", "fake", "PLC", "1", "1"),)

    async def enable(self) -> Feedback:
        return await self.poll()

    async def load(self, plan: Plan) -> None:
        self.loaded, self._path_s, self._rate, self._goal = plan, 0.0, 0.0, 0.0

    async def command(self, verb: str) -> None:
        if self.error is not None:
            raise self.error
        self._advance()
        if verb == "resume" and not (self._rate == 0.0 and self._goal == 0.0):
            raise DeviceRefused("positioner A", "resume while it is stopping", value=4)
        self.verbs.append(verb)
        self._goal = self.rate if verb in ("run", "resume") else 0.0
        self._slope_s = self.quick_ramp_s if verb == "quick-stop" else self.ramp_s
        if verb == "run":
            self._rate = self.rate
        if verb == "quick-stop":
            self.braked = True

    async def override(self, rate: float) -> None:
        assert self._rate == 0.0, "the rate changes at standstill only"
        self.verbs.append(f"rate {rate:g}")
        self.rate = rate

    def go_silent(self) -> None:
        self.silent = True

    async def poll(self, *, surviving: bool = False) -> Feedback:
        if self.error is not None:
            raise self.error
        self._advance()
        stopping = self._goal < self._rate
        states = (AxisState.STOPPING if stopping else AxisState.ENABLED,) * len(self.axes)
        path_s = self._path_s if self.loaded is not None else float("nan")
        fields = {"states": states, "path_time_s": path_s, "t_s": asyncio.get_running_loop().time()}
        return read_back(self.position_mm() + self.offset_mm, **(fields | self.changes))

    async def close(self) -> None:
        self.closed = True

    def position_mm(self) -> Array:
        if self.loaded is None:
            return self._start_mm
        return np.array([np.interp(self._path_s, self.loaded.t_s, column) for column in self.loaded.q_mm.T])

    def _advance(self) -> None:
        now_s = asyncio.get_running_loop().time()
        while self._seen_s < now_s - 1e-9:
            step_s = min(0.01, now_s - self._seen_s)
            before = self._rate
            change = np.clip(self._goal - before, -step_s / self._slope_s, step_s / self._slope_s)
            self._rate = self._goal if abs(self._goal - before - change) < 1e-9 else before + float(change)
            self._path_s += 0.5 * (before + self._rate) * step_s
            self._seen_s += step_s
        if self.loaded is not None and self._path_s >= self.loaded.duration_s:
            self._path_s, self._rate, self._goal = self.loaded.duration_s, 0.0, 0.0
