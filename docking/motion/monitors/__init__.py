"""What is watched in every cycle. Every comparison is written so that NaN trips it."""

from docking.motion.monitors.build import watch_from
from docking.motion.monitors.limits import Timing, WatchLimits
from docking.motion.monitors.watch import Watch

__all__ = ["Timing", "Watch", "WatchLimits", "watch_from"]
