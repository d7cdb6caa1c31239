"""All monitors of one control cycle, in the order in which their findings matter."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import (
    AxisAtLimit,
    AxisNotEnabled,
    ConsistencyTrip,
    DriveFault,
    DriveWarning,
    FeedbackMissing,
    InternalForceTrip,
    MotionError,
    PassiveAxisTrip,
    WarpTrip,
)
from docking.kinematics import Coupling, CouplingMonitor, Load, Positioners, coupling_monitor, socket_positions
from docking.motion.monitors.followed import Followed
from docking.motion.monitors.held import HeldForces
from docking.motion.monitors.limits import Margins, Timing, WatchLimits
from docking.motion.monitors.loads import BallLoads
from docking.motion.monitors.travel import Travel
from docking.motion.triggers import Finding, Trigger
from docking.types import Array, AxisState, FaultKind, Feedback

LATE_IN_A_ROW = 2
"""Cycles in a row that go without the figure because a read-back is late, however many may be missed by one axis."""

_NONE = Coupling(0.0, 0.0, 0.0, 0.0, 0.0)


class Watch:
    """Judges read-backs against the commanded figure and keeps the maxima.

    `load_cells` (m,) are the axes whose force is measured. `evaluate` is the hot path: a handful of small array
    operations a cycle, next to nothing at rest while the read-backs stay the same.
    """

    def __init__(
        self,
        positioners: Positioners,
        load: Load,
        limits: WatchLimits,
        load_cells: ArrayLike,
        timing: Timing | None = None,
    ) -> None:
        self._positioners, self._up, self._limits = positioners, load.up, limits
        self._axes = positioners.axes
        self.driven = np.asarray(positioners.driven, dtype=bool)
        self._powered = np.asarray(positioners.powered, dtype=bool).tolist()
        self._margins = Margins()
        self._travel = Travel(positioners, limits, timing or Timing(), self._margins)
        weighed = np.asarray(load_cells, dtype=np.bool_)
        self._loads = BallLoads(positioners, load, limits, weighed, self._margins)
        self._held = HeldForces(positioners, weighed, self._margins)
        self._followed = Followed(limits.passive_mm)
        self._coupling: CouplingMonitor | None = None
        self._enabled: tuple[AxisState, ...] = ()
        self._late_in_a_row = 0
        self._clean: tuple[Feedback, Array] | None = None
        self._complaint: tuple[str, int, str] | None = None
        self._complaint_s = 0.0
        self.coupling = _NONE
        self.reset_maxima()

    # what is known of the last evaluation ------------------------------------------------------------------------
    @property
    def residual_mm(self) -> float:
        """Largest ball residual."""
        return self.coupling.residual_mm

    @property
    def internal_force_n(self) -> float:
        """Largest internal force at a ball, predicted from the read-backs."""
        return self.coupling.force_n

    @property
    def warp_n(self) -> float:
        """Warp of the vertical axes, predicted from the read-backs."""
        return self.coupling.warp_n

    @property
    def measured_force_n(self) -> float:
        """Largest internal force at a ball, measured, since the move was loaded; NaN without load cells."""
        return self._loads.force_n

    @property
    def max_following_mm(self) -> Array:
        """Largest |following error| (m,) since the maxima were reset."""
        return self._travel.max_following_mm

    def margins(self) -> dict[str, float]:
        """The nearest that each monitor has ever come to its limit, as a fraction of the limit; over 1 it tripped."""
        return dict(sorted(self._margins.peaks.items()))

    def reset_maxima(self) -> None:
        """Forget the maxima; called when a move starts."""
        self.max_residual_mm = 0.0
        self.max_internal_force_n = 0.0
        self._travel.max_following_mm = np.zeros(len(self._axes))

    # preparation -------------------------------------------------------------------------------------------------
    def watch_about(self, q_mm: Array, *, relief: bool = False) -> None:
        """Linearise coupling and expected loads about the axis positions `q_mm` (m,) at standstill, and tare there.

        `relief` says that the move to come starts from a strained part.
        """
        self._coupling = coupling_monitor(self._positioners, socket_positions(self._positioners, q_mm), self._up)
        self._travel.forget()
        self._followed.begin()
        self._loads.about(q_mm, relief=relief)
        self._clean = None

    def strained_before(self, feedback: Feedback) -> Finding | None:
        """After `watch_about`: why no move may start with the part as it is; None for a relief, which is to help."""
        return self._loads.strained(feedback.force_n)

    def changed_at_rest(self, feedback: Feedback) -> Finding | None:
        """Why a loaded or a held move may not go on: the forces are not those of when the axes came to rest."""
        return self._loads.changed(feedback.force_n)

    # the cycle ---------------------------------------------------------------------------------------------------
    def power(self, feedback: Feedback, *, may_stop: bool = False) -> MotionError | None:
        """The first powered axis that is not enabled, or None; with `may_stop` an axis may also be ramping down."""
        if feedback.states is self._enabled:
            return None
        for axis, state, powered in zip(self._axes, feedback.states, self._powered, strict=True):
            if powered and not (state is AxisState.ENABLED or (may_stop and state is AxisState.STOPPING)):
                return AxisNotEnabled(axis, value=state.value, limit=AxisState.ENABLED.value)
        if not may_stop:
            self._enabled = feedback.states
        return None

    def evaluate(
        self,
        feedback: Feedback,
        q_ref_mm: Array,
        speed_mm_s: Array | float,
        *,
        moving: bool,
        may_stop: bool = False,
    ) -> Finding | None:
        """The finding that asks for the most severe reaction, or None.

        `q_ref_mm` (m,) is where on the path the read-back belongs, `speed_mm_s` (m,) the commanded speed there.
        `moving` says that a move runs; `may_stop` says that an axis may be ramping down by itself, as a device does
        that was told to stop.
        """
        if not moving and self._unchanged(feedback, q_ref_mm):
            return None
        finding = self._devices(feedback, may_stop=may_stop)
        if finding is None and feedback.age_cycles.max() > 0.0:
            finding = self._judge_late(feedback, q_ref_mm, speed_mm_s, moving)
        elif finding is None:
            self._late_in_a_row = 0
            led = not (may_stop and AxisState.STOPPING in feedback.states)
            # All are judged, whatever the first finds: the maxima and the trace go on through a stop.
            found = (
                self._travel.judge(feedback, q_ref_mm, moving=moving, led=led),
                self._figure(feedback.position_mm, q_ref_mm),
                self._weigh(feedback, q_ref_mm, moving),
                self._travel.following(feedback.following_error_mm, speed_mm_s),
                self._held.judge(feedback),
            )
            finding = found[0] or found[1] or found[2] or found[3] or found[4]
        finding = finding or self._told(feedback)
        self._clean = (feedback, q_ref_mm) if finding is None and feedback.fault is None else None
        return finding

    def _weigh(self, feedback: Feedback, q_ref_mm: Array, moving: bool) -> Finding | None:
        held_s = self._travel.held_s(feedback.t_s) if moving else 0.0
        return self._loads.judge(feedback.force_n, feedback.t_s, q_ref_mm, moving=moving, held_s=held_s)

    def _unchanged(self, feedback: Feedback, q_ref_mm: Array) -> bool:
        """True when a driver passed on the same values: what was judged a cycle ago needs no second judgement."""
        if self._clean is None:
            return False
        before, reference = self._clean
        same = (
            feedback.position_mm is before.position_mm
            and feedback.following_error_mm is before.following_error_mm
            and feedback.force_n is before.force_n
            and feedback.states is before.states
            and feedback.age_cycles is before.age_cycles
            and feedback.fault is before.fault
            and feedback.at_limit is before.at_limit
            and q_ref_mm is reference
        )
        if same:
            self._travel.unchanged(feedback.t_s)
        return same

    def _devices(self, feedback: Feedback, *, may_stop: bool) -> Finding | None:
        """What the devices say of themselves: faults, axes that are off, axes that are silent."""
        if feedback.fault is not None and feedback.fault_kind is not FaultKind.DRIVE_WARNING:
            axis, code, text = feedback.fault
            return Finding(Trigger[feedback.fault_kind.name], DriveFault(axis, text, value=code))
        off = self.power(feedback, may_stop=may_stop)
        if off is not None:
            return Finding(Trigger.AXIS_OFF, _explained(off, feedback))
        ages, limit = feedback.age_cycles, self._limits.missing_cycles
        worst_age = float(ages.max())
        if worst_age == 0.0:
            return None
        self._margins.note("missing_feedback", worst_age / limit)
        # As many read-backs missed in a row as the limit says are already too many.
        if worst_age < limit:
            return None
        trigger = Trigger.ALL_MISSING if ages.min() >= limit else Trigger.FEEDBACK_MISSING
        axis = self._axes[int(np.argmax(ages))]
        return Finding(trigger, FeedbackMissing(axis, value=worst_age, limit=limit))

    def _told(self, feedback: Feedback) -> Finding | None:
        """What devices warn of: limit switches, emergencies of drives that go on."""
        if feedback.at_limit is not None and feedback.at_limit.any():
            return Finding(Trigger.LIMIT_SWITCH, AxisAtLimit(self._axes[int(np.argmax(feedback.at_limit))]))
        if feedback.fault is None:
            return None
        if feedback.fault != self._complaint:
            # An emergency overtakes the read-back that tells whether its drive goes on: the next one knows.
            self._complaint, self._complaint_s = feedback.fault, feedback.t_s
        if not (feedback.t_s > self._complaint_s):
            return None
        axis, code, text = feedback.fault
        return Finding(Trigger.DRIVE_WARNING, DriveWarning(axis, text, value=code))

    def _judge_late(
        self, feedback: Feedback, q_ref_mm: Array, speed_mm_s: Array | float, moving: bool
    ) -> Finding | None:
        """Judge without the figure, a few times: a late read-back beside fresh ones would look like a squeezed part."""
        self._late_in_a_row += 1
        finding = self._weigh(feedback, q_ref_mm, moving)
        finding = finding or self._travel.following(feedback.following_error_mm, speed_mm_s)
        if finding is None and self._late_in_a_row > LATE_IN_A_ROW:
            finding = self._figure(feedback.position_mm, q_ref_mm)
        if finding is None:
            return None
        axis = self._axes[int(np.argmax(feedback.age_cycles))]
        cause = f"{axis} has not reported for {feedback.age_cycles.max():.0f} cycles."
        error = finding.error
        return Finding(finding.trigger, type(error)(error.where, cause, value=error.value, limit=error.limit))

    # the figure --------------------------------------------------------------------------------------------------
    def _figure(self, position_mm: Array, q_ref_mm: Array) -> Finding | None:
        if self._coupling is None:
            return None
        off_mm = position_mm - q_ref_mm
        self.coupling = found = self._coupling.evaluate(off_mm)
        self.max_residual_mm = max(self.max_residual_mm, found.residual_mm)
        self.max_internal_force_n = max(self.max_internal_force_n, found.force_n)
        limits, note = self._limits, self._margins.note
        inside = (
            note("ball_residual", found.residual_mm / limits.ball_residual_mm),
            note("ball_rms", found.rms_mm / limits.ball_rms_mm),
            note("ball_pair", found.pair_mm / limits.ball_pair_mm),
            note("predicted_force", found.force_n / limits.internal_force_n),
            note("predicted_warp", found.warp_n / limits.warp_force_n),
        )
        if not all(inside):
            return self._strained(inside.index(False), off_mm)
        return self._follow(self._coupling, q_ref_mm) if len(self._coupling.free) else None

    def _follow(self, coupling: CouplingMonitor, q_ref_mm: Array) -> Finding | None:
        """Axes that follow the part: none is left behind by a jam, none has come off its place with time."""
        limits, beside_mm = self._limits, coupling.beside_mm
        left_mm = self._followed.off_mm(beside_mm, q_ref_mm[coupling.free])
        # One that holds a force goes where its force is, not where nominal directions take it: its force is judged.
        left_mm = np.where(self._positioners.followers[coupling.free], 0.0, left_mm)
        for monitor, off_mm, limit in (
            ("passive_axis", np.abs(left_mm), limits.passive_mm),
            ("passive_place", np.abs(beside_mm), limits.adrift_mm),
        ):
            if not self._margins.note(monitor, float(off_mm.max()) / limit):
                k = int(np.argmin(off_mm <= limit))
                error = PassiveAxisTrip(self._axes[coupling.free[k]], value=float(off_mm[k]), limit=limit)
                return Finding(Trigger.PASSIVE_AXIS, error)
        return None

    def _strained(self, case: int, off_mm: Array) -> Finding:
        """The finding of the first figure that is over its limit."""
        found, limits, cause = self.coupling, self._limits, self._worst(off_mm)
        trigger, kind, where, value, limit = (
            (Trigger.COUPLING, ConsistencyTrip, "ball centres", found.residual_mm, limits.ball_residual_mm),
            (Trigger.COUPLING, ConsistencyTrip, "ball centres, rms", found.rms_mm, limits.ball_rms_mm),
            (Trigger.COUPLING, ConsistencyTrip, "distances of ball centres", found.pair_mm, limits.ball_pair_mm),
            (Trigger.PREDICTED_FORCE, InternalForceTrip, "ball centres", found.force_n, limits.internal_force_n),
            (Trigger.PREDICTED_WARP, WarpTrip, "Z axes", found.warp_n, limits.warp_force_n),
        )[case]
        return Finding(trigger, kind(where, cause, value=value, limit=limit))

    def parted(self, feedback: Feedback, slope_mm_s: Array) -> Finding | None:
        """Controllers whose path times are apart: by how much, at the axis speeds (m,) of the plan there, they squeeze
        the part. Positions beside their own place on the path would not show it."""
        fastest = float(np.sqrt(np.square(slope_mm_s.reshape(-1, 3)).sum(axis=1).max()))
        apart_mm, limit = feedback.path_skew_s * fastest, self._limits.sync_error_mm
        if self._margins.note("path_times", apart_mm / limit):
            return None
        times = feedback.path_times_s
        last = "" if times is None else self._axes[int(np.argmin(times))].partition(".")[0]
        cause = f"At least {1000.0 * feedback.path_skew_s:.0f} ms apart at {fastest:.2f} mm/s; {last} is last."
        return Finding(Trigger.COUPLING, ConsistencyTrip("path times", cause, value=apart_mm, limit=limit))

    def _worst(self, off_mm: Array) -> str:
        """The axis that is farthest from its place on the path."""
        k = int(np.argmax(np.abs(off_mm)))
        return f"{self._axes[k]} is {off_mm[k]:+.3f} mm from its place."


def _explained(off: MotionError, feedback: Feedback) -> MotionError:
    """An axis that is not enabled, with what its drive said of it."""
    if feedback.fault is None or feedback.fault[0] != off.where:
        return off
    _, code, text = feedback.fault
    return AxisNotEnabled(off.where, f"{text} ({code:04X}h)", value=off.value, limit=off.limit)
