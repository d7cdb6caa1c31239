"""Where things stand: one station or several in the assembly frame, and whether they still stand there."""

from docking.calibration.network import Network, View, adjust_network
from docking.calibration.station import MIN_REFERENCES, ReferenceShift, locate_station, reference_shift, to_world

__all__ = [
    "MIN_REFERENCES",
    "Network",
    "ReferenceShift",
    "View",
    "adjust_network",
    "locate_station",
    "reference_shift",
    "to_world",
]
