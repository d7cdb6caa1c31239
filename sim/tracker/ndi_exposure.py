"""One exposure of the simulated camera and its text form, with the rounding of the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
ANGLE_NOISE_RAD = 2e-4


class Scene(Protocol):
    """What stands before the camera, in its own frame."""

    def tools_T(self, t_s: float) -> dict[str, tuple[Array, Array]]:
        """Tool -> (rotation (3, 3), origin (3,) mm)."""
        ...

    def strays_T_mm(self, t_s: float) -> Array:
        """Markers outside tools (n, 3)."""
        ...


@dataclass(frozen=True)
class Seen:
    """A tool as measured: unit quaternion (4,) w x y z, origin (3,) mm, residual mm."""

    turn: Array
    p_mm: Array
    error_mm: float


@dataclass(frozen=True)
class Exposure:
    """What one exposure holds."""

    number: int
    tools: dict[str, Seen]
    strays_mm: list[Array]


def expose(scene: Scene, number: int, t_s: float, noise_mm: float, seed: int) -> Exposure:
    """Exposure `number` of the scene at loop time `t_s`; its noise is drawn from seed and number alone."""
    rng = np.random.default_rng([seed, number])
    tools = {}
    for name, (rotation, p_mm) in scene.tools_T(t_s).items():
        wobble = Rotation.from_rotvec(rng.standard_normal(3) * ANGLE_NOISE_RAD * min(1.0, noise_mm / 0.05))
        x, y, z, w = (wobble * Rotation.from_matrix(rotation)).as_quat()
        turn = np.array([w, x, y, z]) * (1.0 if w >= 0.0 else -1.0)
        tools[name] = Seen(turn, p_mm + noise_mm * rng.standard_normal(3), abs(float(rng.normal(0.0, noise_mm))))
    strays = [row + noise_mm * rng.standard_normal(3) for row in scene.strays_T_mm(t_s)]
    return Exposure(number, tools, strays)


def tool_text(seen: Seen) -> str:
    """51 characters: quaternion in ten-thousandths, place in hundredths of a millimetre, residual."""
    turn = "".join(f"{round(float(v) * 1e4):+06d}" for v in seen.turn)
    place = "".join(f"{round(float(v) * 1e2):+07d}" for v in seen.p_mm)
    return turn + place + f"{round(seen.error_mm * 1e4):+06d}"


def stray_text(strays_mm: list[Array]) -> str:
    """Number, out-of-volume flags (none), places."""
    flags = "0" * ((len(strays_mm) + 3) // 4)
    return f"{len(strays_mm):02X}{flags}" + "".join(f"{round(float(v) * 1e2):+07d}" for p in strays_mm for v in p)
