"""Simulated CiA 402 drives on a CAN bus, all of a cell in one vectorised group around the plant."""

from sim.canopen.group import DriveGroup
from sim.canopen.settings import DriveSettings

__all__ = ["DriveGroup", "DriveSettings"]
