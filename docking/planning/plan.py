"""From a correction to a checked table of axis positions: path, time law, pre-flight."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from docking.errors import PlanInputInvalid
from docking.kinematics import Positioners, pose_from_axes
from docking.planning.attitudes import check_attitudes
from docking.planning.jam import jam_bound
from docking.planning.mate import Clearance, Scene, check_mate
from docking.planning.pace import PaceLimits, fastest_law, rate_slew_per_s
from docking.planning.path import RigidPath, rigid_path
from docking.planning.preflight import check_chord, check_strokes, check_table
from docking.planning.settings import PlanSettings
from docking.planning.strain import foreseen_strain
from docking.planning.time_law import TimeLaw
from docking.types import Array, Correction, Plan, PlanBounds


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """One move to plan: `q_now_mm` (m,) commanded axis positions (read-back for passive axes), `correction` in W,
    `speed_mm_s` of the fastest ball or the pivot, and the most that late cycles permit, `late_mm_s`; `period_s` between
    two rows (bus cycle or segment);
    `linear_interpolation`: the devices interpolate each axis linearly between rows, so the chord error binds; `scene`:
    where component and mate are, None where nothing is near (what the mate asks is not checked then)."""

    plan_id: int
    stage: str
    kind: str
    q_now_mm: Array
    correction: Correction
    speed_mm_s: float
    period_s: float
    linear_interpolation: bool
    scene: Scene | None = None
    late_mm_s: float = float("inf")


def make_plan(request: PlanRequest, positioners: Positioners, settings: PlanSettings) -> Plan:
    """Plan and check the whole move. Raises PlanInputInvalid, StrokeExceeded, AxisLimitExceeded, BallReactionOut,
    BallSwivelExceeded, StrainForeseen, ApproachRefused, MateTooNear; FrameImplausible when the axis positions fit no
    pose."""
    _check_request(request, positioners)
    path = rigid_path(positioners, request.q_now_mm, request.correction)
    room = check_strokes(path, positioners, settings)
    check_attitudes(pose_from_axes(positioners, request.q_now_mm), request.correction, positioners, settings)
    jam = jam_bound(positioners, path.axes_mm(np.array([0.0, 0.5, 1.0])), settings.jam, settings.load.up)
    asked = request.speed_mm_s, request.late_mm_s
    limits = PaceLimits(positioners, asked, request.period_s, request.linear_interpolation, settings, jam)
    law, limited_by = fastest_law(path, limits)
    t_s = request.period_s * np.arange(round(law.duration_s / request.period_s) + 1, dtype=np.float64)
    s = law.at(t_s)
    q = path.axes_mm(s)
    peak = check_table(s, q, request.period_s, positioners)
    chord = check_chord(path, s, settings.chord_error_mm) if request.linear_interpolation else 0.0
    margins = tuple(
        (axis, float(room[k]), float(positioners.v_mm_s[k] - peak[k])) for k, axis in enumerate(positioners.axes)
    )
    return Plan(
        plan_id=request.plan_id,
        plan_hash=_content_hash(request, positioners.axes, s, q),
        stage=request.stage,
        kind=request.kind,
        axes=positioners.axes,
        period_s=request.period_s,
        t_s=t_s,
        s=s,
        q_mm=q,
        correction=request.correction,
        chord_error_mm=chord,
        rate_slew_per_s=rate_slew_per_s(path, law, limits),
        speed_limited_by=limited_by,
        margins=margins,
        bounds=_bounds(request, path, (law, limited_by), limits, s, peak),
    )


def _bounds(
    request: PlanRequest, path: RigidPath, paced: tuple[TimeLaw, str], limits: PaceLimits, s: Array, peak_mm_s: Array
) -> PlanBounds:
    """What is foreseen of the timed move; raises what that forbids. `paced`: the law and the limit that sets it."""
    law, limited_by = paced
    jam, settings = limits.jam, limits.settings
    quick_stop_s = jam.quick_stop_s(peak_mm_s)
    clear = Clearance()
    if request.scene is not None:
        clear = check_mate(request.scene, request.correction, law, settings.mate, quick_stop_s)
    strain = foreseen_strain(path, s, limits.positioners, settings, law.duration_s)
    used = [(name, factor) for factor, name in limits.stretches(path, law)]
    used.sort(key=lambda item: (item[0] != limited_by, -item[1]))
    return PlanBounds(
        peak_mm_s=peak_mm_s,
        quick_stop_s=quick_stop_s,
        jam_mm=jam.jam_mm(peak_mm_s),
        jam_n=jam.jam_n(peak_mm_s),
        jam_warp_n=jam.jam_warp_n(peak_mm_s),
        ramp_mm=jam.ramp_mm(peak_mm_s),
        residual_mm=strain.residual_mm,
        force_n=strain.force_n,
        warp_n=strain.warp_n,
        clearance_mm=clear.distance_mm,
        clearance_asked_mm=clear.asked_mm,
        clearance_s=clear.s,
        duration_s=law.duration_s,
        limits=tuple(used),
    )


def _check_request(request: PlanRequest, positioners: Positioners) -> None:
    """NaN, infinity, a wrong length or a speed that is not positive never reach the path."""
    for name in ("speed_mm_s", "period_s"):
        value = getattr(request, name)
        if not 0.0 < value < float("inf"):
            raise PlanInputInvalid(name, value=value, limit="positive and finite")
    if not request.late_mm_s > 0.0:
        raise PlanInputInvalid("speed that late cycles permit", value=request.late_mm_s, limit="positive")
    if request.q_now_mm.shape != (len(positioners.axes),):
        limit = f"one number for each of {len(positioners.axes)} axes"
        raise PlanInputInvalid("axis positions", value=str(request.q_now_mm.shape), limit=limit)
    correction = request.correction
    for where, array in (
        ("axis positions", request.q_now_mm),
        ("pivot", correction.pivot_W_mm),
        ("rotation", correction.rotvec_rad),
        ("shift", correction.shift_mm),
    ):
        if not np.all(np.isfinite(array)):
            raise PlanInputInvalid(where, value=str(array), limit="finite")
    if request.scene is not None:
        _check_scene(request.scene)
    if not float(np.linalg.norm(correction.rotvec_rad)) <= np.pi:
        raise PlanInputInvalid("rotation", value=float(np.linalg.norm(correction.rotvec_rad)), limit="at most pi rad")


def _check_scene(scene: Scene) -> None:
    """Poses and stand-offs are numbers; only the station before the first is infinitely far."""
    poses = np.concatenate([np.append(X.R.reshape(-1), X.t_mm) for X in (scene.X_WC, scene.X_WM, scene.X_WG)])
    for where, value, good in (
        ("measured poses", poses, np.all(np.isfinite(poses))),
        ("stand-off", scene.standoff_mm, 0.0 <= scene.standoff_mm < float("inf")),
        ("stand-off before", scene.from_standoff_mm, scene.from_standoff_mm >= 0.0),
    ):
        if not good:
            raise PlanInputInvalid(where, value=str(value), limit="finite and not negative")


def _content_hash(request: PlanRequest, axes: tuple[str, ...], s: Array, q_mm: Array) -> str:
    """SHA-256 over everything that decides what the axes will do."""
    digest = hashlib.sha256()
    words = (str(request.plan_id), request.stage, request.kind, repr(request.period_s), *axes)
    digest.update("\x1f".join(words).encode())
    correction = request.correction
    for array in (correction.pivot_W_mm, correction.rotvec_rad, correction.shift_mm, s, q_mm):
        digest.update(np.ascontiguousarray(array, dtype="<f8").data)
    return digest.hexdigest()
