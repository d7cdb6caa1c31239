"""Whether a PLC and the link to it are alive, judged by what its polls show."""

from __future__ import annotations

from collections import deque

LAG_CYCLES = 3


class PlcWatch:
    """What the last polls of one PLC showed: lost replies and both heartbeats."""

    def __init__(self, scan_s: float) -> None:
        self.misses = 0
        self._scan_s, self._looked_s = scan_s, float("-inf")
        self._sent: deque[int] = deque(maxlen=LAG_CYCLES)
        self._alive = -1
        self._still = 0

    @property
    def age(self) -> int:
        """Polls since this PLC last showed anything that is not old."""
        return self.misses + self._still

    def complaint(self, sent: int, echo: int, alive: int, now_s: float) -> str:
        """Why the PLC or the link is not alive after this poll; empty when all is well."""
        oldest = self._sent[0] if len(self._sent) == LAG_CYCLES else echo
        self._sent.append(sent)
        if alive != self._alive:
            self._still, self._alive, self._looked_s = 0, alive, now_s
        elif now_s - self._looked_s >= 2.0 * self._scan_s:
            # Two polls in one scan rightly show the same number.
            self._still, self._looked_s = self._still + 1, now_s
        if (echo - oldest) & 0x8000:
            return f"the echo of the heartbeat lags more than {LAG_CYCLES} cycles"
        if self._still > LAG_CYCLES:
            return f"the heartbeat of the PLC stood still for {self._still} cycles"
        return ""
