"""What streaming sensors report: frames of a camera, samples of an inertial sensor. Pure nouns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from docking.types import Array


class Sight(Enum):
    """What a camera says of one tool."""

    SEEN = "seen"
    OUTSIDE = "seen, but not wholly inside the volume in which the accuracy holds"
    MISSING = "not seen"
    DISABLED = "not tracked"


@dataclass(frozen=True, eq=False)
class ToolSighting:
    """One tool in the camera's frame T: place of its origin `p_T_mm` (3,), turn as unit quaternion (4,) w x y z,
    residual of its markers `error_mm`; all NaN unless `sight` is SEEN or OUTSIDE. `cov_T_mm2` (3, 3) of its place,
    where the camera can say it."""

    name: str
    sight: Sight
    p_T_mm: Array
    turn: Array
    error_mm: float
    cov_T_mm2: Array | None = None


@dataclass(frozen=True, eq=False)
class PointFrame:
    """One exposure. `t_s` is the loop time at which it was taken, `received_s` at which it came in; `number` rises.

    `strays_T_mm` (n, 3): markers that belong to no tool; `warnings`: what the device complains of, in words.
    """

    number: int
    t_s: float
    received_s: float
    tools: tuple[ToolSighting, ...]
    strays_T_mm: Array
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class InertialSample:
    """Specific force (3,) m/s^2 (at rest: minus gravity) and turning rate (3,) rad/s, in the sensor's own axes.

    `t_s` is the loop time at which it was taken, `received_s` at which it came in, `device_s` the sensor's own clock.
    `attitude_rad` (3,): yaw, pitch, roll as the sensor works them out, NaN where it does not.
    """

    t_s: float
    received_s: float
    device_s: float
    force_m_s2: Array
    rate_rad_s: Array
    attitude_rad: Array
