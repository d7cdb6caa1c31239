"""The way back: what was executed, reversed. It needs no fit, only that the axes still stand where the move ended."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from docking.errors import PlanStale
from docking.types import Array, Correction, Plan

START_MM = 0.02
"""How far a driven axis may stand from where the executed move ended."""
END_S = 1e-6


def retreat_plan(
    executed: Sequence[tuple[Plan, float]], q_now_mm: Array, driven: NDArray[np.bool_], plan_id: int
) -> Plan:
    """The last of `executed` (plan, path time reached) from its end to its start, at the same speeds and stops.

    `q_now_mm` (m,): commanded positions of the `driven` axes, read-backs of the others; these begin where they are.
    Every limit holds backwards as it held forwards. Raises PlanStale where nothing was executed, the move was not run
    to its end, or a driven axis does not stand there.
    """
    if not executed:
        raise PlanStale("retreat", "no move was executed")
    plan, reached_s = executed[-1]
    if not (reached_s >= plan.duration_s - END_S):
        raise PlanStale("retreat", f"the last move ended at {reached_s:.2f} s of {plan.duration_s:.2f} s")
    off = q_now_mm - plan.q_mm[-1]
    gap = float(np.abs(off[driven]).max())
    if not (gap <= START_MM):
        axis = plan.axes[int(np.argmax(np.abs(np.where(driven, off, 0.0))))]
        raise PlanStale("retreat", f"{axis} stands {gap:.4f} mm from the end of the last move")
    q = plan.q_mm[::-1] + np.where(driven, 0.0, off)
    back = plan.correction
    return replace(
        plan,
        plan_id=plan_id,
        plan_hash=hashlib.sha256(f"{plan_id}\x1fretreat\x1f{plan.plan_hash}".encode() + q.tobytes()).hexdigest(),
        kind="retreat",
        s=1.0 - plan.s[::-1],
        q_mm=q,
        correction=Correction(back.pivot_W_mm + back.shift_mm, -back.rotvec_rad, -back.shift_mm),
        bounds=None if plan.bounds is None else replace(plan.bounds, clearance_s=1.0 - plan.bounds.clearance_s),
    )
