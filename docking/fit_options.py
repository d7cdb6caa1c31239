"""What `docking fit` is asked for, as the command line says it, and what it means for screening and fit."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from math import radians
from typing import cast

import numpy as np

from docking.errors import BadArgument
from docking.noise_spec import noise_from, noise_known, with_noise
from docking.pose import METHODS, FitSettings, Method
from docking.pose.locks import ANGLES
from docking.pose.settings import FREEDOMS, Freedom
from docking.types import Points

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LARGEST_DT_K = 300.0
_LARGEST_EXPANSION_PER_K = 1e-3


@dataclass(frozen=True)
class FitOptions:
    """The options of `docking fit` as they are typed; all but the method may be absent."""

    method: str = "ml"
    noise: str | None = None
    lock: str | None = None
    exclude: tuple[str, ...] = field(default=())
    temperature: str | None = None
    triangle: str | None = None
    weights: str | None = None


def _number(text: str) -> float:
    return float(text) if _NUMBER.fullmatch(text.strip()) else float("nan")


def expansion_from(spec: str | None) -> float:
    """Relative expansion of `DT_K@ALPHA_PER_K`, 0 for None. Raises BadArgument."""
    if spec is None:
        return 0.0
    dt_text, _, alpha_text = spec.partition("@")
    dt_k, alpha_per_k = _number(dt_text), _number(alpha_text)
    if not (abs(dt_k) <= _LARGEST_DT_K and 0.0 < alpha_per_k <= _LARGEST_EXPANSION_PER_K):
        raise BadArgument("--temperature", "DT_K@ALPHA_PER_K is needed, for example 2.5@23.1e-6", value=spec)
    return dt_k * alpha_per_k


def locks_from(spec: str | None) -> tuple[tuple[Freedom, float], ...]:
    """Locks of `NAME[=VALUE],...` in rad and mm; without a value 0, the nominal frame's own. Raises BadArgument."""
    found: list[tuple[Freedom, float]] = []
    for part in spec.split(",") if spec is not None else []:
        name, equals, text = (piece.strip() for piece in part.partition("="))
        value = _number(text) if equals else 0.0
        if name not in FREEDOMS or name in dict(found) or not np.isfinite(value):
            cause = f"a list of {', '.join(FREEDOMS)} is needed, each once, with =VALUE in mm or deg where it is not 0"
            raise BadArgument("--lock", cause, value=part)
        found.append((cast(Freedom, name), radians(value) if name in ANGLES else value))
    return tuple(found)


def weights_from(spec: str | None) -> dict[str, float]:
    """Weights by name of `NAME=WEIGHT,...`. Raises BadArgument."""
    found: dict[str, float] = {}
    for part in spec.split(",") if spec is not None else []:
        name, _, text = (piece.strip() for piece in part.rpartition("="))
        weight = _number(text)
        if not name or name in found or not (0.0 < weight < np.inf):
            raise BadArgument("--weights", "NAME=WEIGHT,... is needed, each point once, weights above 0", value=part)
        found[name] = weight
    return found


def _names_of(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def settings_from(
    options: FitOptions, nominal: Points, measured: Points, written: dict[str, float] | None = None
) -> FitSettings:
    """The settings of screening and fit; `written` are the weights in the files, `--weights` goes before them.

    Raises BadArgument, also for a name that neither file knows.
    """
    if options.method not in METHODS:
        raise BadArgument("--method", f"choose one of {', '.join(METHODS)}", value=options.method)
    locks, corners = locks_from(options.lock), _names_of(options.triangle or "")
    if locks and options.method != "ml":
        raise BadArgument("--lock", "only --method ml holds degrees of freedom", value=options.method)
    if options.triangle is not None and (len(set(corners)) != 3 or options.method != "three-point"):
        raise BadArgument("--triangle", "three names are needed, with --method three-point", value=options.triangle)
    asked = weights_from(options.weights)
    weights = {**(written or {}), **asked}
    if weights and options.method == "three-point":
        raise BadArgument("--weights", "three points are met as they are; no weight changes that", value=options.method)
    excluded = tuple(dict.fromkeys(name for text in options.exclude for name in _names_of(text)))
    for option, names in (("--exclude", excluded), ("--triangle", corners), ("--weights", tuple(asked))):
        for name in names:
            if name not in nominal.names and name not in measured.names:
                raise BadArgument(option, "neither file has a point of this name", value=name)
    triangle = (corners[0], corners[1], corners[2]) if corners else None
    return FitSettings(
        method=cast(Method, options.method),
        where="fit",
        locks=locks,
        excluded=excluded,
        triangle=triangle,
        weights=tuple(weights.items()),
    )


def prepared(options: FitOptions, nominal: Points, measured: Points) -> tuple[Points, Points]:
    """Nominal points at their stated temperature, and readings with the stated noise where the file gives no sigma.

    Where every reading's noise is stated, by columns or by the option, a nominal point without sigma is taken as exact.
    """
    nominal = replace(nominal, xyz_mm=nominal.xyz_mm * (1.0 + expansion_from(options.temperature)))
    if options.noise is not None:
        measured = with_noise(measured, noise_from(options.noise))
    if not noise_known(measured):
        return nominal, measured
    known = np.all(np.isfinite(nominal.cov_mm2), axis=(1, 2), keepdims=True)
    return replace(nominal, cov_mm2=np.where(known, nominal.cov_mm2, 0.0)), measured
