"""The nouns of dynamic positioning [Zhao] and the one interface of all its filters, `Tracker`.

Frames: W assembly (Z against gravity), B the moving body (its nominal points are given there), I the inertial sensor,
fixed to B. Lengths mm, times s, angles rad; what inertial sensors say is in m/s^2 and rad/s, as in `sightings`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from docking.errors import DockingError
from docking.types import Array, Pose, _Frozen

GRAVITY_W_MM_S2 = (0.0, 0.0, -9806.65)
MM_PER_M = 1000.0


@dataclass(frozen=True)
class InertialModel:
    """Errors of an inertial sensor, one sigma an axis.

    Densities of white noise: `force_density` m/s^2/sqrt(Hz), `rate_density` rad/s/sqrt(Hz). Biases at switching on:
    `force_bias` m/s^2, `rate_bias` rad/s, and their random walks: `force_walk` m/s^2/sqrt(s), `rate_walk`
    rad/s/sqrt(s). `force_range`, `rate_range`: largest value an axis can show; at it the sensor is saturated.
    `rate_slip` sqrt(s): what of the turning rate is wrong beyond scale and misalignment, as white noise in proportion
    to the rate.
    """

    force_density: float
    rate_density: float
    force_bias: float
    rate_bias: float
    force_walk: float
    rate_walk: float
    force_range: float = 16.0 * 9.80665
    rate_range: float = 2000.0 * 0.017453292519943295
    rate_slip: float = 0.0


@dataclass(frozen=True, eq=False)
class BodyModel(_Frozen):
    """A rigid body with its points of interest.

    `points_B_mm` (n, 3) nominal points in B in the order of `names`, `com_B_mm` (3,) its centre of mass, `X_BI` the
    pose of the inertial sensor's axes in B (its origin is the proof mass; `-X_BI.t_mm` is what one calls lever arm).
    """

    name: str
    names: tuple[str, ...]
    points_B_mm: Array
    com_B_mm: Array = field(default_factory=lambda: np.zeros(3))
    X_BI: Pose = field(default_factory=Pose.identity)


class Start(NamedTuple):
    """What is known when tracking begins: attitude `R_WB` (3, 3) and its sd about the horizontal axes and the vertical
    (rad). Velocity is taken as 0 with `velocity_sd_mm_s`."""

    R_WB: Array
    tilt_sd_rad: float = 0.01
    heading_sd_rad: float = 0.05
    velocity_sd_mm_s: float = 20.0


@dataclass(frozen=True, eq=False)
class TrackedState(_Frozen):
    """Where a body is at `t_s`, and how well that is known.

    `X_WB`; `velocity_W_mm_s` (3,) of the centre of mass; `cov` (6, 6) of the left perturbation [rotation_rad,
    translation_mm] in W about the centre of mass `com_W_mm` (3,), the convention of `docking.types.Fit`: NaN in
    rotation where fewer than three points and no gyroscope give one.
    `points_W_mm` (n, 3) every point of the body, seen or not; `point_cov_mm2` (n, 3, 3). `seen` (n,): in the newest
    frame and used. `attitude_rad` (3,) alpha, beta, gamma of [Luo] with `attitude_sd_rad` (3,).
    `blind_s`: since a point was last used. `source`: "image" while points are used, else what bridges the gap:
    "inertial", "encoders" or "none". `predicted_sd_mm`: sqrt(trace) of the covariance of the worst point, the expected
    3-D error: this is what a monitor compares with its limit.
    """

    t_s: float
    X_WB: Pose
    velocity_W_mm_s: Array
    cov: Array
    com_W_mm: Array
    points_W_mm: Array
    point_cov_mm2: Array
    seen: NDArray[np.bool_]
    attitude_rad: Array
    attitude_sd_rad: Array
    blind_s: float
    source: str
    predicted_sd_mm: float


class Tracker(Protocol):
    """One body followed by one method. Everything is pushed in; nothing waits, reads a clock or keeps a caller.

    Times are those of ONE clock (loop time of the exposure or sample, not of its arrival). Calls may come with unequal
    rates, late and, within `history_s` of the method, out of order: a late frame is worked in at its own time. Older
    ones are dropped and counted.

    A live user pushes every frame and sample as it arrives, asks `state(now)` in each tick, compares
    `predicted_sd_mm` (and `blind_s`) with its limits, and takes `alarms()` out. An alarm is an error of the 30xx band
    (see `docking.tracking.faults`); the tracker stays usable after one, its covariance honest or the alarm standing.
    """

    body: BodyModel
    method: str

    def imu(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """One inertial sample (3,), (3,) in the axes of I: specific force (at rest minus gravity) and turning rate."""
        ...

    def points(self, t_s: float, names: tuple[str, ...], xyz_W_mm: Array, cov_mm2: Array) -> None:
        """One frame: the points that are seen, (k, 3) and (k, 3, 3). Occluded points are left out; an empty frame says
        that nothing is seen. Names that the body does not have raise BadArgument."""
        ...

    def encoders(self, t_s: float, X_WB: Pose) -> None:
        """The body's pose as the positioners' read-backs have it; methods that do not use it take no notice."""
        ...

    def state(self, t_s: float | None = None) -> TrackedState | None:
        """The state at `t_s` (default: the newest event), predicted ahead of the newest data where needed. None until
        the first frame was used."""
        ...

    def alarms(self) -> list[DockingError]:
        """The alarms since the last call, each fault once until it has gone and come again."""
        ...
