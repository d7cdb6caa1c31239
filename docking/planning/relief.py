"""Taking internal force out of a part that a stop has left strained: what the load cells say of it, and the next step.

docs/mechanics.md (25), (26). Along the axes the internal force is the part of the measured forces that is in
equilibrium with itself, `f_int = (I - K J (J^T K J)^-1 J^T) f`: the weight drops out of it. Moving the driven axes by
`dq = -K^-1 f_int` is the gradient of the strain energy and takes away just this force: `J^T K dq = 0`, so that the
component, and every axis that only follows it, stays where it is.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from docking.errors import LoadCellSilent, PlanInputInvalid, StrokeExceeded
from docking.kinematics import Positioners, axis_forces_n, axis_jacobian, ball_reactions_n, pose_from_axes
from docking.kinematics.forces import axis_stiffness_n_per_mm
from docking.planning.jam import jam_bound
from docking.planning.preflight import check_table
from docking.planning.settings import PlanSettings
from docking.planning.time_law import quintic
from docking.types import Array, Correction, Plan, PlanBounds

_SPEED_PEAK, _ACCELERATION_PEAK, _JERK_PEAK = 15.0 / 8.0, 10.0 / sqrt(3.0), 60.0
_JERK_ROOM = 1.05
_LEAST_PERIODS = 4
_RISE_SHARE = 0.5
"""Of the room that a rise of a ball's force leaves, this much is planned for; the rest is for what the axes add."""


@dataclass(frozen=True, eq=False)
class LoadCellErrors:
    """What the readings may be wrong by, 1 sigma: `crosstalk` of the other two components of a ball, zero drift
    `drift_per_h` of `range_n` (m,) an hour, `resolution_n` of one count."""

    range_n: Array
    crosstalk: float = 0.01
    drift_per_h: float = 0.001
    resolution_n: float = 10.0

    def sigma_n(self, weighing: Weighing, hours: float = 1.0) -> Array:
        """What each reading (m,) may be wrong by after `hours` of drift, 1 sigma."""
        squares = (weighing.force_n**2).reshape(-1, 3)
        crossed = self.crosstalk * np.sqrt(squares.sum(axis=1, keepdims=True) - squares).reshape(-1)
        drift = self.drift_per_h * hours * self.range_n
        variance = crossed**2 + drift**2 + weighing.noise_n**2 + self.resolution_n**2 / 12.0
        result: Array = np.sqrt(variance)
        return result


@dataclass(frozen=True, eq=False)
class ReliefSettings:
    """`target_n` of the largest internal force at a ball, of which the fraction `aim` is aimed at; `step_mm` and
    `speed_mm_s` of any axis; `share` of the internal force that one step takes away at most; `rise` that aborts, as a
    fraction of a ball's force before; `seated_mm`: how finely axes come to rest, and how true the sockets stood to the
    balls when the part was taken; `stalled_steps` without any fall end the relief; a mode of internal force counts
    from `significant_sigmas` on; without a tare the load cells have drifted for `powered_h`; since a
    tare the weight is known to `foreign_share` of a ball's equal share.
    """

    cells: LoadCellErrors
    target_n: float = 200.0
    aim: float = 0.75
    step_mm: float = 0.05
    speed_mm_s: float = 0.1
    share: float = 0.8
    rise: float = 0.05
    seated_mm: float = 0.005
    stalled_steps: int = 3
    significant_sigmas: float = 2.0
    powered_h: float = 1.0
    foreign_share: float = 0.01


@dataclass(frozen=True, eq=False)
class Weighing:
    """Forces along the axes `force_n` (m,) averaged at standstill, the standard error `noise_n` (m,) of the average,
    and where the axes stood, `position_mm` (m,)."""

    position_mm: Array
    force_n: Array
    noise_n: Array


@dataclass(frozen=True, eq=False)
class Tare:
    """A weighing `age_h` ago, when the part was as free of strain as the take-over of its weight left it."""

    weighing: Weighing
    age_h: float


@dataclass(frozen=True, eq=False)
class Strain:
    """What a weighing says: `internal_n` (m,) internal force along the axes as far as it is told apart from the errors
    of the load cells, `ball_n` (k,) its size at each ball, `sigma_n` the uncertainty of the worst ball's, 1 sigma;
    `force_n` (k,) the whole force at each ball, `foreign_n` (k,) the part of it that weight and strain do not
    explain, `foreign_limit_n` (k,) what tolerances and load cells do."""

    internal_n: Array
    ball_n: Array
    sigma_n: float
    force_n: Array
    foreign_n: Array
    foreign_limit_n: Array

    @property
    def largest_n(self) -> float:
        """Internal force at the worst ball."""
        return float(self.ball_n.max())


