"""What is watched in every cycle. Every comparison is written so that NaN trips it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import (
    AxisNotEnabled,
    BallForceTrip,
    ConsistencyTrip,
    DriveFault,
    FeedbackMissing,
    FollowingErrorTrip,
    InternalForceTrip,
    MotionError,
    WarpTrip,
)
from docking.kinematics import CouplingMonitor, Positioners, coupling_monitor, socket_positions
from docking.motion.triggers import Finding, Trigger
from docking.types import Array, AxisState, Feedback, Plan

LATE_IN_A_ROW = 2
"""Cycles in a row that go without the figure because a read-back is late, however many may be missed by one axis."""


@dataclass(frozen=True)
class WatchLimits:
    """Limits of the monitors (CELL file, `limits`): mm and N; following error grows with speed up to its ceiling."""

    following_rest_mm: float
    following_vmax_mm: float
    ball_residual_mm: float
    internal_force_n: float
    warp_force_n: float
    missing_cycles: float
    overload_factor: float = 1.1


class Watch:
    """Judges read-backs against the commanded figure and keeps the maxima.

    `load_cells` (m,) are the axes whose force is measured. `evaluate` is the hot path: a handful of small array
    operations a cycle.
    """

    def __init__(self, positioners: Positioners, up: Array, limits: WatchLimits, load_cells: ArrayLike) -> None:
        self._positioners, self._up, self._limits = positioners, up, limits
        self._axes = positioners.axes
        self.driven = np.asarray(positioners.driven, dtype=bool)
        v_max = np.asarray(positioners.v_mm_s, dtype=np.float64)
        self._following_slope = (limits.following_vmax_mm - limits.following_rest_mm) / v_max
        self._rated_n = limits.overload_factor * np.asarray(positioners.rated_n, dtype=np.float64).reshape(-1)
        self._weighed = np.asarray(load_cells, dtype=bool)
        self._coupling: CouplingMonitor | None = None
        self._enabled: tuple[AxisState, ...] = ()
        self._late_in_a_row = 0
        self.residual_mm = 0.0
        self.internal_force_n = 0.0
        self.warp_n = 0.0
        self.reset_maxima()

    def reset_maxima(self) -> None:
        """Forget the maxima; called when a move starts."""
        self.max_residual_mm = 0.0
        self.max_internal_force_n = 0.0
        self.max_following_mm = np.zeros(len(self._axes))

    def watch_about(self, q_mm: Array) -> None:
        """Linearise the coupling check about the socket figure at `q_mm` (m,)."""
        self._coupling = coupling_monitor(self._positioners, socket_positions(self._positioners, q_mm), self._up)

    def quick_slew_per_s(self, plan: Plan) -> float:
        """How fast a fault may turn the rate of `plan` down: with the path's own acceleration, inside the quick-stop
        deceleration of every axis. Every cycle that a jammed axis is left behind strains the part."""
        peak = np.abs(np.diff(plan.q_mm, axis=0)).max(axis=0) / plan.period_s
        spare = (self._positioners.a_quick_mm_s2 - self._positioners.a_mm_s2) / np.maximum(peak, 1e-9)
        return max(plan.rate_slew_per_s, float(np.min(spare[self.driven])))

    def power(self, feedback: Feedback, *, may_stop: bool = False) -> MotionError | None:
        """The first driven axis that is not enabled, or None; with `may_stop` an axis may also be ramping down."""
        if feedback.states is self._enabled:
            return None
        for axis, state, driven in zip(self._axes, feedback.states, self.driven, strict=True):
            if driven and not (state is AxisState.ENABLED or (may_stop and state is AxisState.STOPPING)):
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
        """The first violated limit, or None. `q_ref_mm` (m,) is the rigid figure the read-back belongs to.

        `moving` says that a move runs; `may_stop` says that an axis may be ramping down by itself, as a device does that was told to stop.
        """
        if feedback.fault is not None:
            axis, code, text = feedback.fault
            return Finding(Trigger[feedback.fault_kind.name], DriveFault(axis, text, value=code))
        worst_age = feedback.age_cycles.max()
        if not (worst_age <= self._limits.missing_cycles):
            axis = self._axes[int(np.argmax(feedback.age_cycles))]
            error = FeedbackMissing(axis, value=float(worst_age), limit=self._limits.missing_cycles)
            return Finding(Trigger.FEEDBACK_MISSING, error)
        off = self.power(feedback, may_stop=may_stop)
        if off is not None:
            return Finding(Trigger.AXIS_OFF, off)
        if worst_age > 0.0:
            return self._judge_late(feedback, q_ref_mm, speed_mm_s)
        self._late_in_a_row = 0
        return (
            self._following(feedback.following_error_mm, speed_mm_s)
            or self._figure(feedback.position_mm, q_ref_mm)
            or self._ball_forces(feedback.force_n)
        )

    def _judge_late(self, feedback: Feedback, q_ref_mm: Array, speed_mm_s: Array | float) -> Finding | None:
        """Judge without the figure, a few times: a late read-back beside fresh ones would look like a squeezed part."""
        self._late_in_a_row += 1
        trip = self._following(feedback.following_error_mm, speed_mm_s) or self._ball_forces(feedback.force_n)
        if trip is None and self._late_in_a_row > LATE_IN_A_ROW:
            trip = self._figure(feedback.position_mm, q_ref_mm)
        if trip is None:
            return None
        axis = self._axes[int(np.argmax(feedback.age_cycles))]
        cause = f"{axis} has not reported for {feedback.age_cycles.max():.0f} cycles."
        error = trip.error
        return Finding(trip.trigger, type(error)(error.where, cause, value=error.value, limit=error.limit))

    def _following(self, error_mm: Array, speed_mm_s: Array | float) -> Finding | None:
        magnitude = np.abs(error_mm)
        np.maximum(self.max_following_mm, magnitude, out=self.max_following_mm)
        limit = self._limits.following_rest_mm + self._following_slope * np.abs(speed_mm_s)
        inside = (magnitude <= limit) | ~self.driven
        if inside.all():
            return None
        k = int(np.argmin(inside))
        error = FollowingErrorTrip(self._axes[k], value=float(error_mm[k]), limit=float(limit[k]))
        return Finding(Trigger.FOLLOWING_ERROR, error)

    def _figure(self, position_mm: Array, q_ref_mm: Array) -> Finding | None:
        if self._coupling is None:
            return None
        off_mm = position_mm - q_ref_mm
        residual, force, warp = self._coupling.evaluate(off_mm)
        self.residual_mm, self.internal_force_n, self.warp_n = residual, force, warp
        self.max_residual_mm = max(self.max_residual_mm, residual)
        self.max_internal_force_n = max(self.max_internal_force_n, force)
        limits = self._limits
        if not (residual <= limits.ball_residual_mm):
            limit = limits.ball_residual_mm
            error: MotionError = ConsistencyTrip("ball centres", self._worst(off_mm), value=residual, limit=limit)
            return Finding(Trigger.COUPLING, error)
        if not (force <= limits.internal_force_n):
            limit = limits.internal_force_n
            error = InternalForceTrip("ball centres", self._worst(off_mm), value=force, limit=limit)
            return Finding(Trigger.PREDICTED_FORCE, error)
        if not (abs(warp) <= limits.warp_force_n):
            error = WarpTrip("Z axes", self._worst(off_mm), value=warp, limit=limits.warp_force_n)
            return Finding(Trigger.PREDICTED_WARP, error)
        return None

    def _worst(self, off_mm: Array) -> str:
        """The axis that is farthest from its place on the path."""
        k = int(np.argmax(np.abs(off_mm)))
        return f"{self._axes[k]} is {off_mm[k]:+.3f} mm from its place."

    def _ball_forces(self, force_n: Array) -> Finding | None:
        over = ~(np.abs(force_n) <= self._rated_n) & self._weighed
        if not over.any():
            return None
        k = int(np.argmax(over))
        cause = "Its load cell does not report." if np.isnan(force_n[k]) else ""
        error = BallForceTrip(self._axes[k], cause, value=float(force_n[k]), limit=float(self._rated_n[k]))
        return Finding(Trigger.FORCE_MISSING if cause else Trigger.OVERLOAD, error)
