"""Settings of screening and fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from docking.errors import BadArgument

Method = Literal["ml", "svd", "three-point", "least-squares"]
METHODS: tuple[str, ...] = get_args(Method)
Freedom = Literal["alpha", "beta", "gamma", "x", "y", "z"]
FREEDOMS: tuple[str, ...] = get_args(Freedom)
"""[Luo]'s pose vector: angles in rad, translation in mm."""


@dataclass(frozen=True)
class FitSettings:
    """How points are screened and a pose is fitted.

    method             estimator; the default is the only one that uses the points' covariances
    where              what is measured (component, mate, station): names the place in errors
    false_alarm        probability that the screening of one clean set throws out a point
    min_agreeing       smallest set of mutually consistent points that is believed; a cell asks for 4 or more,
                       since three points that agree have nothing left to prove them wrong
    majority           True: the points that are off without an explanation must not outnumber those that agree
    expansion_sigma    1 sigma of the unknown uniform expansion of the body (1/K times K), 0 = rigid; it widens the
                       tolerances of the screening and is estimated with this prior as a seventh unknown of the fit
    spread_ratio       smallest ratio of the targets' second to first principal spread; below it they are a line
    locks              entries of X_MN that are held: (name, value) with angles in rad, x, y, z in mm ("ml" only)
    weights            (point, weight): the point counts as if its variance were that much smaller; others weigh 1
    excluded           points that are left out before anything else
    triangle           corners A, B, C of "three-point"; by default those of the largest triangle
    """

    method: Method = "ml"
    where: str = "fit"
    false_alarm: float = 0.01
    min_agreeing: int = 3
    majority: bool = False
    expansion_sigma: float = 0.0
    spread_ratio: float = 1e-3
    locks: tuple[tuple[Freedom, float], ...] = ()
    weights: tuple[tuple[str, float], ...] = ()
    excluded: tuple[str, ...] = ()
    triangle: tuple[str, str, str] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise BadArgument("method", f"choose one of {', '.join(METHODS)}", value=str(self.method))
        if not (0.0 < self.false_alarm < 1.0):
            raise BadArgument("false_alarm", "must lie between 0 and 1", value=self.false_alarm)
        if not (self.min_agreeing >= 3):
            raise BadArgument("min_agreeing", "three points define a pose", value=self.min_agreeing, limit=3)
        if not (0.0 <= self.expansion_sigma < 0.1):
            raise BadArgument("expansion_sigma", "must be 0 or a small positive number", value=self.expansion_sigma)
        self._check_locks()
        for name, weight in self.weights:
            if not (0.0 < weight < np.inf):
                raise BadArgument("weights", f"the weight of {name} must be positive", value=weight)
        if self.triangle is not None and len(set(self.triangle)) < 3:
            raise BadArgument("triangle", "three different points are needed", value=",".join(self.triangle))

    def _check_locks(self) -> None:
        names = [name for name, _ in self.locks]
        for name, value in self.locks:
            if name not in FREEDOMS or names.count(name) > 1:
                raise BadArgument("locks", f"each of {', '.join(FREEDOMS)} at most once", value=name)
            if not np.isfinite(value):
                raise BadArgument("locks", f"{name} needs a finite value", value=value)
        if self.locks and self.method != "ml":
            raise BadArgument("locks", "only the method ml holds degrees of freedom", value=self.method)
