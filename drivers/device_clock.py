"""The device's clock told in loop time: when a reading was taken, not when it came in. Pure; the caller's clock."""

from __future__ import annotations

import math

DRIFT_LIMIT = 100e-6
"""The two clocks part by no more than this share of the time."""


class DeviceClock:
    """Loop time of the device's zero: the least delay ever seen, relaxed at DRIFT_LIMIT.

    A reading that is late on the line shows a longer delay and leaves the estimate alone, so its age is seen. What no
    reading is spared, the fixed delay of device and line, is not seen.
    """

    def __init__(self) -> None:
        self._zero_s = math.inf
        self._told_s = math.nan

    def loop_s(self, device_s: float, received_s: float) -> float:
        """Loop time at which the device's clock stood at `device_s`, for a reading that came in at `received_s`."""
        relaxed_s = self._zero_s
        if math.isfinite(relaxed_s):
            relaxed_s += DRIFT_LIMIT * (received_s - self._told_s)
        self._zero_s, self._told_s = min(relaxed_s, received_s - device_s), received_s
        return device_s + self._zero_s
