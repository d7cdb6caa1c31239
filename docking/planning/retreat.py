"""The way back: what was executed, reversed. It needs no fit, only that the axes still stand where the move ended."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from docking.errors import PlanStale
from docking.kinematics import Positioners
from docking.planning.path import RigidPath, rigid_path
from docking.planning.plan import PlanRequest, make_plan
from docking.planning.playback import coordinate_at
from docking.planning.settings import PlanSettings
from docking.types import Array, Correction, Plan

START_MM = 0.02
"""How far a driven axis may stand from where the executed move ended."""


def retreat_plan(
    executed: Sequence[tuple[Plan, float]],
    q_now_mm: Array,
    positioners: Positioners,
    settings: PlanSettings,
    plan_id: int,
) -> Plan:
    """The last of `executed` (plan, path time reached) from where it ended to its start: the same rigid figures, a time
    law of its own from rest to rest, not faster than it came, through the same pre-flight.

    `q_now_mm` (m,): commanded positions of the driven axes, read-backs of the others; these begin where they are. The
    way was clear of the mate when it was gone. Raises PlanStale where nothing rigid was executed or a driven axis does
    not stand there, and what `make_plan` raises.
    """
    if not executed or executed[-1][0].kind == "relief":
        raise PlanStale("retreat", "no move of the whole part was executed")
    plan, reached_s = executed[-1]
    path = rigid_path(positioners, plan.q_mm[0], plan.correction)
    s_end = coordinate_at(plan, reached_s)
    if not s_end > 0.0:
        raise PlanStale("retreat", "the last move ended where it began")
    start = path.axes_mm(np.array([s_end]))[0]
    off = _off(q_now_mm - start, plan, positioners)
    request = PlanRequest(
        plan_id=plan_id,
        stage=plan.stage,
        kind="retreat",
        q_now_mm=start,
        correction=_back(plan.correction, s_end),
        speed_mm_s=_fastest_mm_s(plan, path),
        period_s=plan.period_s,
        linear_interpolation=plan.chord_error_mm > 0.0,
    )
    back = make_plan(request, positioners, settings)
    q = back.q_mm + off
    q[-1] = plan.q_mm[0] + off
    digest = hashlib.sha256(back.plan_hash.encode() + np.ascontiguousarray(q, dtype="<f8").tobytes())
    return replace(back, q_mm=q, plan_hash=digest.hexdigest())


def _off(gap_mm: Array, plan: Plan, positioners: Positioners) -> Array:
    """Where axes that hold no position stand beside the path (m,), 0 for the others, which must stand on it."""
    held = np.where(positioners.driven, np.abs(gap_mm), 0.0)
    k = int(np.argmax(np.where(np.isnan(held), np.inf, held)))
    if not (held[k] <= START_MM):
        raise PlanStale("retreat", f"{plan.axes[k]} stands {held[k]:.4f} mm from where the last move ended")
    result: Array = np.where(positioners.driven, 0.0, gap_mm)
    return result


def _back(correction: Correction, s: float) -> Correction:
    """From `s` of a move to its start: the pivot goes straight back as the part turns back about it."""
    pivot = correction.pivot_W_mm + s * correction.shift_mm
    return Correction(pivot, -s * correction.rotvec_rad, -s * correction.shift_mm)


def _fastest_mm_s(plan: Plan, path: RigidPath) -> float:
    """Largest speed of a ball or the pivot in `plan`."""
    middle = 0.5 * (plan.s[1:] + plan.s[:-1])
    speed = path.point_speed_mm(middle).max(axis=1) * np.diff(plan.s) / plan.period_s
    return max(float(speed.max()), 1e-6)
