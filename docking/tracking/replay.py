"""A recording run through a tracker, points hidden in gaps, and how far off the tracker was in each.

The hidden positions are the truth; the error is that of the worst hidden point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from docking.errors import DockingError
from docking.tracking.inertial import InertialTracker
from docking.tracking.recording import Gap, Recording
from docking.tracking.types import Start, TrackedState, Tracker
from docking.types import Array, Pose

Mask = NDArray[np.bool_]
MOVED_MM = 5.0
"""A body that strays farther than this within a gap counts as moving where the recording does not say."""


@dataclass(frozen=True)
class GapResult:
    """One gap: errors (mm) at its last frame and the largest within, the predicted 3-D sd at its last frame, and the
    error of holding the last seen position."""

    start_s: float
    length_s: float
    moving: bool
    end_error_mm: float
    max_error_mm: float
    predicted_sd_mm: float
    hold_last_mm: float


@dataclass(frozen=True, eq=False)
class Path:
    """The estimate at every frame from the first used on: times (m,), frame numbers (m,), points (m, n, 3), predicted
    3-D sd (m, n) of every point, and the whole states (m)."""

    t_s: Array
    frame: NDArray[np.intp]
    points_W_mm: Array
    sd_mm: Array
    states: tuple[TrackedState, ...] = ()


def hidden(recording: Recording, gaps: Sequence[Gap]) -> NDArray[np.intp]:
    """(M,): the number of the gap in which each frame lies, -1 outside all."""
    t = recording.frame_t_s - recording.begin_s
    result = np.full(len(t), -1, dtype=np.intp)
    for k, gap in enumerate(gaps):
        result[(t >= gap.start_s) & (t < gap.start_s + gap.length_s)] = k
    return result


def every(recording: Recording, period_s: float, length_s: float) -> list[Gap]:
    """The last `length_s` of every `period_s`, as far as the recording goes."""
    whole = float(recording.frame_t_s[-1]) - recording.begin_s
    count = int(whole / period_s + 1e-9)
    return [Gap((k + 1) * period_s - length_s, length_s) for k in range(count)]


def first_known(recording: Recording) -> int:
    """The first frame at which tracking can begin: a point is seen, inertial samples have begun and, for fewer than
    three points, the attitude is known; the last frame where there is none."""
    seen = recording.seen()
    ready = np.asarray(seen.any(axis=1))
    if len(recording.imu_t_s):
        ready &= recording.frame_t_s >= recording.imu_t_s[0]
    if len(recording.body.names) < 3 and len(recording.imu_t_s):
        ready &= np.isfinite(recording.attitude_WB).all(axis=(1, 2))
    return int(np.argmax(ready)) if ready.any() else len(ready) - 1


def start_of(recording: Recording, tilt_sd_rad: float = 0.01, heading_sd_rad: float = 0.02) -> Start | None:
    """The stated attitude where tracking begins; None where the recording has none."""
    R = recording.attitude_WB[first_known(recording)]
    return Start(R, tilt_sd_rad, heading_sd_rad) if np.isfinite(R).all() else None


def play(
    recording: Recording,
    tracker: Tracker,
    hide: NDArray[np.intp],
    said: Callable[[DockingError], None] = lambda _: None,
) -> Path:
    """Push everything into the tracker in order of time and ask for the state at every frame; alarms go to `said`."""
    begin = first_known(recording)
    seen = recording.seen() & (hide < 0)[:, None]
    names = recording.body.names
    states: list[TrackedState] = []
    frames: list[int] = []
    samples = _Feed(recording, tracker, float(recording.frame_t_s[begin]))
    for m in range(begin, len(recording.frame_t_s)):
        t = float(recording.frame_t_s[m])
        samples.until(t)
        rows = np.flatnonzero(seen[m])
        cov = recording.cov_of(m)[rows]
        tracker.points(t, tuple(names[i] for i in rows), recording.points_W_mm[m, rows], cov)
        samples.past(t)
        state = tracker.state(t)
        for alarm in tracker.alarms():
            said(alarm)
        if state is not None:
            states.append(state)
            frames.append(m)
    return _path(recording, states, frames)


def _path(recording: Recording, states: list[TrackedState], frames: list[int]) -> Path:
    n = len(recording.body.names)
    points = np.array([s.points_W_mm for s in states]).reshape(-1, n, 3)
    sd = np.array([np.sqrt(np.trace(s.point_cov_mm2, axis1=1, axis2=2)) for s in states]).reshape(-1, n)
    at = np.array(frames, dtype=np.intp)
    return Path(recording.frame_t_s[at], at, points, sd, tuple(states))


class _Feed:
    """Pushes inertial samples and read-backs up to given times."""

    def __init__(self, recording: Recording, tracker: Tracker, begin_s: float) -> None:
        self._r, self._tracker = recording, tracker
        self._imu = max(int(np.searchsorted(recording.imu_t_s, begin_s, "right")) - 1, 0)
        self._encoder = max(int(np.searchsorted(recording.encoder_t_s, begin_s, "right")) - 1, 0)

    def until(self, t_s: float) -> None:
        """Everything up to `t_s`."""
        r = self._r
        times = r.imu_t_s
        while self._imu < len(times) and times[self._imu] <= t_s:
            self._sample()
        while self._encoder < len(r.encoder_t_s) and r.encoder_t_s[self._encoder] <= t_s:
            self._read_back()

    def past(self, t_s: float) -> None:
        """One sample and one read-back beyond `t_s`, between which the trackers interpolate."""
        if self._imu < len(self._r.imu_t_s) and (self._imu == 0 or self._r.imu_t_s[self._imu - 1] < t_s):
            self._sample()
        k = self._encoder
        if k < len(self._r.encoder_t_s) and (k == 0 or self._r.encoder_t_s[k - 1] < t_s):
            self._read_back()

    def _sample(self) -> None:
        r, k = self._r, self._imu
        self._tracker.imu(float(r.imu_t_s[k]), r.force_m_s2[k], r.rate_rad_s[k])
        self._imu += 1

    def _read_back(self) -> None:
        r, k = self._r, self._encoder
        self._tracker.encoders(float(r.encoder_t_s[k]), Pose(r.encoder_R[k], r.encoder_t_mm[k]))
        self._encoder += 1


def smoothed_path(recording: Recording, tracker: InertialTracker, causal: Path) -> Path:
    """The path of a tracker that kept its tape, from all data."""
    times, states = tracker.smoothed()
    at = np.clip(np.searchsorted(times, causal.t_s - 1e-9), 0, len(times) - 1)
    return _path(recording, [states(int(k)) for k in at], list(causal.frame))


def judged(recording: Recording, path: Path, gaps: Sequence[Gap], hide: NDArray[np.intp]) -> list[GapResult]:
    """How far off `path` was in every gap that has a frame before it and truth in it."""
    truth, known = recording.points_W_mm, recording.seen()
    result = []
    for k, gap in enumerate(gaps):
        rows = np.flatnonzero((hide[path.frame] == k) & known[path.frame].any(axis=1))
        if len(rows) == 0 or rows[0] == 0:
            continue
        frames = path.frame[rows]
        error = np.linalg.norm(path.points_W_mm[rows] - truth[frames], axis=2)
        last = _last_seen(known & (hide < 0)[:, None], truth, int(frames[0]))
        away = np.linalg.norm(truth[frames] - last, axis=2)
        result.append(
            GapResult(
                gap.start_s,
                gap.length_s,
                _moving(recording, frames, float(np.nanmax(away))),
                float(np.nanmax(error[-1])),
                float(np.nanmax(error)),
                float(path.sd_mm[rows[-1]].max()),
                float(np.nanmax(away[-1])),
            )
        )
    return result


def _last_seen(seen: Mask, truth: Array, before: int) -> Array:
    """Where every point (n, 3) was last seen before a frame."""
    n = seen.shape[1]
    result = np.full((n, 3), np.nan)
    for i in range(n):
        rows = np.flatnonzero(seen[:before, i])
        if len(rows):
            result[i] = truth[rows[-1], i]
    return result


def _moving(recording: Recording, frames: NDArray[np.intp], away_mm: float) -> bool:
    marked = recording.moving[frames]
    if np.isfinite(marked).any():
        return bool(np.nanmax(marked) > 0.0)
    return away_mm > MOVED_MM
