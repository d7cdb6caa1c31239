"""Axes that hold a force: their frames, and the way from the force that they carry to the one that they shall hold."""

from __future__ import annotations

import math

import numpy as np

from docking.ports import CanFrame
from drivers.canopen.nodes import AxisNode
from drivers.maps.objects import ObjectMap, PdoEntry


def pdo_dtype(pdo: PdoEntry) -> np.dtype[np.void]:
    """The content of a PDO as a packed little-endian record."""
    return np.dtype([(name, f"<{kind[0]}{int(kind[1:]) // 8}") for name, kind in pdo.fields])


class ForceImage:
    """What the force-controlled axes are sent each cycle. `indices` are their places in the cell's axis order.

    An axis that does not press yet is told to press as hard as its load cell says that it does: it takes the load over
    without a step. From then on its target runs to the held force at the map's rate.
    """

    def __init__(self, nodes: tuple[AxisNode, ...], omap: ObjectMap, cycle_s: float) -> None:
        mode, pdo = omap.force_mode, omap.pdos["force_set_points"]
        held = [(node, node.force_n) for node in nodes if node.force_n is not None]
        self.indices = [node.index for node, _ in held]
        self.cobs = [pdo.cob + node.node for node, _ in held]
        self._held_n = [force_n for _, force_n in held]
        self._target_n = [0.0] * len(held)
        self._cycle_s, self._step_n = cycle_s, mode.ramp_n_s * cycle_s
        self._newton_per_count = mode.newton_per_count
        self._image = np.zeros(len(held), pdo_dtype(pdo))
        self._image["mode"] = mode.mode

    def command(self, index: int, controlword: int) -> None:
        """Set the controlword of one axis."""
        self._image["controlword"][self.indices.index(index)] = controlword

    def command_all(self, controlword: int) -> None:
        """Set the controlword of every axis."""
        self._image["controlword"] = controlword

    def lead(self, index: int, carried_n: float, pressing: bool) -> None:
        """One cycle on for one axis that carries `carried_n` (NaN: not known) and presses or not yet."""
        row = self.indices.index(index)
        held, target = self._held_n[row], self._target_n[row]
        if pressing:
            target += min(max(held - target, -self._step_n), self._step_n)
        else:
            target = 0.0 if math.isnan(carried_n) else max(carried_n, 0.0)
        self._target_n[row] = target
        self._image["target_torque"][row] = round(target / self._newton_per_count)

    def longest_s(self) -> float:
        """How long the targets still need to the forces that shall be held, at most."""
        gaps = [abs(held - target) for held, target in zip(self._held_n, self._target_n, strict=True)]
        return max(gaps, default=0.0) / self._step_n * self._cycle_s

    def arrived(self, index: int) -> bool:
        """True when the target of one axis is the force that it shall hold."""
        row = self.indices.index(index)
        return self._target_n[row] == self._held_n[row]

    def frames(self) -> list[CanFrame]:
        """One frame an axis."""
        return [(cob, row.tobytes()) for cob, row in zip(self.cobs, self._image, strict=True)]
