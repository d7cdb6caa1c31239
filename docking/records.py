"""Nouns as journal bodies: what the report and `--json` are made from. Angles leave in degrees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from docking.geometry import pose_to_vector
from docking.planning.relief import Strain, Weighing
from docking.pose.goal import Goal, GoalRule
from docking.types import Alarm, Array, FeatureErrors, Fit, MoveResult, Plan, PlanBounds, Pose, Rejection, StopTimes

POSE_KEYS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


def pose_record(X: Pose) -> dict[str, float]:
    """The border form of a pose with its names."""
    return dict(zip(POSE_KEYS, pose_to_vector(X).tolist(), strict=True))


def rejection_records(rejected: tuple[Rejection, ...]) -> list[dict[str, str]]:
    return [{"name": r.name, "reason": r.reason, "detail": r.detail} for r in rejected]


def _residuals(fit: Fit) -> dict[str, list[float]]:
    return dict(zip(fit.names, fit.residuals_mm.tolist(), strict=True))


def station_record(X_WT: Fit) -> dict[str, Any]:
    return {
        "X_WT": X_WT.X_MN.matrix().tolist(),
        "rms_mm": X_WT.rms_mm,
        "max_mm": X_WT.max_mm,
        "residuals_mm": _residuals(X_WT),
        "rejected": rejection_records(X_WT.rejected),
    }


def fit_record(fit: Fit, what: str, stage: str) -> dict[str, Any]:
    return {
        "what": what,
        "stage": stage,
        "X": fit.X_MN.matrix().tolist(),
        "pose": pose_record(fit.X_MN),
        "rms_mm": fit.rms_mm,
        "max_mm": fit.max_mm,
        "method": fit.method,
        "iterations": fit.iterations,
        "chi2": fit.chi2,
        "dof": fit.dof,
        "redundancy": fit.redundancy,
        "scale": 1.0 + fit.expansion,
        "used": list(fit.names),
        "rejected": rejection_records(fit.rejected),
        "residuals_mm": _residuals(fit),
    }


def features_record(errors: FeatureErrors, stage: str, when: str) -> dict[str, Any]:
    return {
        "stage": stage,
        "when": when,
        "names": list(errors.names),
        "error_mm": errors.error_mm.tolist(),
        "norm_mm": errors.norm_mm.tolist(),
        "sigma_mm": errors.sigma_mm.tolist(),
        "tolerance_mm": errors.tolerance_mm.tolist(),
        "risk": errors.risk,
        "accepted": errors.accepted(),
    }


def goal_record(goal: Goal, rule: GoalRule, names: tuple[str, ...], stage: str) -> dict[str, Any]:
    """The docked goal that a move to `stage` heads for, and what it leaves at the features."""
    return {
        "stage": stage,
        "rule": rule.kind,
        "locks": list(rule.locks),
        "X_WC": goal.X_WC.matrix().tolist(),
        "names": list(names),
        "misfit_mm": goal.misfit_mm.tolist(),
        "share": goal.share.tolist(),
    }


def plan_record(plan: Plan) -> dict[str, Any]:
    c = plan.correction
    return {
        "plan_id": plan.plan_id,
        "plan_hash": plan.plan_hash,
        "stage": plan.stage,
        "kind": plan.kind,
        "duration_s": plan.duration_s,
        "displacement_mm": dict(zip(plan.axes, plan.displacement_mm.tolist(), strict=True)),
        "speed_limited_by": plan.speed_limited_by,
        "chord_error_mm": plan.chord_error_mm,
        "margins": [list(row) for row in plan.margins],
        "correction": {
            "rotvec_deg": np.degrees(c.rotvec_rad).tolist(),
            "shift_mm": c.shift_mm.tolist(),
            "pivot_mm": c.pivot_W_mm.tolist(),
        },
        "bounds": None if plan.bounds is None else bounds_record(plan.axes, plan.bounds),
    }


def bounds_record(axes: tuple[str, ...], bounds: PlanBounds) -> dict[str, Any]:
    """What the pre-flight foresees; unknown distances are None."""

    def by_axis(values: Array) -> dict[str, float]:
        return dict(zip(axes, values.tolist(), strict=True))

    return {
        "peak_mm_s": by_axis(bounds.peak_mm_s),
        "quick_stop_s": bounds.quick_stop_s,
        "jam_mm": by_axis(bounds.jam_mm),
        "jam_n": by_axis(bounds.jam_n),
        "jam_warp_n": by_axis(bounds.jam_warp_n),
        "ramp_mm": by_axis(bounds.ramp_mm),
        "residual_mm": bounds.residual_mm,
        "force_n": bounds.force_n,
        "warp_n": bounds.warp_n,
        "clearance_mm": _known(bounds.clearance_mm),
        "clearance_asked_mm": _known(bounds.clearance_asked_mm),
        "clearance_s": _known(bounds.clearance_s),
        "duration_s": bounds.duration_s,
        "limits": [list(row) for row in bounds.limits],
    }


def intent_record(plan: Plan) -> dict[str, Any]:
    return {
        "plan_hash": plan.plan_hash,
        "start_mm": dict(zip(plan.axes, plan.q_mm[0].tolist(), strict=True)),
        "target_mm": dict(zip(plan.axes, plan.q_mm[-1].tolist(), strict=True)),
    }


def moved_record(plan: Plan, result: MoveResult) -> dict[str, Any]:
    trace = result.trace
    return {
        "plan_hash": plan.plan_hash,
        "result": result.result,
        "path_time_s": result.path_time_s,
        "stop": stop_record(result.stop),
        "reaction": result.reaction,
        "also": [str(error) for error in result.also],
        "trace": {
            "t_s": trace.t_s.tolist(),
            "path_time_s": trace.path_time_s.tolist(),
            "position_mm": _by_axis(plan.axes, trace.position_mm),
            "following_error_mm": _by_axis(plan.axes, trace.following_error_mm),
            "residual_mm": trace.residual_mm.tolist(),
            "internal_force_n": trace.internal_force_n.tolist(),
            "force_n": _by_axis(plan.axes, trace.force_n),
            "measured_force_n": np.round(trace.measured_force_n, 1).tolist(),
        },
        "max_following_error_mm": dict(zip(plan.axes, result.max_following_error_mm.tolist(), strict=True)),
        "max_consistency_residual_mm": result.max_residual_mm,
        "max_internal_force_n": result.max_internal_force_n,
    }


def weighing_record(axes: tuple[str, ...], weighing: Weighing) -> dict[str, Any]:
    rows = ("position_mm", weighing.position_mm), ("force_n", weighing.force_n), ("noise_n", weighing.noise_n)
    return {name: dict(zip(axes, values.tolist(), strict=True)) for name, values in rows}


def strain_record(names: tuple[str, ...], strain: Strain, axes: tuple[str, ...], weighing: Weighing) -> dict[str, Any]:
    return {
        **weighing_record(axes, weighing),
        "internal_force_n": dict(zip(names, strain.ball_n.tolist(), strict=True)),
        "ball_force_n": dict(zip(names, strain.force_n.tolist(), strict=True)),
        "foreign_force_n": dict(zip(names, strain.foreign_n.tolist(), strict=True)),
        "sigma_n": strain.sigma_n,
    }


def _by_axis(axes: tuple[str, ...], table: np.ndarray[Any, Any]) -> dict[str, list[float]]:
    # Four digits after the point (0.1 um, 0.1 mN) keep the journal small and are finer than any sensor here.
    rounded = np.round(table, 4)
    return {axis: rounded[:, k].tolist() for k, axis in enumerate(axes)}


def alarm_record(alarm: Alarm) -> dict[str, Any]:
    return {
        "code": alarm.code,
        "message": alarm.message,
        "where": alarm.where,
        "value": alarm.value,
        "limit": alarm.limit,
        "remedy": alarm.remedy,
        "t_s": _known(alarm.t_s),
        "stop": stop_record(alarm.stop),
    }


def stop_record(stop: StopTimes | None) -> dict[str, float | None] | None:
    """When a stop was found necessary (loop time), and how long after that commands and axes followed."""
    if stop is None:
        return None
    return {
        "found_s": _known(stop.found_s),
        "commanded_after_s": _known(stop.commanded_s - stop.found_s),
        "rest_after_s": _known(stop.rest_s - stop.found_s),
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
