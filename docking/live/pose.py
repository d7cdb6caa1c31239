"""The part followed through one move: what arrives is pushed in, `look` says whether the move may go on.

At rest before the move the camera is brought into W by the points it sees: the pose by the read-backs is the reference.
Then every frame, once the read-backs have passed it, gives a pose of its own, which is compared with the plan's, and
goes to the tracker, which carries the pose through occlusion.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from docking.errors import DockingError, LiveDeviation, PoseUncertain
from docking.kinematics import pose_from_axes
from docking.live.planned import PlannedPoses, ReadBacks
from docking.live.seen import Noise, SeenPoints, seen_points
from docking.live.settings import LiveSettings, tracker_at_rest
from docking.pose.batch import fit_poses
from docking.sightings import InertialSample, PointFrame
from docking.tracking.faults import Alarms, FrameWatch, WatchSettings, swapped
from docking.tracking.types import TrackedState, Tracker
from docking.types import Array, Feedback, Plan, Pose

FOR_A_POSE = 3
LEAST_FRAMES = 3
STALE_S = 0.5
"""Read-backs older than this bridge nothing."""
RESTING_MM = 1e-3
SAME_FRAMES = 3
"""Frames that repeat each other to the last digit while the axes move: before they pass for a deviation."""
BAD_POINT_SIGMAS = 6.0
WHERE = "live pose"


@dataclass
class LiveFigures:
    """Largest of a move: deviation from the plan (mm; `last_mm` of the newest frame), predicted sd (mm), time without a
    seen point (s); frames used and of those left out."""

    deviation_mm: float = 0.0
    last_mm: float = 0.0
    predicted_sd_mm: float = 0.0
    blind_s: float = 0.0
    frames: int = 0
    ignored: int = 0


class LivePose:
    """One move of the part. Times are loop times; `look` is asked some times a second."""

    def __init__(self, settings: LiveSettings) -> None:
        self._s, self._body = settings, settings.body
        self.figures = LiveFigures()
        self.tracker: Tracker | None = None
        self.error: DockingError | None = None
        self._noise = Noise(settings.sigma_mm, settings.match_mm)
        self._read_backs = ReadBacks()
        self._waiting: deque[PointFrame] = deque()
        self._samples: deque[InertialSample] = deque(maxlen=4000)
        self._planned: PlannedPoses | None = None
        self._X_WT = settings.X_WT
        self._alarms, self._told = Alarms(), set[type[DockingError]]()
        self._frames = FrameWatch(self._body, WatchSettings(same_frames=SAME_FRAMES), self._alarms)
        self._over = 0
        self._used_s = float("nan")
        self._q_before: Array | None = None

    # what arrives ----------------------------------------------------------------------------------------------------
    def read_back(self, feedback: Feedback) -> None:
        """Where the axes stand."""
        self.axes(feedback.t_s, feedback.position_mm)

    def axes(self, t_s: float, q_mm: Array) -> None:
        """Axis positions (m,) at `t_s`."""
        with self._guarded():
            if self._read_backs.add(t_s, q_mm) and self.tracker is not None:
                self.tracker.encoders(t_s, pose_from_axes(self._s.positioners, q_mm))
                self._take_waiting()

    def frame(self, frame: PointFrame) -> None:
        """What the camera sees; it waits until the read-backs have passed it."""
        self._waiting.append(frame)
        if self.tracker is not None:
            with self._guarded():
                self._take_waiting()

    def sample(self, sample: InertialSample) -> None:
        """What the inertial sensor feels; it waits as frames do, so that everything is told in the order of time."""
        self._samples.append(sample)
        if self.tracker is not None:
            with self._guarded():
                self._take_waiting()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Whatever this calculation dies of ends the move, never the driver or the channel that calls it."""
        try:
            yield
        except DockingError as error:
            self._fail(PoseUncertain(WHERE, error.text(), value="nothing", limit="a pose"))
        except Exception as error:  # noqa: BLE001 - a defect here must not leave a move unwatched
            self._fail(PoseUncertain(WHERE, f"{type(error).__name__}: {error}", value="nothing", limit="a pose"))

    # the beginning ---------------------------------------------------------------------------------------------------
    def begin(self, plan: Plan | None) -> None:
        """At rest: bring the camera into W, begin to follow. Raises PoseUncertain where too little is seen."""
        if self._read_backs.newest_s == float("-inf"):
            raise PoseUncertain(WHERE, "no read-back came", value="nothing", limit="1 read-back")
        q_mm = self._read_backs.at(self._read_backs.newest_s)
        X_WC = pose_from_axes(self._s.positioners, q_mm)
        self._X_WT = self._camera_at(X_WC)
        self._planned = PlannedPoses(plan, self._s.positioners) if plan is not None else None
        self.tracker = tracker_at_rest(self._s, X_WC)
        first_s = self._waiting[0].t_s - self._s.delay_s
        self.tracker.encoders(min(first_s, self._read_backs.newest_s) - 1e-3, X_WC)
        self.tracker.encoders(self._read_backs.newest_s, X_WC)
        self._take_waiting()

    def _camera_at(self, X_WC: Pose) -> Pose:
        """X_WT from the mean of what was seen at rest, with the part at `X_WC`."""
        expected_T = self._s.X_WT.inverse().apply(X_WC.apply(self._body.points_B_mm))
        places: dict[int, list[Array]] = {}
        for frame in self._waiting:
            seen = seen_points(frame, self._body, self._s.tools, expected_T, self._noise)
            for row, p in zip(seen.rows, seen.xyz_mm, strict=True):
                places.setdefault(int(row), []).append(p)
        rows = [i for i, seen_at in sorted(places.items()) if len(seen_at) >= LEAST_FRAMES]
        if len(rows) < FOR_A_POSE:
            counts = f"{len(self._waiting)} frames show {len(rows)} points of the part"
            raise PoseUncertain(WHERE, counts, value=len(rows), limit=f"{FOR_A_POSE} points in {LEAST_FRAMES} frames")
        means = np.array([np.mean(places[i], axis=0) for i in rows])
        fitted = fit_poses(means, X_WC.apply(self._body.points_B_mm[rows])[None])
        return Pose(fitted.R[0], fitted.t_mm[0])

    # frames ----------------------------------------------------------------------------------------------------------
    def _take_waiting(self) -> None:
        until_s = self._read_backs.newest_s
        while self._waiting and self._waiting[0].t_s - self._s.delay_s <= until_s:
            frame = self._waiting.popleft()
            self._feel(frame.t_s - self._s.delay_s)
            self._take(frame)
        self._feel(until_s)

    def _feel(self, until_s: float) -> None:
        assert self.tracker is not None
        while self._samples and self._samples[0].t_s <= until_s:
            sample = self._samples.popleft()
            self.tracker.imu(sample.t_s, sample.force_m_s2, sample.rate_rad_s)

    def _take(self, frame: PointFrame) -> None:
        assert self.tracker is not None
        t_s = frame.t_s - self._s.delay_s
        q_mm = self._read_backs.at(t_s)
        X_plan = self._planned.at(q_mm) if self._planned is not None else pose_from_axes(self._s.positioners, q_mm)
        expected_W = X_plan.apply(self._body.points_B_mm)
        to_T = self._X_WT.inverse()
        in_T = seen_points(frame, self._body, self._s.tools, to_T.apply(expected_W), self._noise)
        seen = in_T.moved(self._X_WT)
        before, self._q_before = self._q_before, q_mm
        resting = before is None or float(np.abs(q_mm - before).max()) <= RESTING_MM
        if self._frames.frozen(seen.xyz_mm, resting):
            seen = seen.without({int(row) for row in seen.rows})
        pairs = swapped(expected_W[seen.rows], seen.xyz_mm, self._s.match_mm)
        named = [(int(seen.rows[i]), int(seen.rows[j])) for i, j in pairs]
        self._frames.tell_swapped(self._body.names, named)
        seen, X_seen = self._agreeing(seen.without({i for pair in named for i in pair}))
        self.tracker.points(t_s, tuple(self._body.names[i] for i in seen.rows), seen.xyz_mm, seen.cov_mm2)
        if len(seen.rows) == 0:
            self.figures.ignored += 1
            return
        self._used_s = t_s
        self.figures.frames += 1
        self._compare(seen, X_seen, X_plan)

    def _agreeing(self, seen: SeenPoints) -> tuple[SeenPoints, Pose | None]:
        """The points that lie where the others have the part, without another marker or a reflection, and the part's
        pose by them; None for the pose where they are too few."""
        while len(seen.rows) >= FOR_A_POSE:
            nominal = self._body.points_B_mm[seen.rows]
            sigma_mm = np.sqrt(np.linalg.eigvalsh(seen.cov_mm2)[:, -1])
            fitted = fit_poses(nominal, seen.xyz_mm[None], sigma_mm**-2)
            X_seen = Pose(fitted.R[0], fitted.t_mm[0])
            gaps = np.linalg.norm(seen.xyz_mm - X_seen.apply(nominal), axis=1)
            worst = int(np.argmax(gaps))
            if len(gaps) == FOR_A_POSE or gaps[worst] <= BAD_POINT_SIGMAS * sigma_mm[worst]:
                return seen, X_seen
            seen = seen.without({int(seen.rows[worst])})
        return seen, None

    def _compare(self, seen: SeenPoints, X_seen: Pose | None, X_plan: Pose) -> None:
        """Deviation of the pose that this frame shows from the plan's, at the features; of too few points, at these."""
        if X_seen is not None:
            apart = X_seen.apply(self._s.features_C_mm) - X_plan.apply(self._s.features_C_mm)
            names = self._s.feature_names
        else:
            apart = seen.xyz_mm - X_plan.apply(self._body.points_B_mm[seen.rows])
            names = tuple(self._body.names[i] for i in seen.rows)
        sizes = np.linalg.norm(apart, axis=1)
        worst = int(np.argmax(sizes))
        self.figures.last_mm = float(sizes[worst])
        self._over = 0 if sizes[worst] <= self._s.deviation_mm else self._over + 1
        if self._over < self._s.frames:
            # A single frame may err; what stands in so many in a row is what the part did.
            self.figures.deviation_mm = max(self.figures.deviation_mm, float(sizes[worst]) if not self._over else 0.0)
            return
        self.figures.deviation_mm = max(self.figures.deviation_mm, float(sizes[worst]))
        if self._planned is not None:
            shift = ", ".join(f"{v:+.3f}" for v in apart[worst])
            cause = f"By ({shift}) mm in W, in {self._over} frames running."
            self._fail(LiveDeviation(names[worst], cause, value=float(sizes[worst]), limit=self._s.deviation_mm))

    # the verdict -----------------------------------------------------------------------------------------------------
    def state(self) -> TrackedState | None:
        """The pose at the newest instant that read-backs, samples and frames have reached."""
        return self.tracker.state() if self.tracker is not None else None

    def look(self, now_s: float) -> DockingError | None:
        """Why the move may not go on, LiveDeviation or PoseUncertain; None while it may."""
        with self._guarded():
            self._judge(now_s)
        return self.error

    def _judge(self, now_s: float) -> None:
        state = self.state()
        if state is None or self.error is not None:
            return
        blind_s = now_s - self._used_s
        figures, s = self.figures, self._s
        figures.blind_s = max(figures.blind_s, blind_s)
        figures.predicted_sd_mm = max(figures.predicted_sd_mm, state.predicted_sd_mm)
        if not (state.predicted_sd_mm <= s.predicted_sd_mm):
            cause = f"No point has been seen for {blind_s:.2f} s; {self._bridge(state)}."
            self._uncertain(f"{state.predicted_sd_mm:.3f} mm", f"{s.predicted_sd_mm:g} mm", cause)
        elif not (blind_s <= s.blind_s):
            self._uncertain(f"{blind_s:.2f} s without a seen point", f"{s.blind_s:g} s", f"{self._bridge(state)}.")
        elif not (now_s - self._read_backs.newest_s <= STALE_S) and not (blind_s <= STALE_S):
            silent_s = now_s - self._read_backs.newest_s
            self._uncertain(
                f"{silent_s:.2f} s without a read-back or a point", f"{STALE_S:g} s", "All sources are lost."
            )

    def alarms(self) -> list[DockingError]:
        """What was found out about the sources since the last call; each kind is told once a move."""
        found = [*self._alarms.taken(), *(self.tracker.alarms() if self.tracker is not None else [])]
        fresh = []
        for error in found:
            if type(error) not in self._told:
                self._told.add(type(error))
                fresh.append(error)
        return fresh

    def _bridge(self, state: TrackedState) -> str:
        return f"the gap is bridged by {state.source}" if state.source != "image" else "points are seen"

    def _uncertain(self, value: str, limit: str, cause: str) -> None:
        self._fail(PoseUncertain(WHERE, cause, value=value, limit=limit))

    def _fail(self, error: DockingError) -> None:
        self.error = self.error or error
