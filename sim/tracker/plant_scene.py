"""The plant as a camera and an inertial sensor on the component see it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from docking.config.base import PoseVector
from sim.plant import Plant
from sim.shapes import pose_of
from sim.tracker.vectornav import TO_SENSOR

Array = NDArray[np.float64]
Place = tuple[float, float, float]


class PlantScene:
    """A camera at `camera_pose` (X_W camera) before the plant: `tools` are fixed to the component, each with its origin
    at the place (3,) mm given in the component frame; the markers outside tools are its reflectors. Satisfies
    `sim.tracker.ndi_exposure.Scene`."""

    def __init__(
        self, plant: Plant, camera_pose: PoseVector, tools: Mapping[str, Place], markers: tuple[str, ...]
    ) -> None:
        self._plant = plant
        self._tools = {name: np.array(place) for name, place in tools.items()}
        self._from_W = pose_of(camera_pose).inverse()
        known = plant.target_names()
        self._rows = [known.index(name) for name in markers]

    def tools_T(self, t_s: float) -> dict[str, tuple[Array, Array]]:
        """Tool -> (rotation (3, 3), origin (3,) mm) in the camera's frame."""
        pose = self._from_W @ self._plant.component_pose_W()
        return {name: (pose.R, pose.apply(place)) for name, place in self._tools.items()}

    def strays_T_mm(self, t_s: float) -> Array:
        """Reflectors (n, 3) in the camera's frame."""
        return self._from_W.apply(self._plant.targets_W_mm(t_s)[self._rows])


def mounted_pose(plant: Plant, mount: PoseVector, t_s: float) -> tuple[Array, Array]:
    """Rotation (3, 3) and origin (3,) mm in W, now, of a sensor whose own axes stand at `mount` in the component frame.

    Rotation of the body that the sensor would be level in: its own axes are `TO_SENSOR` of that.
    """
    pose = plant.component_pose_W() @ pose_of(mount)
    return pose.R @ TO_SENSOR.T, pose.t_mm


def points_on_part(plant: Plant, points: Mapping[str, Place], targets: tuple[str, ...], t_s: float) -> dict[str, Array]:
    """Where points (3,) of the component frame and reflectors are in W, by name."""
    pose = plant.component_pose_W()
    known, places = plant.target_names(), plant.targets_W_mm(t_s)
    found: dict[str, Array] = {name: pose.apply(np.array(place)) for name, place in points.items()}
    return found | {name: places[known.index(name)] for name in targets}
