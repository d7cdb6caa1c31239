"""One running move of streamed axes: where it is on its path, how it slows down, what it ends with."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field, replace

from docking.motion.playback import Playback
from docking.motion.reactions import Reaction
from docking.motion.recorder import Recorder
from docking.motion.stop_clock import StopClock
from docking.motion.stops import PlannedStop
from docking.types import Array, MoveResult

SEEN_S = 0.1
"""So long after its last set-point a stop on the path is told even if the axes are not seen at rest."""


@dataclass(eq=False)
class StreamedMove:
    """A running move. `done` gets its result, `over` is set when it has ended in whatever way."""

    playback: Playback
    recorder: Recorder
    stop: PlannedStop
    done: asyncio.Future[MoveResult]
    over: asyncio.Event = field(default_factory=asyncio.Event)
    clock: StopClock = field(default_factory=StopClock)
    _told_s: float | None = None

    def slow_down(self, reaction: Reaction) -> None:
        """Begin a stop on the path; what ends in another way does nothing here."""
        if reaction is Reaction.FAST_PPS:
            self.playback.stop_straight(self.stop.fast_slew_per_s)
        elif reaction is Reaction.PPS:
            self.playback.hold()

    def led_stop_s(self, reaction: Reaction) -> float:
        """How long a stop on the path takes from now."""
        if reaction is Reaction.PPS:
            return self.playback.turn_s(0.0)
        return self.playback.rate / self.stop.fast_slew_per_s

    def has_ended(self, standing: bool, now_s: float) -> bool:
        """The commands are at rest: the move ends as soon as the axes are seen at rest, too, or after a while."""
        self._told_s = now_s if self._told_s is None else self._told_s
        if standing:
            self.clock.rested(now_s)
        return standing or not (now_s - self._told_s <= SEEN_S)

    def result(self, outcome: str, commanded_mm: Array, cause: Exception | None) -> MoveResult:
        """How it ended, with the times of its stop."""
        recorded = self.recorder.result(outcome, self.playback.path_time_s, commanded_mm, cause)
        return replace(recorded, stop=self.clock.times())