class Scales:
    """Judges weighings of one standing figure: geometry, stiffness and load are fixed when it is made."""

    def __init__(self, positioners: Positioners, plan: PlanSettings, relief: ReliefSettings, q_mm: Array) -> None:
        """`q_mm` (m,): where the axes stand. Raises FrameImplausible when that is no pose of the component."""
        self._positioners, self._relief, self._load = positioners, relief, plan.load
        X_WC = pose_from_axes(positioners, q_mm)
        self._balls = X_WC.apply(positioners.balls_C_mm)
        self._coms = X_WC.apply(plan.load.com_corners_C_mm())
        stiffness = axis_stiffness_n_per_mm(positioners)
        self._to_balls = np.transpose(positioners.axes_inverse, (0, 2, 1))
        centre = self._balls.mean(axis=0)
        jac = axis_jacobian(positioners, self._balls, centre)
        jac[:, 3:] /= np.linalg.norm(self._balls - centre, axis=1).max()
        spring = stiffness[:, None] * jac
        self._rigid = spring @ np.linalg.solve(jac.T @ spring, jac.T)
        self._projector = np.eye(len(stiffness)) - self._rigid
        driven = np.flatnonzero(positioners.driven)
        self._basis = np.zeros((len(stiffness), len(driven) - 6))
        self._basis[driven] = np.linalg.svd(jac[driven])[0][:, 6:]
        self._stiffness = stiffness

    def strain(self, weighing: Weighing, tare: Tare | None) -> Strain:
        """Internal force of `weighing`; where a `tare` is known, what the load cells add by themselves is taken off.

        Each reading r holds the load cell's own error b. At the tare the internal force a was no more than the seating
        of the axes explains (p = K seated), so b is estimated as a sigma^2 / (sigma^2 + p^2): almost nothing for a
        vertical axis, whose cross-talk is small, almost all of a for a level axis beside 15 kN of weight.
        """
        if not np.all(np.isfinite(weighing.force_n)):
            axis = self._positioners.axes[int(np.argmax(~np.isfinite(weighing.force_n)))]
            raise LoadCellSilent(axis, "The internal force is not known without it.")
        sigma = self._relief.cells.sigma_n(weighing, self._relief.powered_h)
        bias = np.zeros_like(sigma)
        rest = sigma
        if tare is not None:
            bias, rest = self._own_error(tare, weighing)
        internal = self._projector @ (weighing.force_n - bias - self._positioners.held_n)
        told, spread = self._told_apart(internal, rest)
        foreign, limit = self._foreign(weighing, tare)
        return Strain(
            internal_n=told,
            ball_n=np.linalg.norm(self.at_balls(told), axis=1),
            sigma_n=spread,
            force_n=np.linalg.norm(self.at_balls(weighing.force_n), axis=1),
            foreign_n=foreign,
            foreign_limit_n=limit,
        )

    def at_balls(self, axis_forces_n: Array) -> Array:
        """Ball forces (k, 3) in W of forces along the axes (m,)."""
        result: Array = np.einsum("kij,kj->ki", self._to_balls, axis_forces_n.reshape(-1, 3))
        return result

    def floor_n(self) -> Array:
        """Change of each ball's force (k,) that axes coming to rest anew explain, 2 sigma."""
        stiffest = self._stiffness.reshape(-1, 3).max(axis=1)
        result: Array = 2.0 * self._relief.seated_mm * stiffest
        return result

    def rise_limit_n(self, before: Strain) -> Array:
        """How far each ball's force (k,) may rise over what it was in `before`."""
        result: Array = np.maximum(self._relief.rise * before.force_n, self.floor_n())
        return result

    def step_mm(self, strain: Strain, weighing: Weighing) -> Array:
        """The next displacement of every axis (m,): down the gradient, within the step and the rise of any ball."""
        stiffness = np.where(self._stiffness > 0.0, self._stiffness, np.inf)
        whole = -self._relief.share * strain.internal_n / stiffness
        largest = float(np.abs(whole).max())
        if not largest > 0.0:
            return whole
        after = np.linalg.norm(self.at_balls(weighing.force_n + self._stiffness * whole), axis=1)
        rise = np.maximum(after - strain.force_n, 1e-9)
        room = _RISE_SHARE * self.rise_limit_n(strain)
        # The size of a sum is convex: a part of the step raises no force by more than that part of the rise.
        result: Array = whole * min(1.0, self._relief.step_mm / largest, float(np.min(room / rise)))
        return result

    def _own_error(self, tare: Tare, now: Weighing) -> tuple[Array, Array]:
        """What the load cells add by themselves (m,), and what is left uncertain of the readings `now` (m,)."""
        sigma = self._relief.cells.sigma_n(tare.weighing, self._relief.powered_h)
        seated = np.maximum(self._relief.seated_mm * self._stiffness, 1e-9)
        trust = sigma**2 / (sigma**2 + seated**2)
        bias = trust * (self._projector @ (tare.weighing.force_n - self._positioners.held_n))
        moved = Weighing(now.position_mm, now.force_n - tare.weighing.force_n, now.noise_n)
        left = np.sqrt(trust * seated**2 + self._relief.cells.sigma_n(moved, tare.age_h) ** 2)
        return bias, np.minimum(left, self._relief.cells.sigma_n(now, self._relief.powered_h))

    def _told_apart(self, internal_n: Array, sigma_n: Array) -> tuple[Array, float]:
        """The modes of internal force that are larger than their uncertainty explains (m,), and the spread that is
        left at the worst ball. Readings that are only errors of a load cell must not move an axis."""
        seen = self._basis.T @ self._projector * sigma_n
        variances, turn = np.linalg.eigh(seen @ seen.T)
        modes = self._basis @ turn
        amounts = modes.T @ internal_n
        sure = np.abs(amounts) > self._relief.significant_sigmas * np.sqrt(variances)
        told: Array = modes @ np.where(sure, amounts, 0.0)
        spread = (self._projector * sigma_n).reshape(-1, 3, len(sigma_n))
        return told, float(np.sqrt((spread**2).sum(axis=(1, 2)).max()))

    def _foreign(self, now: Weighing, tare: Tare | None) -> tuple[Array, Array]:
        """The part of each ball's force (k,) that neither weight nor strain explains, and its limit (k,).

        With a tare only what has changed since then counts: the weight itself, and what the load cells add, drop out.
        """
        expected = self._expected_n(now.position_mm)
        if tare is None:
            change, sigma = now.force_n - expected, self._relief.cells.sigma_n(now, self._relief.powered_h)
            tolerance = self._load_tolerance_n()
        else:
            before = tare.weighing
            change = now.force_n - before.force_n - expected + self._expected_n(before.position_mm)
            moved = Weighing(now.position_mm, now.force_n - before.force_n, now.noise_n)
            sigma = np.hypot(self._relief.cells.sigma_n(moved, tare.age_h), before.noise_n)
            share = self._load.mass_kg * float(np.linalg.norm(self._load.gravity_m_s2)) / len(self._balls)
            tolerance = np.full(len(self._balls), self._relief.foreign_share * share)
        spread = (self._rigid * sigma).reshape(-1, 3, len(sigma))
        limit: Array = tolerance + 3.0 * np.sqrt((spread**2).sum(axis=(1, 2)))
        return np.linalg.norm(self.at_balls(self._rigid @ change), axis=1), limit

    def _expected_n(self, q_mm: Array) -> Array:
        """Forces along the axes (m,) that the weight needs with the axes at `q_mm` (m,)."""
        positioners, load = self._positioners, self._load
        X_WC = pose_from_axes(positioners, q_mm)
        balls, com = X_WC.apply(positioners.balls_C_mm), X_WC.apply(load.com_C_mm)
        reactions = ball_reactions_n(positioners, balls, com, load.mass_kg * load.gravity_m_s2)[0]
        return axis_forces_n(positioners, reactions)

    def _load_tolerance_n(self) -> Array:
        """How far each ball's force (k,) may be from the expected by the tolerances of mass and centre of mass."""
        positioners, load = self._positioners, self._load
        nominal = ball_reactions_n(positioners, self._balls, self._coms[0], load.mass_kg * load.gravity_m_s2)
        corners = ball_reactions_n(positioners, self._balls, self._coms, load.heaviest_n)
        result: Array = np.linalg.norm(corners - nominal, axis=2).max(axis=0)
        return result


