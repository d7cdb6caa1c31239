"""The way to the mate: clearance of the whole move, the corridor of the insertion, the order of the stations.

docs/mechanics.md (45) to (48). The gap g of a pose is how far the docking face stands before its docked place along the
insertion axis. What the drives do when they miss their SYNC is part of the move: from every sample they may go straight
on at their speed for `coast_s` and half the common ramp.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from docking.errors import ApproachRefused, MateTooNear
from docking.geometry import exp_so3
from docking.planning.clearance import Nearest, Rows, nearest, nearest_on_way
from docking.planning.path import CarriedPoints, carried_points
from docking.planning.settings import MateSettings
from docking.planning.time_law import TimeLaw
from docking.types import Array, Correction, Pose

SAMPLE_MM = 0.5
_LEAST_SAMPLES = 33
_OFF_SAMPLES = 257
_ROUNDING_MM = 1e-6


@dataclass(frozen=True, eq=False)
class Scene:
    """Where the parts are: the component `X_WC` at the start of the move, the mate `X_WM`, the component's docked pose
    `X_WG`. `standoff_mm` of the station the move leads to, `from_standoff_mm` of the one before it (inf: none)."""

    X_WC: Pose
    X_WM: Pose
    X_WG: Pose
    standoff_mm: float
    from_standoff_mm: float = float("inf")


@dataclass(frozen=True)
class Clearance:
    """Where the distance to the mate least exceeds what is asked; NaN where neither outline nor envelope is given."""

    distance_mm: float = float("nan")
    asked_mm: float = float("nan")
    s: float = float("nan")


@dataclass(frozen=True, eq=False)
class _Samples:
    """The move at samples (p,): s, gap, and the way each point goes on: seconds of coasting times ds/dt."""

    s: Array
    gap_mm: Array
    carry: Array


def check_mate(
    scene: Scene, correction: Correction, law: TimeLaw, mate: MateSettings, quick_stop_s: float
) -> Clearance:
    """Check order, corridor and clearance of a timed move. `quick_stop_s`: the common ramp of all axes.

    Raises ApproachRefused, MateTooNear.
    """
    axis_W = scene.X_WM.R @ mate.axis_M
    face = carried_points(correction, scene.X_WC.apply(mate.face_C_mm))
    samples = _samples(face, correction, scene, law, mate, quick_stop_s, axis_W)
    _check_order(samples, scene, mate)
    points_C = _outline_C(mate)
    edges = carried_points(correction, scene.X_WC.apply(points_C))
    _check_corridor(edges, points_C, samples, scene, mate, axis_W)
    if not (len(mate.edges_C_mm) and len(mate.boxes_M_mm)):
        return Clearance()
    return _check_clearance(edges, samples, scene, mate, axis_W)


def _samples(
    face: CarriedPoints, correction: Correction, scene: Scene, law: TimeLaw, mate: MateSettings,
    quick_stop_s: float, axis_W: Array,
) -> _Samples:  # fmt: skip
    """At least one sample per `SAMPLE_MM` of the way of the outline, both ends included."""
    reach = mate.edges_C_mm.reshape(-1, 3) if len(mate.edges_C_mm) else mate.face_C_mm[None, :]
    ends = np.linalg.norm(carried_points(correction, scene.X_WC.apply(reach)).rate(np.array([0.0, 1.0])), axis=-1)
    count = max(_LEAST_SAMPLES, ceil(float(ends.max()) / SAMPLE_MM) + 1)
    s = np.linspace(0.0, 1.0, count)
    along, rate = law.samples(2 * count)[:2]
    ds_dt = np.interp(s, along, rate)
    gap = (scene.X_WG.apply(mate.face_C_mm) - face.at(s)) @ axis_W
    coast_s = mate.coast_s + 0.5 * quick_stop_s if mate.coast_s > 0.0 else 0.0
    return _Samples(s, gap, ds_dt * coast_s)


def _check_order(samples: _Samples, scene: Scene, mate: MateSettings) -> None:
    """A move to a station starts at that station or the one before it, and never passes beyond its own."""
    start, slack = float(samples.gap_mm[0]), mate.corridor_mm
    if not start <= scene.from_standoff_mm + slack:
        cause = f"Gap at the start; the station before is at {scene.from_standoff_mm:g} mm: stations go in order."
        raise ApproachRefused("order of the stations", cause, value=start, limit=scene.from_standoff_mm + slack)
    least = float(samples.gap_mm.min())
    bound = min(start, scene.standoff_mm) - slack
    if not least >= bound:
        s = float(samples.s[int(np.argmin(samples.gap_mm))])
        cause = f"Least gap, at s = {s:.3f}; the move leads to {scene.standoff_mm:g} mm and may not pass beyond."
        raise ApproachRefused("order of the stations", cause, value=least, limit=bound)


def _check_corridor(
    edges: CarriedPoints, points_C: Array, samples: _Samples, scene: Scene, mate: MateSettings, axis_W: Array
) -> None:
    """Inside the corridor's length every point is where the straight insertion has it at that gap, +- corridor_mm."""
    inside = np.flatnonzero(samples.gap_mm <= mate.corridor_length_mm)
    if len(inside) == 0:
        return
    away = _away_mm(edges.at(samples.s[inside]), points_C, samples.gap_mm[inside], scene, axis_W)
    closing = float(samples.gap_mm[0] - samples.gap_mm.min())
    leaves = bool(inside[-1] < len(samples.gap_mm) - 1)
    back = _only_back(away - mate.corridor_mm, leaves=leaves) and closing <= mate.contact_mm
    if back or np.all(away <= mate.corridor_mm):
        return
    i = int(np.argmax(away))
    s, gap = float(samples.s[inside[i]]), float(samples.gap_mm[inside[i]])
    cause = (
        f"Way off the straight insertion at s = {s:.3f}, {gap:.4g} mm before the mate; up to "
        f"{mate.corridor_length_mm:g} mm before it, {mate.corridor_mm:g} mm fit."
    )
    raise ApproachRefused("corridor", cause, value=float(away[i]), limit=mate.corridor_mm)


