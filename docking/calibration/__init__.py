"""Where things stand: the tracker's station in the assembly frame, and whether it still stands there."""

from docking.calibration.station import MIN_REFERENCES, ReferenceShift, locate_station, reference_shift, to_world

__all__ = ["MIN_REFERENCES", "ReferenceShift", "locate_station", "reference_shift", "to_world"]
