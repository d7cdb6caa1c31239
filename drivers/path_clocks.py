"""How far apart the path times of controllers are that run on clocks of their own and are never read at one instant.

A read-back shows path time as of the controller's last scan, which began somewhere between one scan before the request
and the answer. So it tells a span in which path time is now; the next read-back meets the scan in another phase and
tells another one, and what both allow is known. Only what lies between the spans of two controllers is certain.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

NAN = float("nan")
STALL_SCANS = 1.5
"""A controller whose scans fall so many behind the time between two read-backs shows an old place, not a late one."""


@dataclass(frozen=True)
class Shown:
    """What one read-back shows: path time, whether it runs at its rate (`running`) or at any (`moving`), the number of
    the scan; asked for and answered at these times of the host."""

    path_time_s: float
    running: bool
    moving: bool
    scans: int
    asked_s: float
    heard_s: float


class PathClock:
    """The span in which the path time of one controller lies.

    A change of the rate takes at most `ramp_s`; clocks differ by at most the fraction `drift`.
    """

    def __init__(self, scan_s: float, ramp_s: float, drift: float) -> None:
        self._scan_s, self._ramp_s, self._drift = scan_s, ramp_s, drift
        self._last: Shown | None = None
        self._running_since_s = float("inf")
        self._low_s = self._high_s = NAN

    def forget(self) -> None:
        """Another plan is played from now on."""
        self._low_s = self._high_s = NAN

    def see(self, shown: Shown, rate: float) -> None:
        """Take a read-back of a controller that plays at most `rate` times as fast as the plan."""
        last, self._last = self._last, shown
        if not shown.running:
            self._running_since_s = float("inf")
        elif self._running_since_s == float("inf"):
            self._running_since_s = shown.heard_s
        behind_s = self._behind_s(last, shown) if last is not None else float("inf")
        if last is None or behind_s > STALL_SCANS * self._scan_s:
            self.forget()
            return
        # What stands still is where it was seen, but for what it may have begun since it was asked.
        old_s = shown.heard_s - shown.asked_s + (self._scan_s + max(0.0, behind_s) if shown.moving else 0.0)
        low, high = shown.path_time_s, shown.path_time_s + rate * old_s
        passed_s = shown.heard_s - last.heard_s
        steady = last.running and last.heard_s - self._running_since_s >= self._ramp_s
        least = rate * (1.0 - self._drift) * passed_s if steady and shown.running else 0.0
        # In this order NaN, as of a plan that was never seen before, gives way.
        kept_low = max(low, self._low_s + least)
        kept_high = min(high, self._high_s + rate * (1.0 + self._drift) * passed_s)
        self._low_s, self._high_s = (kept_low, kept_high) if kept_low <= kept_high else (low, high)

    def _behind_s(self, last: Shown, shown: Shown) -> float:
        """By how much the scans have fallen behind the time since the last read-back."""
        return shown.heard_s - last.heard_s - ((shown.scans - last.scans) & 0xFFFF) * self._scan_s

    def span_s(self, now_s: float, rate: float) -> tuple[float, float]:
        """Least and largest path time now; NaN while nothing is known."""
        since_s = now_s - self._last.heard_s if self._last is not None else NAN
        return self._low_s, self._high_s + rate * since_s


def apart_s(clocks: Iterable[PathClock], now_s: float, rate: float) -> float:
    """By how much path times are apart for certain: the foremost at its least, the last at its most. Never negative."""
    spans = [span for span in (clock.span_s(now_s, rate) for clock in clocks) if span[0] <= span[1]]
    if not spans:
        return 0.0
    return max(0.0, max(low for low, _ in spans) - min(high for _, high in spans))
