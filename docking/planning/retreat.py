"""The way back: what was executed, reversed. It needs no fit, only that the axes still stand where the moves ended."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from docking.errors import PlanStale
from docking.kinematics import Positioners
from docking.planning.mate import Scene, gap_mm, moved_pose, off_straight_mm
from docking.planning.path import RigidPath, rigid_path
from docking.planning.plan import PlanRequest, make_plan
from docking.planning.playback import coordinate_at
from docking.planning.settings import MateSettings, PlanSettings
from docking.types import Array, Correction, Plan

START_MM = 0.02
"""How far a driven axis may stand from where the executed move ended."""


@dataclass(frozen=True, eq=False)
class Gone:
    """A move of the way: its plan, the path time it was run to, the scene it was planned in, `then`, and the same start
    with the mate where it is known to be `now`; None where nothing is near."""

    plan: Plan
    path_time_s: float
    then: Scene | None = None
    now: Scene | None = None


@dataclass(frozen=True, eq=False)
class WayBack:
    """How to go back: the last `moves` moves, from commanded positions `q_now_mm` (m,), read-backs of the axes that are
    not driven, no faster than `speed_mm_s`; the first plan gets `plan_id`."""

    moves: int
    q_now_mm: Array
    plan_id: int
    speed_mm_s: float = float("inf")


def retreat_plans(
    way: Sequence[Gone], asked: WayBack, positioners: Positioners, settings: PlanSettings
) -> tuple[Plan, ...]:
    """The last moves of `way` (oldest first), newest first, each from where it ended to its start: the same rigid
    figures, a time law of its own from rest to rest, not faster than it came, through the whole pre-flight against the
    mate where it is now. Axes that are not driven begin where they are.

    Raises PlanStale where nothing rigid was executed or a driven axis does not stand there, and as `make_plan`.
    """
    if not 1 <= asked.moves <= len(way):
        raise PlanStale("retreat", f"{asked.moves} moves are asked, {len(way)} were made")
    plans: list[Plan] = []
    q_now_mm = asked.q_now_mm
    for gone in reversed(way[-asked.moves :]):
        step = replace(asked, moves=1, q_now_mm=q_now_mm, plan_id=asked.plan_id + len(plans))
        plans.append(_back_along(gone, step, positioners, settings))
        q_now_mm = plans[-1].q_mm[-1]
    return tuple(plans)


def _back_along(gone: Gone, asked: WayBack, positioners: Positioners, settings: PlanSettings) -> Plan:
    plan = gone.plan
    if plan.kind == "relief":
        raise PlanStale("retreat", "no move of the whole part was executed")
    path = rigid_path(positioners, plan.q_mm[0], plan.correction)
    s_end = coordinate_at(plan, gone.path_time_s)
    if not s_end > 0.0:
        raise PlanStale("retreat", "the last move ended where it began")
    start = path.axes_mm(np.array([s_end]))[0]
    off = _off(asked.q_now_mm - start, plan, positioners)
    request = PlanRequest(
        plan_id=asked.plan_id,
        stage=plan.stage,
        kind="retreat",
        q_now_mm=start,
        correction=_back(plan.correction, s_end),
        speed_mm_s=_fastest_mm_s(plan, path),
        late_mm_s=asked.speed_mm_s,
        period_s=plan.period_s,
        linear_interpolation=plan.chord_error_mm > 0.0,
        scene=_scene_back(gone, s_end, settings.mate),
    )
    back = make_plan(request, positioners, replace(settings, mate=_corridor_back(gone, settings.mate)))
    q = back.q_mm + off
    q[-1] = plan.q_mm[0] + off
    digest = hashlib.sha256(back.plan_hash.encode() + np.ascontiguousarray(q, dtype="<f8").tobytes())
    return replace(back, q_mm=q, plan_hash=digest.hexdigest())


def _scene_back(gone: Gone, s_end: float, mate: MateSettings) -> Scene | None:
    """Where the parts are before the way back; it may lead as near to the mate as the move began."""
    if gone.now is None:
        return None
    scene, c = gone.now, gone.plan.correction
    here = moved_pose(scene.X_WC, Correction(c.pivot_W_mm, s_end * c.rotvec_rad, s_end * c.shift_mm))
    return Scene(here, scene.X_WM, scene.X_WG, max(0.0, gap_mm(scene, mate)))


def _corridor_back(gone: Gone, mate: MateSettings) -> MateSettings:
    """The way that came into the corridor from its side leads out there, too: as far off, not farther."""
    if gone.then is None:
        return mate
    came_mm = off_straight_mm(gone.then, gone.plan.correction, mate)
    return mate if came_mm <= mate.corridor_mm else replace(mate, corridor_mm=came_mm + mate.contact_mm)


def _off(beside_mm: Array, plan: Plan, positioners: Positioners) -> Array:
    """Where axes that hold no position stand beside the path (m,), 0 for the others, which must stand on it."""
    held = np.where(positioners.driven, np.abs(beside_mm), 0.0)
    k = int(np.argmax(np.where(np.isnan(held), np.inf, held)))
    if not (held[k] <= START_MM):
        raise PlanStale("retreat", f"{plan.axes[k]} stands {held[k]:.4f} mm from where the last move ended")
    result: Array = np.where(positioners.driven, 0.0, beside_mm)
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
