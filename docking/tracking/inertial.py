"""The 15-state inertial navigation of one body with its points: method `ins`.

Everything that arrives is an event at its own time. The filter stands at the newest event; a late frame takes it back
to the last mark before it, is worked in, and what followed is done again: samples of the last second are kept for this.
A frame is worked in once the inertial samples have passed it, so that the last is interpolated, not extrapolated.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from docking.errors import AttitudeUnknown, BadArgument, DockingError, LeverArmWrong
from docking.tracking import inertial_core as core
from docking.tracking.body import body_pose
from docking.tracking.faults import Alarms, FrameWatch, InertialWatch, swapped
from docking.tracking.inertial_body import body_state, on_time
from docking.tracking.inertial_core import BA, BG, PHI, P, V
from docking.tracking.inertial_events import Event, Frame, Head, InertialSettings, Sample, Still, between, whole, within
from docking.tracking.smoothing import Tape
from docking.tracking.types import MM_PER_M, BodyModel, InertialModel, Start, TrackedState
from docking.tracking.zero_velocity import RestDetector
from docking.types import Array, Pose

Mask = NDArray[np.bool_]
_TRIM = 1024
_SQUARE_EVERY = 512


class InertialTracker:
    """Follows one body; see `docking.tracking.types.Tracker`. With `tape` every step is kept for the smoother."""

    method = "ins"

    def __init__(
        self,
        body: BodyModel,
        model: InertialModel,
        start: Start | None = None,
        settings: InertialSettings | None = None,
        tape: Tape | None = None,
    ) -> None:
        self.body, self._model, self._start = body, model, start
        self._s = settings or InertialSettings()
        self._layout = core.Layout(self._s.extras)
        self._carry = core.Propagation(model, self._layout)
        self._arms_I = (body.points_B_mm - body.X_BI.t_mm) @ body.X_BI.R
        self._index = {name: i for i, name in enumerate(body.names)}
        self._alarms = Alarms()
        self._samples_watch = InertialWatch(model, self._s.watch, self._alarms, f"{body.name} inertial sensor")
        self._frames_watch = FrameWatch(body, self._s.watch, self._alarms)
        self._rest = RestDetector(self._s.zero_velocity, model) if self._s.zero_velocity else None
        self._resting, self._tape, self._steps = False, tape, 0
        self._loud_s = float("inf")
        self._head: Head | None = None
        self._times: list[float] = []
        self._events: list[Event] = []
        self._marks: list[Head] = []
        self._waiting: list[tuple[float, Frame]] = []
        self._newest: tuple[float, Sample] | None = None
        self.dropped = 0

    def imu(self, t_s: float, force_m_s2: Array, rate_rad_s: Array) -> None:
        """One sample; see `Tracker.imu`."""
        good = self._samples_watch.good(t_s, force_m_s2, rate_rad_s)
        if self._newest is not None and not (t_s > self._newest[0]):
            self.dropped += 1
            return
        sample = Sample(force_m_s2 * MM_PER_M, rate_rad_s, good)
        before, self._newest = self._newest, (t_s, sample)
        while self._waiting and self._waiting[0][0] <= t_s:
            at, frame = self._waiting.pop(0)
            if before is not None and self._head is not None and before[0] < at < t_s:
                share = (at - before[0]) / (t_s - before[0])
                self._add(at, between(before[1], sample, share))
            self._add(at, frame)
        if self._head is None:
            return
        self._add(t_s, sample)
        if self._rest is not None:
            quiet = self._rest.sample(t_s, force_m_s2, rate_rad_s) if good else False
            self._resting = self._resting if quiet is None else quiet
            if quiet is False or self._loud_s > t_s:
                self._loud_s = t_s
            if quiet and self._s.zero_velocity and t_s - self._loud_s >= self._s.zero_velocity.sure_s:
                self._add(t_s, Still(self._rest.rate_rad_s))

    def points(self, t_s: float, names: tuple[str, ...], xyz_W_mm: Array, cov_mm2: Array) -> None:
        """One frame; see `Tracker.points`."""
        try:
            rows = np.array([self._index[name] for name in names], dtype=np.intp)
        except KeyError as error:
            raise BadArgument(self.body.name, "no such point", value=str(error.args[0])) from None
        frame = Frame(rows, np.asarray(xyz_W_mm, dtype=np.float64), np.asarray(cov_mm2, dtype=np.float64))
        if self._frames_watch.frozen(frame.xyz_mm, self._resting):
            frame = Frame(rows[:0], frame.xyz_mm[:0], frame.cov_mm2[:0])
        if self._head is None:
            self._begin(t_s, frame)
        elif self._newest is None or t_s > self._newest[0]:
            self._waiting.append((t_s, frame))
            while self._waiting and self._waiting[0][0] < t_s - self._s.wait_s:
                self._add(*self._waiting.pop(0))
        else:
            self._add(t_s, frame)

    def encoders(self, t_s: float, X_WB: Pose) -> None:
        """Not used by this method."""

    def alarms(self) -> list[DockingError]:
        """See `Tracker.alarms`."""
        return self._alarms.taken()

    def _begin(self, t_s: float, frame: Frame) -> None:
        """The first frame gives position and, with three points and no stated start, attitude."""
        if len(frame.rows) == 0:
            return
        C, turn_cov = self._attitude_at_start(frame)
        s = self._s.extras
        at = frame.rows[0]
        zero = np.zeros(3)
        p = frame.xyz_mm[0] - C @ self._arms_I[at]
        square = np.zeros((3, 3))
        nav = core.Navigation(t_s, p, zero, C, zero, zero, 0.0, square, square, zero)
        sd = np.zeros(self._layout.size)
        sd[P] = 3.0 * np.sqrt(np.trace(frame.cov_mm2[0])) + np.linalg.norm(self._arms_I[at]) * 0.1 + s.lever_sd_mm
        sd[V] = self._start.velocity_sd_mm_s if self._start else 100.0
        sd[BA], sd[BG] = self._model.force_bias * MM_PER_M, self._model.rate_bias
        for place, value in (
            (self._layout.time, s.time_sd_s),
            (self._layout.scale, s.scale_sd),
            (self._layout.force_scale, s.force_scale_sd),
            (self._layout.lever, s.lever_sd_mm),
        ):
            if place is not None:
                sd[place] = value
        cov = np.diag(sd**2)
        cov[PHI, PHI] = turn_cov
        seen = np.zeros(len(self.body.names), dtype=bool)
        self._times, self._events = [], []
        self._head = Head(nav, cov, core.NOTHING, C, None, seen, t_s)
        self._marks = [self._head]
        if self._tape is not None:
            self._tape.begin(nav, cov)
        self._add(t_s, frame)

    def _attitude_at_start(self, frame: Frame) -> tuple[Array, Array]:
        if self._start is not None:
            tilt, heading = self._start.tilt_sd_rad**2, self._start.heading_sd_rad**2
            return self._start.R_WB @ self.body.X_BI.R, np.diag([tilt, tilt, heading])
        if len(frame.rows) < 3:
            raise AttitudeUnknown(self.body.name, f"the first frame has {len(frame.rows)} points")
        pose = body_pose(self.body, *whole(self.body, frame), rows=frame.rows)
        return pose.X_WB.R @ self.body.X_BI.R, 4.0 * pose.cov[:3, :3]

    # events ----------------------------------------------------------------------------------------------------------
    def _add(self, t_s: float, event: Event) -> None:
        """Keep the event in order of time and do it, going back where it is late."""
        head = self._head
        assert head is not None
        place = bisect_right(self._times, t_s)
        if t_s >= head.nav.t_s and place == len(self._times):
            self._times.append(t_s)
            self._events.append(event)
            self._do(t_s, event)
            self._trim()
            return
        mark = len(self._marks) - 1
        while mark >= 0 and self._marks[mark].nav.t_s >= t_s:
            mark -= 1
        if mark < 0:
            self.dropped += 1
            return
        between = within(self._times, self._events, place, t_s) if isinstance(event, Frame) else None
        for late in (event,) if between is None else (event, between):
            self._times.insert(place, t_s)
            self._events.insert(place, late)
        self._go_back(self._marks[mark])
        del self._marks[mark + 1 :]
        for k in range(bisect_right(self._times, self._marks[mark].nav.t_s), len(self._times)):
            self._do(self._times[k], self._events[k])

    def _go_back(self, mark: Head) -> None:
        self._head = mark
        if self._tape is not None:
            self._tape.back_to(mark.nav.t_s)

    def _trim(self) -> None:
        if len(self._times) > 2 * _TRIM and self._times[_TRIM] < self._times[-1] - self._s.history_s:
            del self._times[:_TRIM], self._events[:_TRIM]
            first = 0
            while first + 1 < len(self._marks) and self._marks[first + 1].nav.t_s < self._times[0]:
                first += 1
            del self._marks[:first]

    def _do(self, t_s: float, event: Event) -> None:
        head = self._head
        assert head is not None
        if isinstance(event, Sample):
            self._head = head = self._advanced(head, t_s, event)
            if head.since.dt_s >= self._s.cov_step_s:
                self._mark()
            return
        if t_s > head.nav.t_s:
            self._head = self._advanced(head, t_s, self._held(head, t_s))
        self._mark()
        if isinstance(event, Frame):
            self._take_frame(event)
        else:
            self._take_rest(event)
        assert self._head is not None
        self._marks[-1] = self._head

    def _held(self, head: Head, t_s: float) -> Sample | None:
        """The sample that goes for what follows it; None where the sensor has been silent for too long."""
        return None if self._samples_watch.silent(t_s) else head.sample

    def _advanced(self, head: Head, t_s: float, sample: Sample | None) -> Head:
        """The head at `t_s`: trapezoid between its last sample and `sample`, nothing believed of a bad one."""
        last = head.sample or sample
        dt = t_s - head.nav.t_s
        if dt <= 0.0:
            return head._replace(sample=sample)
        if sample is None or last is None or not (sample.good and last.good):
            return self._blind(head, t_s, sample)
        force, rate = 0.5 * (last.force + sample.force), 0.5 * (last.rate + sample.rate)
        nav, since = core.integrate(head.nav, head.since, t_s, force, rate)
        since = self._carry.jolted(since, sample.force - last.force, dt)
        return Head(nav, head.cov, since, head.C_before, sample, head.seen, head.used_s)

    def _blind(self, head: Head, t_s: float, sample: Sample | None) -> Head:
        """No sample is believed: the body goes on as it did, and may do what it wants."""
        head = self._carried(head)
        dt = t_s - head.nav.t_s
        nav = head.nav._replace(t_s=t_s, p_mm=head.nav.p_mm + head.nav.v_mm_s * dt)
        phi, cov = core.unguided(head.cov, dt, self._s.blind_force_m_s2 * MM_PER_M, self._s.blind_rate_rad_s)
        if self._tape is not None:
            self._tape.step(nav, phi, cov)
        return head._replace(nav=nav, cov=cov, sample=sample)

    def _carried(self, head: Head) -> Head:
        """The covariance brought up to the nominal state."""
        if head.since.dt_s == 0.0:
            return head
        self._steps += 1
        nav = core.squared(head.nav) if self._steps % _SQUARE_EVERY == 0 else head.nav
        phi, cov = self._carry(head.cov, head.C_before, nav.C_WI, head.since)
        if self._tape is not None:
            self._tape.step(nav, phi, cov)
        return head._replace(nav=nav, cov=cov, since=core.NOTHING, C_before=nav.C_WI)

    def _mark(self) -> None:
        assert self._head is not None
        self._head = self._carried(self._head)
        self._marks.append(self._head)

    # measurements ----------------------------------------------------------------------------------------------------
    def _take_frame(self, frame: Frame) -> None:
        head = self._head
        assert head is not None
        if len(frame.rows) == 0:
            self._head = head._replace(seen=np.zeros(len(self.body.names), dtype=bool))
            return
        nav = head.nav
        arms = (self._arms_I[frame.rows] + nav.lever_mm) @ nav.C_WI.T
        turning = nav.C_WI @ (head.sample.rate - nav.rate_bias) if head.sample else np.zeros(3)
        rows = core.point_rows(nav, self._layout, arms, turning)
        speed = nav.v_mm_s + np.cross(turning, arms)
        residual = frame.xyz_mm - nav.p_mm - arms - nav.late_s * speed
        good = self._passed(head, frame, rows, residual)
        seen = np.zeros(len(self.body.names), dtype=bool)
        if not good.any():
            self._head = head._replace(seen=seen)
            self._refuse(frame, residual)
            return
        seen[frame.rows[good]] = True
        self._frames_watch.used()
        k = int(good.sum())
        noise = np.zeros((k, 3, k, 3))
        noise[np.arange(k), :, np.arange(k), :] = frame.cov_mm2[good]
        keep = np.repeat(good, 3)
        dx, cov = core.taken_in(head.cov, rows[keep], residual[good].ravel(), noise.reshape(3 * k, 3 * k))
        self._take(dx, cov, seen)
        self._check_lever()

    def _passed(self, head: Head, frame: Frame, rows: Array, residual: Array) -> Mask:
        """Which points agree with the prediction, each by its own innovation; swapped ones are told apart."""
        h = rows.reshape(-1, 3, self._layout.size)
        s = h @ head.cov @ h.transpose(0, 2, 1) + frame.cov_mm2
        distance = np.einsum("ki,ki->k", residual, np.linalg.solve(s, residual[:, :, None])[:, :, 0])
        good = distance <= self._s.gate
        if len(frame.rows) > 1:
            pairs: list[tuple[int, int]] = []
            if not good.all():
                near = float(np.sqrt(self._s.gate * np.trace(s, axis1=1, axis2=2).max() / 3.0))
                pairs = swapped(frame.xyz_mm - residual, frame.xyz_mm, near)
            self._frames_watch.tell_swapped(tuple(self.body.names[i] for i in frame.rows), pairs)
        return np.asarray(good)

    def _refuse(self, frame: Frame, residual: Array) -> None:
        head = self._head
        assert head is not None
        sd = float(np.sqrt(np.trace(frame.cov_mm2, axis1=1, axis2=2).max()))
        if self._frames_watch.refused(head.nav.t_s, residual, sd):
            self._restart(head, residual.mean(axis=0))

    def _restart(self, head: Head, shift_mm: Array) -> None:
        """Begin anew where the points are seen: nothing else is believed of position and velocity."""
        cov = head.cov.copy()
        for block, sd in ((P, 100.0 + 2.0 * float(np.linalg.norm(shift_mm))), (V, 500.0), (PHI, 0.2)):
            cov[block, :] = 0.0
            cov[:, block] = 0.0
            cov[block, block] = sd**2 * np.eye(3)
        nav = head.nav._replace(p_mm=head.nav.p_mm + shift_mm, v_mm_s=np.zeros(3))
        if self._tape is not None:
            self._tape.begin(nav, cov)
        self._head = head._replace(nav=nav, cov=cov)

    def _take(self, dx: Array, cov: Array, seen: Mask | None) -> None:
        head = self._head
        assert head is not None
        nav = head.nav.moved(dx, self._layout)
        if self._tape is not None:
            self._tape.update(nav, cov, dx)
        if seen is None:
            self._head = head._replace(nav=nav, cov=cov, C_before=nav.C_WI)
        else:
            self._head = head._replace(nav=nav, cov=cov, C_before=nav.C_WI, seen=seen, used_s=nav.t_s)

    def _take_rest(self, still: Still) -> None:
        """Velocity is zero and the rate is bias, each if the filter can believe it."""
        settings = self._s.zero_velocity
        assert settings is not None
        for block, value, sd in (
            (V, None, settings.velocity_sd_mm_s),
            (BG, still.rate, settings.rate_excess * self._model.rate_density / np.sqrt(settings.window_s)),
        ):
            head = self._head
            assert head is not None
            residual = -head.nav.v_mm_s if value is None else value - head.nav.rate_bias
            s = head.cov[block, block] + sd * sd * np.eye(3)
            if float(residual @ np.linalg.solve(s, residual)) <= settings.gate:
                rows = np.zeros((3, self._layout.size))
                rows[:, block] = np.eye(3)
                dx, cov = core.taken_in(head.cov, rows, residual, sd * sd * np.eye(3))
                self._take(dx, cov, None)

    def _check_lever(self) -> None:
        """A lever arm that the data move away from the model is the model's error."""
        place, head = self._layout.lever, self._head
        assert head is not None
        if place is None:
            return
        sd = float(np.sqrt(np.trace(head.cov[place, place])))
        off = float(np.linalg.norm(head.nav.lever_mm))
        if off - 3.0 * sd > self._s.lever_limit_mm:
            self._alarms.raise_(LeverArmWrong(self.body.name, value=off, limit=self._s.lever_limit_mm))

    def smoothed(self) -> tuple[Array, Callable[[int], TrackedState]]:
        """Times (m,) of all steps on the tape and the smoothed state of each, for logs."""
        assert self._tape is not None
        steps = self._tape.smoothed(self._layout)
        seen = np.zeros(len(self.body.names), dtype=bool)
        times = np.array([nav.t_s for nav, _ in steps])
        return times, lambda k: body_state(
            self.body, self._layout, on_time(steps[k][0], steps[k][0].rate_bias), steps[k][1], seen, steps[k][0].t_s
        )

    # what is asked ---------------------------------------------------------------------------------------------------
    def navigation(self) -> core.Navigation | None:
        """The nominal state of the sensor, with its biases and the extra states."""
        return self._head.nav if self._head else None

    def late_s(self) -> float:
        """By how much the stamps were found to be late beyond what was corrected; 0 where nothing shows it."""
        return core.known_lag_s(self._head.nav, self._head.cov, self._layout) if self._head else 0.0

    def state(self, t_s: float | None = None) -> TrackedState | None:
        """See `Tracker.state`."""
        head = self._head
        if head is None:
            return None
        tape, self._tape = self._tape, None  # looking ahead is not kept
        if t_s is not None:
            back = next((mark for mark in reversed(self._marks) if mark.nav.t_s <= t_s), self._marks[0])
            head = back if t_s < head.nav.t_s else head
            head = self._advanced(head, t_s, self._held(head, t_s))
        head = self._carried(head)
        self._tape = tape
        rate = head.sample.rate if head.sample else head.nav.rate_bias
        nav = on_time(head.nav, rate)
        return body_state(self.body, self._layout, nav, head.cov, head.seen, head.used_s)


__all__ = ["InertialSettings", "InertialTracker"]
