"""The noise of measured points as a command line says it: `iso:MM`, or an instrument with the place where it stands."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from docking.errors import BadArgument
from docking.pose.noise import NOISE_PRESETS
from docking.pose.passes import lost_beam
from docking.types import Array, Points

CovarianceOf = Callable[[Array], Array]
"""Covariances (n, 3, 3) in mm^2 of readings at points (n, 3) of the measured frame."""

_INSTRUMENTS = {"tracker": "laser-tracker", **{name: name for name in NOISE_PRESETS}}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def noise_from(spec: str, where: str = "--noise") -> CovarianceOf:
    """The covariance that `spec` gives a reading.

    `iso:MM` the same sigma for every coordinate; `tracker`, `laser-tracker`, `total-station`, each alone (it stands at
    the origin of the measured frame) or with its place as in `tracker:X,Y,Z` in mm. Raises BadArgument.
    """
    kind, colon, rest = spec.partition(":")
    numbers = [_number(text) for text in rest.split(",")] if colon else []
    if kind == "iso" and len(numbers) == 1 and numbers[0] > 0.0:
        variance = numbers[0] ** 2
        return lambda points: np.tile(variance * np.eye(3), (len(points), 1, 1))
    if kind in _INSTRUMENTS and len(numbers) in (0, 3) and all(np.isfinite(numbers)):
        model, station = NOISE_PRESETS[_INSTRUMENTS[kind]], np.array(numbers or [0.0, 0.0, 0.0])
        return lambda points: model.covariance(points - station)
    forms = ", ".join(["iso:MM", *(f"{name}[:X,Y,Z]" for name in _INSTRUMENTS)])
    raise BadArgument(where, f"one of {forms} is needed, in mm", value=spec)


def with_noise(points: Points, of: CovarianceOf) -> Points:
    """Readings with the instrument's covariance where they have none; lost beams keep theirs."""
    cov = np.array(points.cov_mm2)
    for i in np.flatnonzero(~np.all(np.isfinite(cov), axis=(1, 2))):
        if not lost_beam(points.xyz_mm[i]):
            cov[i] = of(points.xyz_mm[i : i + 1])[0]
    return replace(points, cov_mm2=cov)


def noise_known(points: Points) -> bool:
    """Whether every reading that can be used has a covariance: a lost beam needs none."""
    return all(
        lost_beam(xyz) or bool(np.all(np.isfinite(cov))) for xyz, cov in zip(points.xyz_mm, points.cov_mm2, strict=True)
    )


def _number(text: str) -> float:
    return float(text) if _NUMBER.fullmatch(text.strip()) else float("nan")
