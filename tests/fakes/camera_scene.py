"""A scene for the simulated camera: two tools at known poses, two markers, all still unless moved."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

ROM_A, ROM_B = b"NDI tool A" + bytes(range(1, 150)), b"NDI tool B" + bytes(range(1, 40))


TURNED: Array = Rotation.from_euler("xyz", (20.0, -35.0, 110.0), degrees=True).as_matrix()


def _tools() -> dict[str, tuple[Array, Array]]:
    return {
        "nose": (TURNED, np.array([-120.5, 33.25, -1850.0])),
        "ring": (np.eye(3), np.array([400.0, -250.75, -2100.5])),
    }


@dataclass
class FakeScene:
    tools: dict[str, tuple[Array, Array]] = field(default_factory=_tools)
    strays: Array = field(default_factory=lambda: np.array([[10.25, -20.5, -1500.0], [-300.0, 250.0, -1999.99]]))
    speed_mm_s: float = 0.0

    def tools_T(self, t_s: float) -> dict[str, tuple[Array, Array]]:
        moved = np.array([self.speed_mm_s * t_s, 0.0, 0.0])
        return {name: (rotation, p + moved) for name, (rotation, p) in self.tools.items()}

    def strays_T_mm(self, t_s: float) -> Array:
        return self.strays
