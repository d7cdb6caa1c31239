"""The motion side: the tick, the monitors, the stops. Talks to the positioners through `docking.ports` only."""

from docking.motion.queued import QueuedMotion
from docking.motion.streamed import StreamedMotion

__all__ = ["QueuedMotion", "StreamedMotion"]
