"""When a stop was found necessary, when the commands first showed it, when the axes stood."""

from __future__ import annotations

import math

from docking.motion.reactions import Reaction
from docking.types import StopTimes


class StopClock:
    """Keeps the times of the stop of one move. A fault that comes during a stop that was asked for counts by itself."""

    def __init__(self) -> None:
        self._fault = False
        self._found_s = self._commanded_s = self._rest_s = math.nan

    def follow(self, latched: bool, reaction: Reaction, now_s: float) -> None:
        """The arbiter has decided: `latched` a fault is kept, `reaction` is in force."""
        first_fault = latched and not self._fault
        if first_fault or (reaction >= Reaction.PPS and math.isnan(self._found_s)):
            self._fault, self._found_s, self._commanded_s = latched, now_s, math.nan

    def commanded(self, now_s: float) -> None:
        """Commands that differ for the stop have left; only the first time after the finding counts."""
        if not math.isnan(self._found_s) and math.isnan(self._commanded_s):
            self._commanded_s = now_s

    def rested(self, now_s: float) -> None:
        """The read-backs show all axes at rest."""
        self._rest_s = now_s

    def times(self) -> StopTimes | None:
        """The times so far; None where nothing has asked for a stop."""
        if math.isnan(self._found_s):
            return None
        return StopTimes(self._found_s, self._commanded_s, self._rest_s)
