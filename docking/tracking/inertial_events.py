"""What comes to the inertial navigation, and what it stands at: settings, events, the head of the filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from docking.tracking import inertial_core as core
from docking.tracking.axis_filters import Mask
from docking.tracking.faults import WatchSettings
from docking.tracking.types import BodyModel
from docking.tracking.zero_velocity import ZeroVelocity
from docking.types import Array


@dataclass(frozen=True)
class InertialSettings:
    """`gate`: largest squared Mahalanobis distance of a point's innovation (3 dof). `cov_step_s`: the covariance is
    carried on at least so often. `wait_s`: a frame waits so long for the inertial samples to pass it.
    `blind_force_m_s2`, `blind_rate_rad_s`: what the body may do unnoticed while the inertial sensor is not believed."""

    extras: core.Extras = field(default_factory=core.Extras)
    zero_velocity: ZeroVelocity | None = field(default_factory=ZeroVelocity)
    gate: float = 30.0
    cov_step_s: float = 0.025
    wait_s: float = 0.02
    history_s: float = 1.0
    blind_force_m_s2: float = 5.0
    blind_rate_rad_s: float = 1.0
    lever_limit_mm: float = 10.0
    watch: WatchSettings = field(default_factory=WatchSettings)


class Frame(NamedTuple):
    """Seen points: rows of the body's points, (k, 3) in W, (k, 3, 3)."""

    rows: NDArray[np.intp]
    xyz_mm: Array
    cov_mm2: Array


class Sample(NamedTuple):
    """Specific force mm/s^2 and rate rad/s; `good` where it is believed."""

    force: Array
    rate: Array
    good: bool


class Still(NamedTuple):
    """The body is at rest, and the mean rate that the sensor then shows."""

    rate: Array


Event = Frame | Sample | Still


class Head(NamedTuple):
    """The filter at its time: nominal state, covariance at the last step and what has been summed since."""

    nav: core.Navigation
    cov: Array
    since: core.Since
    C_before: Array
    sample: Sample | None
    seen: Mask
    used_s: float


def between(a: Sample, b: Sample, share: float) -> Sample:
    return Sample(a.force + share * (b.force - a.force), a.rate + share * (b.rate - a.rate), a.good and b.good)


def within(times: list[float], events: list[Event], place: int, t_s: float) -> Sample | None:
    """The sample at `t_s`, between those on both sides of `place`; None where one is missing."""
    before = next((i for i in range(place - 1, -1, -1) if isinstance(events[i], Sample)), None)
    after = next((i for i in range(place, len(events)) if isinstance(events[i], Sample)), None)
    if before is None or after is None:
        return None
    a, b = events[before], events[after]
    assert isinstance(a, Sample)
    assert isinstance(b, Sample)
    return between(a, b, (t_s - times[before]) / (times[after] - times[before]))


def whole(body: BodyModel, frame: Frame) -> tuple[Array, Array]:
    """A frame's points in the rows of the body; the others are not meant to be used."""
    points, cov = np.zeros((len(body.names), 3)), np.tile(np.eye(3), (len(body.names), 1, 1))
    points[frame.rows], cov[frame.rows] = frame.xyz_mm, frame.cov_mm2
    return points, cov