def _away_mm(places: Array, points_C: Array, gap_mm: Array, scene: Scene, axis_W: Array) -> Array:
    """How far the worst of the points at `places` (p, e, 2, 3) is from the straight insertion at each gap (p,)."""
    straight = scene.X_WG.apply(points_C) - gap_mm[:, None, None, None] * axis_W
    worst: Array = np.linalg.norm(places - straight, axis=-1).max(axis=(1, 2))
    return worst


def gap_mm(scene: Scene, mate: MateSettings) -> float:
    """How far the docking face stands before its docked place along the insertion axis, at the start of the move."""
    away = scene.X_WG.apply(mate.face_C_mm) - scene.X_WC.apply(mate.face_C_mm)
    return float(away @ (scene.X_WM.R @ mate.axis_M))


def off_straight_mm(scene: Scene, correction: Correction, mate: MateSettings) -> float:
    """Farthest that the move takes a point of the outline off the straight insertion, inside the corridor's length."""
    axis_W = scene.X_WM.R @ mate.axis_M
    points_C = _outline_C(mate)
    s = np.linspace(0.0, 1.0, _OFF_SAMPLES)
    face = carried_points(correction, scene.X_WC.apply(mate.face_C_mm))
    gap = (scene.X_WG.apply(mate.face_C_mm) - face.at(s)) @ axis_W
    inside = np.flatnonzero(gap <= mate.corridor_length_mm)
    if len(inside) == 0:
        return 0.0
    places = carried_points(correction, scene.X_WC.apply(points_C)).at(s[inside])
    return float(_away_mm(places, points_C, gap[inside], scene, axis_W).max())


def _outline_C(mate: MateSettings) -> Array:
    """Edges (e, 2, 3) in C to look at: the docking face's centre where no outline is given."""
    return mate.edges_C_mm if len(mate.edges_C_mm) else np.broadcast_to(mate.face_C_mm, (1, 2, 3))


def _only_back(over_mm: Array, *, leaves: bool) -> bool:
    """True when what is over its limit was so from the start, never grows, and shrinks or leaves the corridor."""
    excess = np.maximum(over_mm, 0.0)
    falls = leaves or bool(excess[-1] < excess[0])
    return bool(excess[0] > 0.0 and falls and np.all(np.diff(excess) <= _ROUNDING_MM))


def _check_clearance(
    edges: CarriedPoints, samples: _Samples, scene: Scene, mate: MateSettings, axis_W: Array
) -> Clearance:
    """Clearance on the path, and where the drives could carry the part from it."""
    to_M = scene.X_WM.inverse()
    asked = _asked(samples.gap_mm, mate)
    found = nearest_on_way(
        lambda rows: to_M.apply(edges.at(samples.s[rows])), mate.boxes_M_mm, asked, _reach(edges, samples, asked)
    )
    if not found.excess_mm >= 0.0:
        _refuse_unless_leaving(found, to_M.apply(edges.at(samples.s)), samples, mate)
    if np.any(samples.carry > 0.0):
        carried = _coasting(edges, samples, to_M, mate, axis_W)
        if not carried.excess_mm >= min(0.0, found.excess_mm):
            _refuse_coasting(carried, to_M.apply(edges.at(samples.s)), samples, mate)
        found = min(found, carried, key=lambda place: place.excess_mm)
    return Clearance(found.distance_mm, found.distance_mm - found.excess_mm, float(samples.s[found.row]))


