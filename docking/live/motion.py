"""The `Motion` port with an eye on the part: every move is followed, and stopped on its path where it must not go on.

Camera and inertial sensor stream during moves only, from a short look at rest on. All of it runs in the cell process:
the cycles of the motion process do not wait for it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from docking.errors import DockingError, LinkError
from docking.live.pose import LivePose
from docking.live.settings import LiveSettings
from docking.ports import InertialSensor, Motion, PointStream
from docking.types import Array, Feedback, Identity, InputState, MoveResult, Plan

LOOK_S = 0.05


class ReportingMotion(Motion, Protocol):
    """A motion side that tells every read-back when it comes."""

    on_feedback: Callable[[Feedback], None]


@dataclass
class LiveStreams:
    """The sensors beside the tracker."""

    camera: PointStream
    inertial: InertialSensor | None = None

    @property
    def all(self) -> tuple[PointStream | InertialSensor, ...]:
        return (self.camera,) if self.inertial is None else (self.camera, self.inertial)


@dataclass(frozen=True)
class LiveListeners:
    """`alarm` hears what is wrong with a source while the move goes on, `figures` the record of every move."""

    alarm: Callable[[DockingError], None]
    figures: Callable[[dict[str, Any]], None]


class WatchedMotion:
    """`motion`, watched through `streams`; see `docking.ports.Motion`."""

    def __init__(self, motion: ReportingMotion, streams: LiveStreams, settings: LiveSettings) -> None:
        self.listeners = LiveListeners(lambda error: None, lambda body: None)
        self.axes = motion.axes
        self.live: LivePose | None = None
        self._motion, self._streams, self._settings = motion, streams, settings
        self._plan: Plan | None = None
        self._loop = asyncio.get_running_loop()
        self._lost: dict[str, LinkError] = {}
        motion.on_feedback = self._read_back

    @property
    def speed_limit_mm_s(self) -> float:
        return self._motion.speed_limit_mm_s

    @speed_limit_mm_s.setter
    def speed_limit_mm_s(self, value: float) -> None:
        self._motion.speed_limit_mm_s = value

    # the port ------------------------------------------------------------------------------------------------------
    async def connect(self) -> tuple[Identity, ...]:
        found = await self._motion.connect()
        return (*found, *[await stream.connect() for stream in self._streams.all])

    async def enable(self) -> Array:
        return await self._motion.enable()

    async def load(self, plan: Plan) -> None:
        await self._motion.load(plan)
        self._plan = plan

    async def start(self, plan_hash: str) -> MoveResult:
        """Look at the part, then run the plan. Raises PoseUncertain where too little is seen, LinkError of a sensor."""
        live = LivePose(self._settings)
        self.live = live
        self._hear(live)
        begun: list[PointStream | InertialSensor] = []
        try:
            for stream in self._streams.all:
                await self._begin(stream)
                begun.append(stream)
            live.read_back(self._motion.feedback())
            await asyncio.sleep(self._settings.rest_s)
            live.begin(self._plan)
            return await self._watched(live, plan_hash)
        finally:
            self.live = None
            for stream in begun:
                # A stream that has ended by itself was told already.
                with contextlib.suppress(LinkError):
                    await stream.stop()
            self.listeners.figures(asdict(live.figures))

    async def _watched(self, live: LivePose, plan_hash: str) -> MoveResult:
        watching = self._loop.create_task(self._watch(live))
        try:
            return await self._motion.start(plan_hash)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    async def reset(self, role: str) -> None:
        await self._motion.reset(role)

    def request(self, verb: str) -> None:
        self._motion.request(verb)

    def override(self, percent: float) -> None:
        self._motion.override(percent)

    def stop_for(self, error: DockingError) -> None:
        self._motion.stop_for(error)

    def feedback(self) -> Feedback:
        return self._motion.feedback()

    def inputs(self) -> InputState:
        return self._motion.inputs()

    async def close(self) -> None:
        try:
            await self._motion.close()
        finally:
            for stream in self._streams.all:
                await stream.close()

    # the watch -----------------------------------------------------------------------------------------------------
    def _read_back(self, feedback: Feedback) -> None:
        if self.live is not None:
            self.live.read_back(feedback)

    def _hear(self, live: LivePose) -> None:
        camera, inertial = self._streams.camera, self._streams.inertial
        camera.on_frame = live.frame
        camera.on_lost = lambda error: self._end_of("camera", error)
        if inertial is not None:
            inertial.on_sample = live.sample
            inertial.on_lost = lambda error: self._end_of("inertial sensor", error)

    async def _begin(self, stream: PointStream | InertialSensor) -> None:
        """Start a stream; one that was lost is connected anew first."""
        which = "camera" if stream is self._streams.camera else "inertial sensor"
        if self._lost.pop(which, None) is not None:
            await stream.close()
            await stream.connect()
        await stream.start()

    def _end_of(self, which: str, error: LinkError) -> None:
        """A sensor is gone: told; how long the move goes on without it is a matter of the uncertainty."""
        self._lost[which] = error
        self.listeners.alarm(error)

    async def _watch(self, live: LivePose) -> None:
        asked = False
        while True:
            await asyncio.sleep(LOOK_S)
            error = live.look(self._loop.time())
            for alarm in live.alarms():
                self.listeners.alarm(alarm)
            if error is not None and not asked:
                asked = True
                self._motion.stop_for(error)