@dataclass(frozen=True, eq=False)
class StepRequest:
    """One step to plan: from the commanded positions `q_now_mm` (m,) by `step_mm` (m,), on the bus's `period_s`."""

    plan_id: int
    q_now_mm: Array
    step_mm: Array
    period_s: float


def relief_plan(request: StepRequest, positioners: Positioners, settings: PlanSettings, relief: ReliefSettings) -> Plan:
    """A straight step of single axes as a plan of kind `relief`. Raises StrokeExceeded, AxisLimitExceeded, and
    PlanInputInvalid for a step that is no number or longer than a relief may go."""
    largest = float(np.abs(request.step_mm).max())
    if not largest <= relief.step_mm * (1.0 + 1e-9):
        raise PlanInputInvalid("relief step", value=largest, limit=f"at most {relief.step_mm} mm")
    room = _check_ends(request, positioners, settings.stroke_margin_mm)
    duration_s, limited_by = _duration_s(np.abs(request.step_mm), positioners, settings, relief.speed_mm_s)
    periods = max(_LEAST_PERIODS, ceil(duration_s / request.period_s - 1e-9))
    t_s = request.period_s * np.arange(periods + 1, dtype=np.float64)
    s = quintic(float(t_s[-1])).at(t_s)
    q = request.q_now_mm + s[:, None] * request.step_mm
    peak = check_table(s, q, request.period_s, positioners)
    return Plan(
        plan_id=request.plan_id,
        plan_hash=_hash(request, q),
        stage="relief",
        kind="relief",
        axes=positioners.axes,
        period_s=request.period_s,
        t_s=t_s,
        s=s,
        q_mm=q,
        correction=Correction(np.zeros(3), np.zeros(3), np.zeros(3)),
        chord_error_mm=0.0,
        rate_slew_per_s=_rate_slew_per_s(peak, positioners, settings),
        speed_limited_by=limited_by,
        margins=tuple(
            (axis, float(room[k]), float(positioners.v_mm_s[k] - peak[k])) for k, axis in enumerate(positioners.axes)
        ),
        bounds=_bounds(request, peak, (limited_by, float(t_s[-1])), positioners, settings),
    )