def _coasting(edges: CarriedPoints, samples: _Samples, to_M: Pose, mate: MateSettings, axis_W: Array) -> Nearest:
    """Where the drives could carry the part from every sample."""

    def places(rows: Rows) -> Array:
        s, carry = samples.s[rows], samples.carry[rows, None, None, None]
        return to_M.apply(edges.at(s) + carry * edges.rate(s))

    middle = CarriedPoints(edges.start_mm.mean(axis=(0, 1)), edges.rows.mean(axis=(1, 2)), edges.angle_rad)
    closing = samples.carry * (middle.rate(samples.s) @ axis_W)
    asked = _asked(samples.gap_mm - closing, mate)
    return nearest_on_way(places, mate.boxes_M_mm, asked, _reach(edges, samples, asked))


def _reach(edges: CarriedPoints, samples: _Samples, asked_mm: Array) -> float:
    """Most that distance less asked changes between two samples: the way of the fastest point, coasting included."""
    fastest = float(np.linalg.norm(edges.rows[0], axis=-1).max())
    fastest += edges.angle_rad * float(np.linalg.norm(edges.rows[2], axis=-1).max())
    step = float(np.diff(samples.s).max())
    on = step * (1.0 + edges.angle_rad * float(samples.carry.max())) + float(np.abs(np.diff(samples.carry)).max())
    return fastest * on + float(np.abs(np.diff(asked_mm)).max())


def _asked(gap_mm: Array, mate: MateSettings) -> Array:
    """Clearance asked at each gap (p,); past the mate's face no more than contact is forgiven."""
    result: Array = np.minimum(mate.clearance_mm, 0.5 * np.maximum(gap_mm, 0.0)) - mate.contact_mm
    return result


def _refuse_unless_leaving(found: Nearest, edges_M: Array, samples: _Samples, mate: MateSettings) -> None:
    """A part that starts too near may only move away: its least excess never falls."""
    excess = np.array([nearest(edges_M[i : i + 1], mate.boxes_M_mm, _asked(samples.gap_mm[i : i + 1], mate)).excess_mm
                       for i in np.linspace(0, len(samples.s) - 1, _LEAST_SAMPLES).round().astype(int)])  # fmt: skip
    if excess[0] < 0.0 and np.all(np.diff(excess) >= -_ROUNDING_MM) and found.excess_mm >= excess[0] - _ROUNDING_MM:
        return
    fits = float(samples.s[max(found.row - 1, 0)]) if excess[0] >= 0.0 else 0.0
    cause = f"At s = {samples.s[found.row]:.3f}, edge {found.edge} of the outline; up to s = {fits:.3f} it may fit."
    asked = found.distance_mm - found.excess_mm
    raise MateTooNear(f"box {found.box} of the mate", cause, value=found.distance_mm, limit=asked)


def _refuse_coasting(carried: Nearest, edges_M: Array, samples: _Samples, mate: MateSettings) -> None:
    """Name the share of the speed with which the coasting would still be clear."""
    i = carried.row
    resting = nearest(edges_M[i : i + 1], mate.boxes_M_mm, _asked(samples.gap_mm[i : i + 1], mate)).excess_mm
    share = max(resting, 0.0) / max(resting - carried.excess_mm, 1e-9)
    cause = (
        f"From s = {samples.s[i]:.3f} on, if the drives lose their SYNC and coast; {100.0 * share:.0f} % of the speed "
        "there would fit."
    )
    asked = carried.distance_mm - carried.excess_mm
    raise MateTooNear(f"box {carried.box} of the mate", cause, value=carried.distance_mm, limit=asked)


def outline_edges(rings: tuple[Array, ...]) -> Array:
    """Straight pieces (e, 2, 3) of closed polylines, each (n, 3)."""
    if not rings:
        return np.zeros((0, 2, 3))
    return np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])


def moved_pose(X_WC: Pose, correction: Correction) -> Pose:
    """The component's pose after `correction`."""
    turn = exp_so3(correction.rotvec_rad)
    arm = X_WC.t_mm - correction.pivot_W_mm
    return Pose(turn @ X_WC.R, correction.pivot_W_mm + correction.shift_mm + turn @ arm)
