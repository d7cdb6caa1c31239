"""`docking track` with several bodies: each followed by its own sources, and what the joints between them do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import BadArgument
from docking.geometry import pose_to_vector
from docking.recordings import read_bodies
from docking.track_report import gaps_of, settings_of, track_text
from docking.tracking.body import BodyPose, Joined, Joint, body_pose, joined, points_from_pose
from docking.tracking.follow import Followed, FollowSettings, follow
from docking.tracking.recording import Gap, Recording
from docking.tracking.replay import hidden
from docking.tracking.types import TrackedState
from docking.types import Pose

IMAGE = "image"
FOR_A_POSE = 3
Known = TrackedState | BodyPose


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """One body: `known` at the frames (M,) where it is, None elsewhere; `followed` where something bridges its gaps."""

    recording: Recording
    known: tuple[Known | None, ...]
    followed: Followed | None

    @property
    def name(self) -> str:
        return self.recording.body.name

    def as_json(self) -> dict[str, Any]:
        """Poses at the frames where there is one: x, y, z mm, alpha, beta, gamma deg."""
        t = self.recording.frame_t_s
        rows = [(float(t[k]), one) for k, one in enumerate(self.known) if one is not None]
        answer = self.followed.as_json() if self.followed is not None else {"method": IMAGE}
        return {
            "name": self.name,
            **answer,
            "t_s": [at for at, _ in rows],
            "pose": [[float(v) for v in pose_to_vector(one.X_WB)] for _, one in rows],
            "predicted_sd_mm": [_worst_mm(self.recording, one) for _, one in rows],
        }


@dataclass(frozen=True, eq=False)
class JointTrack:
    """What a hinge did: `joined` at times where both bodies are known."""

    first: str
    second: str
    rows: tuple[tuple[float, Joined], ...]

    def as_json(self) -> dict[str, Any]:
        """Angles in deg with their standard deviations, and the pose of the second body in the first."""
        columns = {
            "angle_deg": [one.angle_rad for _, one in self.rows],
            "angle_sd_deg": [one.angle_sd_rad for _, one in self.rows],
            "off_axis_deg": [one.off_axis_rad for _, one in self.rows],
            "off_axis_sd_deg": [one.off_axis_sd_rad for _, one in self.rows],
        }
        return {
            "first": self.first,
            "second": self.second,
            "t_s": [t for t, _ in self.rows],
            **{key: np.degrees(values).tolist() for key, values in columns.items()},
            "pose": [[float(v) for v in pose_to_vector(one.X_AB)] for _, one in self.rows],
        }


@dataclass(frozen=True, eq=False)
class BodiesTracked:
    """The answer for several bodies."""

    bodies: tuple[BodyTrack, ...]
    joints: tuple[JointTrack, ...]

    def as_json(self) -> dict[str, Any]:
        """The object of `docking track --json` with several bodies."""
        return {"bodies": [b.as_json() for b in self.bodies], "joints": [j.as_json() for j in self.joints]}


def run_bodies(files: Sequence[Path], options: Mapping[str, object]) -> BodiesTracked:
    """Read, hide, follow every body, join. Raises FileUnreadable, BadRecording, BadArgument and what trackers raise."""
    settings, sigma_mm = settings_of(options)
    recordings = read_bodies(files, sigma_mm)
    bodies = tuple(_tracked(one, gaps_of(one, options), settings) for one in recordings)
    asked = options.get("joint") or ()
    assert isinstance(asked, tuple)
    return BodiesTracked(bodies, tuple(_joint(str(text), bodies) for text in asked))


def _tracked(recording: Recording, gaps: list[Gap], settings: FollowSettings) -> BodyTrack:
    if len(recording.imu_t_s) == 0 and len(recording.encoder_t_s) == 0:
        return BodyTrack(recording, _by_image(recording, gaps), None)
    followed = follow(recording, gaps, settings)
    known: list[Known | None] = [None] * len(recording.frame_t_s)
    for frame, state in zip(followed.path.frame, followed.path.states, strict=True):
        known[int(frame)] = state
    return BodyTrack(recording, tuple(known), followed)


def _by_image(recording: Recording, gaps: list[Gap]) -> tuple[Known | None, ...]:
    """Frame by frame: nothing bridges what is hidden."""
    seen = recording.seen() & (hidden(recording, gaps) < 0)[:, None]
    known: list[Known | None] = []
    for m, here in enumerate(seen):
        rows = np.flatnonzero(here)
        points, cov = recording.points_W_mm[m], recording.cov_of(m)
        known.append(body_pose(recording.body, points, cov, rows=rows) if len(rows) >= FOR_A_POSE else None)
    return tuple(known)


def _worst_mm(recording: Recording, one: Known) -> float:
    if isinstance(one, TrackedState):
        return one.predicted_sd_mm
    cov = points_from_pose(recording.body, one)[1]
    return float(np.sqrt(np.trace(cov, axis1=1, axis2=2).max()))


def _joint(text: str, bodies: tuple[BodyTrack, ...]) -> JointTrack:
    """A hinge `FIRST:SECOND:AX,AY,AZ`; its angle is 0 where the nominal points of both files have the bodies."""
    first, _, rest = text.partition(":")
    second, _, axis = rest.partition(":")
    named = {body.name: body for body in bodies}
    for name in (first, second):
        if name not in named:
            raise BadArgument("--joint", f"there are the bodies {', '.join(named)}", value=name or text)
    try:
        direction = np.array([float(v) for v in axis.split(",")])
    except ValueError:
        direction = np.zeros(0)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not np.linalg.norm(direction) > 0.0:
        raise BadArgument("--joint", "write FIRST:SECOND:AX,AY,AZ, the axis in the nominal frame", value=text)
    joint = Joint(direction, Pose.identity())
    a, b = named[first], named[second]
    times = a.recording.frame_t_s
    rows = [
        (float(times[k]), joined(one, other, joint))
        for k, (one, other) in enumerate(zip(a.known, b.known, strict=True))
        if one is not None and other is not None
    ]
    return JointTrack(first, second, tuple(rows))


def bodies_text(result: BodiesTracked) -> str:
    """The answer for a person."""
    lines = []
    for body in result.bodies:
        count = sum(one is not None for one in body.known)
        if body.followed is not None:
            lines.append(f"{body.name}: {track_text(body.followed)}")
        else:
            lines.append(f"{body.name}: method {IMAGE}, {count} of {len(body.known)} frames; nothing bridges its gaps")
    for joint in result.joints:
        if not joint.rows:
            lines.append(f"joint {joint.first}:{joint.second}: never are both bodies known")
            continue
        table = joint.as_json()
        lines.append(
            f"joint {joint.first}:{joint.second}: angle {min(table['angle_deg']):.4f} to "
            f"{max(table['angle_deg']):.4f} deg, sd at most {max(table['angle_sd_deg']):.4f}; off its axis at most "
            f"{max(table['off_axis_deg']):.4f} deg, sd {max(table['off_axis_sd_deg']):.4f}"
        )
    return "\n".join(lines)
