"""Decoupled or coupled? [Zhao]'s rule by correlation, and the better one by what each form predicts.

The covariance of a free INS position after t seconds (constant attitude and force f in the sensor's axes):

    S(t) = (t^2/2)^2 C Sa C^T + (t^3/6)^2 [Cf]x C Sg C^T [Cf]x^T + (t^2/2)^2 [Cf]x Sth [Cf]x^T

r_ij = S_ij / sqrt(S_ii S_jj). The rule as printed: coupled where any r is not 0. With estimates r is never 0, so a
threshold stands for 0; and it is free of scale: a level sensor with like biases has r = 0 although its unknown rate
bias costs most of the accuracy. What decides here is whether the coupled form would be less uncertain after the gap;
r and the verdict of the printed rule are told beside it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from docking.tracking.recording import Recording
from docking.tracking.repaired import tilt_growth_mm
from docking.tracking.replay import first_known, start_of
from docking.tracking.types import MM_PER_M, InertialModel
from docking.types import Array

LEAST_R, LEAST_GAIN = 0.1, 0.9


class Uncertainty(NamedTuple):
    """What an INS starts with, each (3, 3): force bias (m/s^2)^2, rate bias (rad/s)^2 in I, attitude rad^2 in W."""

    force: Array
    rate: Array
    attitude: Array


def ins_cov_mm2(C_WI: Array, force_m_s2: Array, known: Uncertainty, t_s: float) -> Array:
    """S(t) (3, 3) of a free INS position."""
    x, y, z = (C_WI @ force_m_s2).tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    a, b = 0.5 * t_s * t_s, t_s**3 / 6.0
    turned = C_WI @ known.rate @ C_WI.T
    S = a * a * C_WI @ known.force @ C_WI.T + b * b * cross @ turned @ cross.T
    result: Array = MM_PER_M**2 * (S + a * a * cross @ known.attitude @ cross.T)
    return result


def largest_r(cov_mm2: Array) -> float:
    """max |r| over the pairs of axes."""
    sd = np.sqrt(np.diag(cov_mm2))
    r = np.abs(cov_mm2 / np.outer(sd, sd))
    return float(np.max(r - np.diag(np.diag(r))))


class Choice(NamedTuple):
    """`method` and the figures that led to it: `r` largest correlation and the form that the printed rule picks by it,
    predicted sd of both forms after the gap (mm), `why` in words."""

    method: str
    r: float
    printed_rule: str
    decoupled_sd_mm: float
    coupled_sd_mm: float
    why: str

    def as_json(self) -> dict[str, Any]:
        """The figures as plain numbers; None where one does not apply."""
        return {key: None if value != value else value for key, value in self._asdict().items()}


def choose(recording: Recording, model: InertialModel, gap_s: float) -> Choice:
    """Which method bridges gaps of `gap_s` best, as predicted before anything is run."""
    nan = float("nan")
    if len(recording.encoder_t_s):
        return Choice("encoders", nan, "", nan, nan, "encoders bridge a gap better than any inertial sensor")
    start = start_of(recording)
    C = (np.eye(3) if start is None else start.R_WB) @ recording.body.X_BI.R
    tilt, heading = (0.01, 0.05) if start is None else (start.tilt_sd_rad, start.heading_sd_rad)
    begin = int(np.searchsorted(recording.imu_t_s, recording.frame_t_s[first_known(recording)]))
    force = recording.force_m_s2[begin:].mean(axis=0)
    loose = Uncertainty(
        model.force_bias**2 * np.eye(3), model.rate_bias**2 * np.eye(3), np.diag([tilt**2, tilt**2, heading**2])
    )
    r = largest_r(ins_cov_mm2(C, force, loose, gap_s))
    decoupled, coupled = predicted_sd_mm(model, gap_s)
    better, printed = coupled < LEAST_GAIN * decoupled, "coupled" if r > LEAST_R else "decoupled"
    sizes = f"{decoupled:.3g} mm decoupled, {coupled:.3g} mm coupled"
    why = f"predicted sd after {gap_s:g} s: {sizes}; |r| {r:.2f}: {printed} by the printed rule"
    return Choice("ins" if better else "repaired", r, printed, decoupled, coupled, why)


def predicted_sd_mm(model: InertialModel, gap_s: float) -> tuple[float, float]:
    """3-D sd (mm) after a gap of the decoupled and of the coupled form, once both have settled.

    Both carry white force noise, Na sqrt(t^3/3), and the white rate noise through gravity, g Ng sqrt(t^5/20). The
    coupled form has the rate bias from the image; for the decoupled one tilt grows with it, 0.5 g theta t^2.
    """
    t, g = gap_s, 9.80665
    white = 3.0 * model.force_density**2 * t**3 / 3.0 + 2.0 * (g * model.rate_density) ** 2 * t**5 / 20.0
    walk = 3.0 * model.force_walk**2 * t**5 / 20.0
    free = 2.0 * (tilt_growth_mm(model.rate_bias, t) / MM_PER_M) ** 2
    return MM_PER_M * float(np.sqrt(white + walk + free)), MM_PER_M * float(np.sqrt(white + walk))