def _bounds(
    request: StepRequest, peak: Array, pace: tuple[str, float], positioners: Positioners, settings: PlanSettings
) -> PlanBounds:
    """What a jammed axis would cost. A straight step has no chord error, and what the mate asks is not its concern."""
    jam = jam_bound(positioners, request.q_now_mm, settings.jam, settings.load.up)
    return PlanBounds(
        peak_mm_s=peak,
        quick_stop_s=jam.quick_stop_s(peak),
        jam_mm=jam.jam_mm(peak),
        jam_n=jam.jam_n(peak),
        jam_warp_n=jam.jam_warp_n(peak),
        ramp_mm=jam.ramp_mm(peak),
        residual_mm=0.0,
        force_n=0.0,
        warp_n=0.0,
        clearance_mm=float("nan"),
        clearance_asked_mm=float("nan"),
        clearance_s=float("nan"),
        duration_s=pace[1],
        limits=((pace[0], 1.0),),
    )


def _check_ends(request: StepRequest, positioners: Positioners, margin_mm: float) -> Array:
    """Least room of each axis to its stroke ends (m,): on a straight step it is at one of its two ends."""
    low, high = positioners.stroke_mm.T
    before = np.minimum(request.q_now_mm - low, high - request.q_now_mm)
    q_end = request.q_now_mm + request.step_mm
    after = np.minimum(q_end - low, high - q_end)
    for k in np.flatnonzero(~((after >= margin_mm) | (after >= before))):
        end = low[k] + margin_mm if q_end[k] - low[k] < high[k] - q_end[k] else high[k] - margin_mm
        raise StrokeExceeded(positioners.axes[k], "At the end of the step.", value=float(q_end[k]), limit=float(end))
    result: Array = np.minimum(before, after)
    return result


def _duration_s(
    travel_mm: Array, positioners: Positioners, settings: PlanSettings, speed_mm_s: float
) -> tuple[float, str]:
    """Shortest quintic within the speed of a relief and the limits of every axis; docs/mechanics.md (33)."""
    share = settings.acceleration_share
    acceleration = np.sqrt(_ACCELERATION_PEAK * travel_mm / (share * positioners.a_mm_s2))
    jerk = _JERK_ROOM * np.cbrt(_JERK_PEAK * travel_mm / positioners.j_mm_s3)
    found = [(float(_SPEED_PEAK * travel_mm.max() / speed_mm_s), "speed of the relief")]
    for what, needed in (("acceleration", acceleration), ("jerk", jerk)):
        found.append((float(needed.max()), f"{positioners.axes[int(needed.argmax())]} {what}"))
    return max(found)


def _rate_slew_per_s(peak_mm_s: Array, positioners: Positioners, settings: PlanSettings) -> float:
    if settings.playback_ramp_s > 0.0:
        return 1.0 / settings.playback_ramp_s
    spare = (1.0 - settings.acceleration_share) * positioners.a_mm_s2 / np.maximum(peak_mm_s, 1e-9)
    return min(float(spare.min()), settings.rate_slew_max_per_s)


def _hash(request: StepRequest, q_mm: Array) -> str:
    """SHA-256 over everything that decides what the axes will do."""
    digest = hashlib.sha256(f"{request.plan_id}\x1frelief\x1f{request.period_s!r}".encode())
    digest.update(np.ascontiguousarray(q_mm, dtype="<f8").data)
    return digest.hexdigest()
