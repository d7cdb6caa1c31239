"""[Zhao]: points of a moving body followed through occlusion by image, inertial sensor and encoders."""

from docking.tracking.types import BodyModel, InertialModel, Start, TrackedState, Tracker

__all__ = ["BodyModel", "InertialModel", "Start", "TrackedState", "Tracker"]
