"""The part followed while it moves: camera, inertial sensor and read-backs against the plan."""

from docking.live.motion import LiveListeners, LiveStreams, ReportingMotion, WatchedMotion
from docking.live.settings import LiveSettings

__all__ = ["LiveListeners", "LiveSettings", "LiveStreams", "ReportingMotion", "WatchedMotion"]
