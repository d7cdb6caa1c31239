"""The plant as a camera and an inertial sensor on the component see it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from docking.config.base import PoseVector
from sim.plant import Plant
from sim.shapes import pose_of

Array = NDArray[np.float64]


class PlantScene:
    """A camera at `camera_pose` (X_W camera) before the plant: `tools` are fixed to the component at its origin, the
    markers outside tools are its reflectors. Satisfies `sim.tracker.ndi_exposure.Scene`."""

    def __init__(self, plant: Plant, camera_pose: PoseVector, tools: tuple[str, ...], markers: tuple[str, ...]) -> None:
        self._plant, self._tools = plant, tools
        self._from_W = pose_of(camera_pose).inverse()
        known = plant.target_names()
        self._rows = [known.index(name) for name in markers]

    def tools_T(self, t_s: float) -> dict[str, tuple[Array, Array]]:
        """Tool -> (rotation (3, 3), origin (3,) mm) in the camera's frame."""
        pose = self._from_W @ self._plant.component_pose_W()
        return dict.fromkeys(self._tools, (pose.R, pose.t_mm))

    def strays_T_mm(self, t_s: float) -> Array:
        """Reflectors (n, 3) in the camera's frame."""
        return self._from_W.apply(self._plant.targets_W_mm(t_s)[self._rows])


def component_pose(plant: Plant, t_s: float) -> tuple[Array, Array]:
    """Rotation (3, 3) and origin (3,) mm of the component in W now."""
    pose = plant.component_pose_W()
    return pose.R, pose.t_mm
