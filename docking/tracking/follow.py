"""A recording followed by a method, with gaps: what `docking track` answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from docking.errors import BadArgument, DockingError
from docking.tracking.choice import Choice, choose
from docking.tracking.encoders import EncoderTracker
from docking.tracking.grades import GRADES
from docking.tracking.inertial import InertialSettings, InertialTracker
from docking.tracking.inertial_core import Extras
from docking.tracking.published import CoupledTracker, PublishedTracker
from docking.tracking.recording import Gap, Recording
from docking.tracking.repaired import RepairedTracker
from docking.tracking.replay import GapResult, Path, hidden, judged, play, smoothed_path, start_of
from docking.tracking.smoothing import Tape
from docking.tracking.time_offset import find_time_offset, image_attitudes
from docking.tracking.types import InertialModel, Tracker
from docking.tracking.zero_velocity import ZeroVelocity

LEAST_UP = 0.7
"""Cosine of the largest angle between the mean specific force and the vertical: what moves and stops was pushed against
gravity in the mean."""
METHODS = ("published", "repaired", "ins", "ins-smoothed", "encoders", "auto")


@dataclass(frozen=True)
class FollowSettings:
    """`rest`: whether a quiet inertial sensor may mean rest. `time_offset`: whether the lag of its stamps is looked for
    first. `extras`: what the navigation estimates beyond its fifteen states."""

    method: str = "auto"
    model: InertialModel = GRADES["consumer"]
    rest: bool = True
    time_offset: bool = True
    extras: Extras = field(default_factory=lambda: Extras(0.005, 0.01, 0.01, 30.0))


@dataclass(frozen=True, eq=False)
class Followed:
    """The answer: the recording as it was used, the path, the gaps, the choice of `auto`, the lag of the inertial
    stamps, the alarms in the order in which they came."""

    recording: Recording
    method: str
    path: Path
    gaps: list[GapResult]
    choice: Choice | None
    time_offset_s: float
    alarms: list[DockingError]

    def as_json(self) -> dict[str, Any]:
        """The object of `docking track --json`."""
        return {
            "method": self.method,
            "choice": None if self.choice is None else self.choice.as_json(),
            "gaps": [vars(gap) for gap in self.gaps],
            **summary(self.gaps),
            "time_offset_s": self.time_offset_s,
            "frames": len(self.path.t_s),
            "alarms": [{"code": e.code, "message": e.text()} for e in self.alarms],
        }


def summary(gaps: Sequence[GapResult]) -> dict[str, float | None]:
    """Median and 90 % of the errors at the ends, None without gaps."""
    if not gaps:
        return {"median_end_error_mm": None, "p90_end_error_mm": None, "median_hold_last_mm": None}
    end, hold = [g.end_error_mm for g in gaps], [g.hold_last_mm for g in gaps]
    return {
        "median_end_error_mm": float(np.median(end)),
        "p90_end_error_mm": float(np.quantile(end, 0.9)),
        "median_hold_last_mm": float(np.median(hold)),
    }


def follow(recording: Recording, gaps: Sequence[Gap], settings: FollowSettings) -> Followed:
    """Run the recording through the method. Raises BadArgument where it lacks what the method needs."""
    _check(recording, settings.method)
    inertial = len(recording.imu_t_s) > 0
    late = find_time_offset(recording).late_s if inertial and settings.time_offset else 0.0
    used = replace(recording, imu_t_s=recording.imu_t_s - late)
    if inertial:
        _check_upright(used)
    choice, method = None, settings.method
    if method == "auto":
        longest = max((gap.length_s for gap in gaps), default=3.0)
        choice = choose(used, settings.model, longest)
        method = choice.method
    hide, alarms = hidden(used, gaps), list[DockingError]()
    tracker = make_tracker(used, method, settings)
    path = play(used, tracker, hide, alarms.append)
    if isinstance(tracker, InertialTracker):
        # With stamps put right, what the filter still finds is the sensor's own: its forces lag less than its rates.
        late = late or tracker.late_s()
        if method == "ins-smoothed":
            path = smoothed_path(used, tracker, path)
    return Followed(used, method, path, judged(used, path, gaps, hide), choice, late, alarms)


def make_tracker(recording: Recording, method: str, settings: FollowSettings, tilt_sd_rad: float = 0.01) -> Tracker:
    """The tracker of a method, started as the recording says."""
    body, model, start = recording.body, settings.model, start_of(recording, tilt_sd_rad, heading_sd_rad=0.02)
    if method == "encoders":
        return EncoderTracker(body)
    if method == "published":
        return PublishedTracker(body, model, start)
    if method == "coupled":
        return CoupledTracker(body, model, start)
    if method == "repaired":
        return RepairedTracker(body, model, start)
    rest = ZeroVelocity() if settings.rest else None
    chosen = InertialSettings(extras=settings.extras, zero_velocity=rest)
    if not body.points_B_mm.any():  # one point without nominal place: nobody has stated a lever arm
        chosen = replace(chosen, lever_limit_mm=float("inf"))
    return InertialTracker(body, model, start, chosen, Tape() if method == "ins-smoothed" else None)


def _check(recording: Recording, method: str) -> None:
    if method not in METHODS and method != "coupled":
        raise BadArgument("--method", f"choose one of {', '.join(METHODS)}", value=method)
    if method == "encoders" and len(recording.encoder_t_s) == 0:
        raise BadArgument("--method", "the recording has no encoders", value=method)
    if method not in ("encoders", "auto") and len(recording.imu_t_s) == 0:
        raise BadArgument("--method", "the recording has no inertial samples", value=method)
    if len(recording.imu_t_s) == 0 and len(recording.encoder_t_s) == 0:
        raise BadArgument(recording.name, "neither inertial samples nor encoders: nothing bridges a gap")


def _check_upright(recording: Recording) -> None:
    """Raises BadArgument where the specific force, turned by the attitudes that the image shows, does not point up: its
    sign or its axes are not those that the header states."""
    R, t = image_attitudes(recording), recording.frame_t_s
    known = np.isfinite(R).all(axis=(1, 2)) & (t >= recording.imu_t_s.min()) & (t <= recording.imu_t_s.max())
    if not known.any():
        return
    force = np.column_stack([np.interp(t[known], recording.imu_t_s, axis) for axis in recording.force_m_s2.T])
    mean = np.einsum("mij,jk,mk->i", R[known], recording.body.X_BI.R, force) / int(known.sum())
    if not (mean[2] >= LEAST_UP * float(np.linalg.norm(mean))):
        told = ", ".join(f"{value:.2f}" for value in mean)
        cause = "turned into W the mean specific force does not point up: its sign or axes are others than stated"
        raise BadArgument(recording.name, cause, value=f"({told}) m/s^2")
