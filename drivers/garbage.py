"""When a serial line is no longer to be trusted: a rule that all serial drivers share. Pure; the caller's clock."""

from __future__ import annotations

from collections import deque

BAD_LINES_PER_S = 5


class GarbageWatch:
    """More than BAD_LINES_PER_S bad lines within one second: the line cannot be trusted, whatever gets through."""

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=BAD_LINES_PER_S + 1)

    def count(self, bad: int, now_s: float) -> str:
        """Count `bad` more bad lines at `now_s`; what is wrong in words, or nothing."""
        self._at_s.extend([now_s] * min(bad, BAD_LINES_PER_S + 1))
        if bad and len(self._at_s) > BAD_LINES_PER_S and now_s - self._at_s[0] <= 1.0:
            return f"{len(self._at_s)} bad lines within 1 s"
        return ""

    def reset(self) -> None:
        """A fresh session begins."""
        self._at_s.clear()
