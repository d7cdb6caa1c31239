"""One running move of queued segments: what the controllers were told about it, what it ends with."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field, replace
from enum import Enum

from docking.motion.playback import Playback
from docking.motion.recorder import Recorder
from docking.motion.stop_clock import StopClock
from docking.types import Array, Feedback, MoveResult

END_S = 1e-6


class Phase(Enum):
    """What the controllers were last told about a move."""

    LOADED = 1
    RUNNING = 2
    HOLDING = 3


@dataclass(eq=False)
class QueuedMove:
    """A running move. `done` gets its result; `held`: the operator holds it."""

    playback: Playback
    recorder: Recorder
    done: asyncio.Future[MoveResult]
    clock: StopClock = field(default_factory=StopClock)
    held: bool = False
    phase: Phase = Phase.LOADED

    def ended(self, feedback: Feedback) -> bool:
        """Whether the controllers have played the last segment."""
        return feedback.path_time_s >= self.playback.plan.duration_s - END_S

    def result(self, outcome: str, path_time_s: float, commanded_mm: Array, cause: Exception | None) -> MoveResult:
        """How it ended, with the times of its stop."""
        recorded = self.recorder.result(outcome, path_time_s, commanded_mm, cause)
        return replace(recorded, stop=self.clock.times())

    def fail(self, error: Exception) -> None:
        """Whoever waits for the move learns why nobody goes on with it."""
        if not self.done.done():
            self.done.set_exception(error)
