"""What the load cells show against what mass, centre of mass and attitude let expect. docs/mechanics.md (24)."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from docking.errors import BallForceTrip, BallUnloaded, LoadCellSilent, MeasuredForceTrip, MeasuredWarpTrip
from docking.geometry import exp_so3
from docking.kinematics import (
    Load,
    Positioners,
    axis_forces_n,
    ball_reactions_n,
    internal_forces_n,
    pose_from_axes,
    pose_step_matrix,
    warp_rows,
)
from docking.motion.monitors.limits import Margins, WatchLimits
from docking.motion.triggers import Finding, Trigger
from docking.types import Array

SAME_SAMPLE_S = 0.025
"""Readings nearer together than this belong to one sample: the cells of a bus do not all report in the same cycle."""
TARE_SAMPLES = 10
HELD_S = 0.15
"""So long after the commands of a held move have come to rest, the forces have, too."""
RELIEVE = "Before the move: `docking relieve` takes strain out."
CHANGED = "It changed while the axes stood: measure again."
_TURN_RAD = 1e-3


class BallLoads:
    """Judges load-cell readings (m,), force on the component along each axis, once a sample.

    `weighed` (m,) axes with a load cell. Linearised about the place given to `about`; a violation counts when two
    samples in a row show it, a silent cell at once. `force_n` and `warp_n` are the newest measured internal force (at
    the worst ball) and warp against the tare, `whole_force_n` and `whole_warp_n` as a whole; NaN before any.
    """

    def __init__(
        self, positioners: Positioners, load: Load, limits: WatchLimits, weighed: NDArray[np.bool_], margins: Margins
    ) -> None:
        self._positioners, self._load, self._limits, self._margins = positioners, load, limits, margins
        self._axes, self._weighed = positioners.axes, weighed
        self._rated_n = limits.rating * np.asarray(positioners.rated_n, dtype=np.float64).reshape(-1)
        self._whole: NDArray[np.bool_] = np.all(weighed.reshape(-1, 3), axis=1)
        self._rest: deque[Array] = deque(maxlen=TARE_SAMPLES)
        self._ready = self._relief = False
        self.forget()

    def forget(self) -> None:
        """Begin again with readings to come."""
        self._rest.clear()
        self._seen: Array | None = None
        self._seen_s = float("-inf")
        self._finding: Finding | None = None
        self._now: dict[Trigger, Finding] = {}
        self._before: dict[Trigger, Finding] = {}
        self._tare: Array | None = None
        self._stood: Array | None = None
        self.force_n = self.warp_n = self.whole_force_n = self.whole_warp_n = float("nan")

    def about(self, q_mm: Array, *, relief: bool) -> None:
        """Linearise about axis positions `q_mm` (m,) and take the tare there from the last readings at rest.

        A `relief` move starts from a strained part: there only what is added counts.
        """
        self._relief, self._stood, self._held_mm = relief, None, q_mm
        if not self._whole.any():
            return
        positioners, up = self._positioners, self._load.up
        balls = positioners.balls_C_mm
        X_WC = pose_from_axes(positioners, q_mm)
        centre = X_WC.apply(balls).mean(axis=0)
        arms, lever = X_WC.apply(balls) - centre, X_WC.apply(self._load.com_C_mm) - centre
        weight = self._load.mass_kg * self._load.gravity_m_s2

        def reactions(turn: Array) -> Array:
            R = exp_so3(turn)
            forces = ball_reactions_n(positioners, arms @ R.T, R @ lever, weight)[0]
            return axis_forces_n(positioners, forces)

        slopes = [(reactions(w) - reactions(-w)) / (2.0 * _TURN_RAD) for w in _TURN_RAD * np.eye(3)]
        self._q_mm = q_mm
        self._expected_n = reactions(np.zeros(3))
        self._per_mm = np.array(slopes).T @ pose_step_matrix(positioners, arms)[3:]
        self._resolve(arms, up)
        self._ready = True
        self._tare = np.mean([self._resolved(f, q_mm) for f in self._rest], axis=0) if self._rest else None
        self._stood = self._tare

    def _resolve(self, arms_mm: Array, up: Array) -> None:
        """Rows from axis forces (m,): ball forces in W (3k), their upward parts (k), warp (w)."""
        m = len(self._axes)
        to_ball = np.zeros((m, m))
        for i, inverse in enumerate(self._positioners.axes_inverse):
            if self._whole[i]:
                to_ball[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = inverse.T
        upward = np.einsum("c,kcm->km", up, to_ball.reshape(-1, 3, m))
        modes = warp_rows(arms_mm, up) if self._whole.all() else np.zeros((0, len(arms_mm)))
        self._rows = np.vstack([to_ball, modes @ upward])
        self._upward = upward
        self._blind = ~np.repeat(self._whole, 3)

    def _resolved(self, force_n: Array, q_ref_mm: Array) -> Array:
        """Measured less expected: ball forces in W (3k), then warp (w)."""
        beyond = internal_forces_n(force_n, self._expected_n + self._per_mm @ (q_ref_mm - self._q_mm))
        beyond[self._blind] = 0.0
        result: Array = self._rows @ beyond
        return result

    def strained(self, force_n: Array) -> Finding | None:
        """After `about`, before a move: what the part at rest shows already. Newest readings `force_n` (m,)."""
        if not self._ready or self._relief:
            return None
        reads = np.mean(self._rest, axis=0) if self._rest else force_n
        share = self._share(reads, self._q_mm, True)
        force, warp = self._sizes(self._resolved(reads, self._q_mm))
        limits = self._limits
        found = None
        if not (warp <= limits.measured_whole_warp_n):
            found = Finding(Trigger.MEASURED_WARP, _warped(RELIEVE, warp, limits.measured_whole_warp_n))
        if not (force <= limits.measured_whole_force_n):
            found = Finding(Trigger.MEASURED_FORCE, _forced(RELIEVE, force, limits.measured_whole_force_n))
        if found is None and share is not None:
            error = share.error
            cause = f"{error.cause} {RELIEVE}"
            found = Finding(share.trigger, type(error)(error.where, cause, value=error.value, limit=error.limit))
        return found

    def changed(self, force_n: Array) -> Finding | None:
        """At rest after `about` or in a hold: has the internal force at a ball changed since the axes came to rest?"""
        if self._stood is None:
            return None
        force = self._sizes(self._resolved(force_n, self._held_mm) - self._stood)[0]
        if self._margins.note("standing_force", force / self._limits.standing_force_n):
            return None
        return Finding(Trigger.MEASURED_FORCE, _forced(CHANGED, force, self._limits.standing_force_n))

    def judge(
        self, force_n: Array, t_s: float, q_ref_mm: Array, *, moving: bool, held_s: float = 0.0
    ) -> Finding | None:
        """Judge the newest readings; they count once, however often they are shown.

        `held_s`: for so long the commands of a move that is held have stood.
        """
        if moving and not held_s > HELD_S:
            self._stood, self._held_mm = None, q_ref_mm
        elif moving and self._stood is None and self._ready:
            # The first readings at rest: later ones are compared with them.
            self._stood = self._resolved(force_n, self._held_mm)
        if force_n is self._seen:
            return self._finding
        self._seen = force_n
        missing = ~np.isfinite(force_n) & self._weighed
        if missing.any():
            k = int(np.argmax(missing))
            self._finding = Finding(Trigger.FORCE_MISSING, LoadCellSilent(self._axes[k]))
            return self._finding
        if t_s - self._seen_s >= SAME_SAMPLE_S:
            self._before, self._seen_s = self._now, t_s
            if not moving:
                self._rest.append(force_n)
            else:
                self._rest.clear()
        violations = self._violations(force_n, q_ref_mm, moving)
        if held_s > HELD_S:
            changed = self.changed(force_n)
            violations += [] if changed is None else [changed]
        self._now = {finding.trigger: finding for finding in violations}
        self._finding = next((f for trigger, f in self._now.items() if trigger in self._before), None)
        return self._finding

    def _violations(self, force_n: Array, q_ref_mm: Array, moving: bool) -> list[Finding]:
        over = np.abs(force_n) / self._rated_n
        over[~self._weighed] = 0.0
        found: list[Finding] = []
        if not self._margins.note("rating", float(over.max())):
            k = int(np.argmin(over <= 1.0))
            error = BallForceTrip(self._axes[k], value=float(force_n[k]), limit=float(self._rated_n[k]))
            found.append(Finding(Trigger.OVERLOAD, error))
        if not self._ready:
            return found
        share = self._share(force_n, q_ref_mm, moving)
        return [*found, *([] if share is None else [share]), *self._internal(force_n, q_ref_mm, moving)]

    def _share(self, force_n: Array, q_ref_mm: Array, moving: bool) -> Finding | None:
        """The load of each ball against what it should carry.

        A part that a stop left strained may stand with more on a ball than its weight puts there: a relief must be able
        to begin from there, any other move is not.
        """
        expected = (self._upward @ (self._expected_n + self._per_mm @ (q_ref_mm - self._q_mm)))[self._whole]
        carried = (self._upward @ np.where(self._blind, 0.0, force_n))[self._whole]
        limits, names = self._limits, np.array(self._positioners.names)[self._whole]
        most = expected * limits.overload
        judged = moving and not self._relief
        if judged and not self._margins.note("overload", float(np.max((carried - expected) / (most - expected)))):
            k = int(np.argmin(carried <= most))
            cause = f"{expected[k]:.0f} N are expected."
            error = BallForceTrip(str(names[k]), cause, value=float(carried[k]), limit=float(most[k]))
            return Finding(Trigger.OVERLOAD, error)
        least = expected * limits.underload
        if not self._margins.note("underload", float(np.max((expected - carried) / (expected - least)))):
            k = int(np.argmin(carried >= least))
            cause = f"{expected[k]:.0f} N are expected."
            low = BallUnloaded(str(names[k]), cause, value=float(carried[k]), limit=float(least[k]))
            return Finding(Trigger.UNDERLOAD, low)
        return None

    def _internal(self, force_n: Array, q_ref_mm: Array, moving: bool) -> list[Finding]:
        """Internal force and warp, against the tare and as a whole; at rest there is nothing to stop."""
        whole = self._resolved(force_n, q_ref_mm)
        if self._tare is None:
            self._tare = whole
            self._stood = None if moving else whole
        added, limits = whole - self._tare, self._limits
        self.force_n, self.warp_n = self._sizes(added)
        self.whole_force_n, self.whole_warp_n = self._sizes(whole)
        if not moving:
            return []
        since = "Since the move was loaded."
        cases = [
            (Trigger.MEASURED_FORCE, "measured_force", self.force_n, limits.measured_force_n, since),
            (Trigger.MEASURED_WARP, "measured_warp", self.warp_n, limits.measured_warp_n, since),
        ]
        if not self._relief:
            most, twist = limits.measured_whole_force_n, limits.measured_whole_warp_n
            cases.append((Trigger.MEASURED_FORCE, "measured_whole_force", self.whole_force_n, most, "In all."))
            cases.append((Trigger.MEASURED_WARP, "measured_whole_warp", self.whole_warp_n, twist, "In all."))
        found = []
        for trigger, monitor, value, limit, cause in cases:
            if not self._margins.note(monitor, value / limit):
                error = (_forced if trigger is Trigger.MEASURED_FORCE else _warped)(cause, value, limit)
                found.append(Finding(trigger, error))
        return found

    def _sizes(self, resolved: Array) -> tuple[float, float]:
        """Largest force at a ball and largest warp, N."""
        k = 3 * len(self._whole)
        balls = np.sqrt(np.sum(resolved[:k].reshape(-1, 3) ** 2, axis=1))
        return float(balls.max()), float(np.abs(resolved[k:]).max(initial=0.0))


def _forced(cause: str, value: float, limit: float) -> MeasuredForceTrip:
    return MeasuredForceTrip("load cells", cause, value=value, limit=limit)


def _warped(cause: str, value: float, limit: float) -> MeasuredWarpTrip:
    return MeasuredWarpTrip("load cells", cause, value=value, limit=limit)
