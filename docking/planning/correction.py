"""From where the component is and where it should be to the move that is asked, and whether to ask for one at all.

docs/mechanics.md (27) to (29), (49) and (50). Correction = goal times measured^-1, told about the centre of the docking
face: about a distant origin a small rotation would read as a large shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from math import degrees

import numpy as np
from numpy.typing import ArrayLike

from docking.errors import (
    CorrectionTooLarge,
    Diverging,
    IterationsExhausted,
    PlanError,
    RiskTooHigh,
    ToleranceUnprovable,
)
from docking.geometry import exp_so3, log_so3
from docking.types import RISK_LIMIT, Array, Correction, FeatureErrors, Pose


def correction_to(X_WC: Pose, X_WG: Pose, pivot_C_mm: ArrayLike) -> Correction:
    """The displacement in W that takes the component from X_WC to X_WG, about its point `pivot_C_mm` (3,)."""
    pivot = X_WC.apply(pivot_C_mm)
    return Correction(pivot, log_so3(X_WG.R @ X_WC.R.T), X_WG.apply(pivot_C_mm) - pivot)


def displaced(correction: Correction, points_W_mm: ArrayLike) -> Array:
    """Points (..., 3) of the component in W after the correction: c + shift + dR (p - c); equation (28)."""
    arm = np.asarray(points_W_mm, dtype=np.float64) - correction.pivot_W_mm
    result: Array = arm @ exp_so3(correction.rotvec_rad).T + correction.pivot_W_mm + correction.shift_mm
    return result


@dataclass(frozen=True)
class GuardSettings:
    """Largest correction believed. First: `first_mm` and `first_rad`. At a later station with gap g to the mate:
    min(station_max_mm, max(station_min_mm, station_gap_fraction g), rotations as mm at the arm `lever_mm`."""

    first_mm: float = 50.0
    first_rad: float = float(np.deg2rad(2.0))
    station_min_mm: float = 0.5
    station_max_mm: float = 4.0
    station_gap_fraction: float = 0.2
    lever_mm: float = 3000.0

    def station_limit_mm(self, gap_mm: float) -> float:
        """The guard at a station `gap_mm` before the mate."""
        return min(self.station_max_mm, max(self.station_min_mm, self.station_gap_fraction * gap_mm))


def check_correction(correction: Correction, settings: GuardSettings, stage: str, gap_mm: float | None = None) -> None:
    """Raise CorrectionTooLarge over the guard; `gap_mm` None is the first correction of a docking.

    Pass the correction towards the goal of the station the component stands at, without the approach to the next one.
    """
    shift = float(np.linalg.norm(correction.shift_mm))
    angle = float(np.linalg.norm(correction.rotvec_rad))
    limit_mm, limit_rad = settings.first_mm, settings.first_rad
    if gap_mm is not None:
        limit_mm = settings.station_limit_mm(gap_mm)
        limit_rad = limit_mm / settings.lever_mm
    if not shift <= limit_mm:
        raise CorrectionTooLarge(stage, "Shift in mm.", value=shift, limit=limit_mm)
    if not angle <= limit_rad:
        raise CorrectionTooLarge(stage, "Rotation in deg.", value=degrees(angle), limit=degrees(limit_rad))


class Action(Enum):
    """What the convergence loop does next."""

    DONE = "done"
    MOVE = "move"
    MEASURE_MORE = "measure more"
    OUT_OF_TOLERANCE = "out of tolerance"
    ABORT = "abort"


@dataclass(frozen=True)
class Attempt:
    """One look at the features: after how many corrections at this station, from how many passes, and the feature
    with the largest e + 2 sigma: error, sigma, tolerance. `accepted`: every feature has e + 2 sigma <= tolerance."""

    corrections: int
    passes: int
    error_mm: float
    sigma_mm: float
    tolerance_mm: float
    accepted: bool
    risk: float = 0.0


def attempt(errors: FeatureErrors, corrections: int, passes: int) -> Attempt:
    """The attempt that `errors` stand for."""
    i = errors.worst()
    numbers = float(errors.norm_mm[i]), float(errors.sigma_mm[i]), float(errors.tolerance_mm[i])
    return Attempt(corrections, passes, *numbers, errors.accepted(), errors.risk)


@dataclass(frozen=True)
class ConvergenceSettings:
    """`max_corrections` moves at one station; an error below the dead-band,
    min(dead_band_mm, dead_band_fraction tol), is not worth one."""

    max_corrections: int = 5
    max_passes: int = 6
    dead_band_mm: float = 0.05
    dead_band_fraction: float = 0.25


@dataclass(frozen=True)
class Verdict:
    """What to do and why, with the numbers to report; `error` is what to raise for out of tolerance and abort."""

    action: Action
    reason: str
    corrections: int
    max_corrections: int
    error_mm: float
    sigma_mm: float
    tolerance_mm: float
    error: PlanError | None = None


def decide(history: Sequence[Attempt], settings: ConvergenceSettings, stage: str = "station") -> Verdict:
    """What to do after the last of `history` (at least one attempt, oldest first); equation (50).

    An error counts as worse only when it grew by more than its sigma: the noise floor makes small errors wander.
    An error inside its sigma is measured more before it is moved for, as long as passes are left.
    """
    last = history[-1]

    def verdict(action: Action, reason: str, error: PlanError | None = None) -> Verdict:
        numbers = last.corrections, settings.max_corrections, last.error_mm, last.sigma_mm, last.tolerance_mm
        return Verdict(action, reason, *numbers, error)

    if last.accepted:
        return verdict(Action.DONE, "e + 2 sigma inside the tolerance at every feature")
    if not np.isfinite(last.error_mm + last.sigma_mm):
        return verdict(Action.ABORT, "error or sigma unknown", ToleranceUnprovable(stage, value=last.error_mm))
    dead_band = min(settings.dead_band_mm, settings.dead_band_fraction * last.tolerance_mm)
    if last.error_mm < max(dead_band, last.sigma_mm) and last.passes < settings.max_passes:
        return verdict(Action.MEASURE_MORE, "the error is too small to move for, its sigma too large to accept")
    if last.error_mm < dead_band:
        return verdict(
            Action.OUT_OF_TOLERANCE, "inside the dead-band, and all passes are spent", _unprovable(last, stage)
        )
    before = _error_before_worse_twice(history)
    if before is not None:
        return verdict(Action.ABORT, "worse twice", Diverging(stage, value=last.error_mm, limit=before))
    if last.corrections >= settings.max_corrections:
        exhausted = IterationsExhausted(stage, value=last.corrections, limit=settings.max_corrections)
        return verdict(Action.OUT_OF_TOLERANCE, "corrections are spent", exhausted)
    return verdict(Action.MOVE, "a correction is worth making")


def _unprovable(last: Attempt, stage: str) -> PlanError:
    """Why an error too small to move for is not accepted: its own bound, else the risk of all features together."""
    bound = last.error_mm + 2.0 * last.sigma_mm
    if not (bound <= last.tolerance_mm):
        return ToleranceUnprovable(stage, value=bound, limit=last.tolerance_mm)
    return RiskTooHigh(stage, value=round(100.0 * last.risk, 2), limit=100.0 * RISK_LIMIT)


def _error_before_worse_twice(history: Sequence[Attempt]) -> float | None:
    """The error two corrections ago when both corrections since made it worse, else None."""
    latest = list({a.corrections: a for a in history}.values())[-3:]
    if len(latest) < 3:
        return None
    worse = all(after.error_mm > before.error_mm + after.sigma_mm for before, after in pairwise(latest))
    return latest[0].error_mm if worse else None
