"""Settings of screening and fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from docking.errors import BadArgument

Method = Literal["svd", "three-point", "least-squares"]
METHODS: tuple[str, ...] = get_args(Method)


@dataclass(frozen=True)
class FitSettings:
    """How points are screened and a pose is fitted.

    method             estimator; the default is the only one that uses the points' covariances
    weighted           False: every coordinate counts alike, [Luo] Eq. 9 as printed (least-squares only)
    where              what is measured (component, mate, station): names the place in errors
    false_alarm        probability that the screening of one clean set throws out a point
    min_agreeing       smallest set of mutually consistent points that is believed; a cell asks for 4 or more,
                       since three points that agree have nothing left to prove them wrong
    expansion_sigma    1 sigma of the unknown uniform expansion of the body (1/K times K), 0 = rigid; it widens the
                       tolerances of the screening and is estimated with this prior as a seventh unknown of the fit
    spread_ratio       smallest ratio of the targets' second to first principal spread; below it they are a line
    """

    method: Method = "least-squares"
    weighted: bool = True
    where: str = "fit"
    false_alarm: float = 0.01
    min_agreeing: int = 3
    expansion_sigma: float = 0.0
    spread_ratio: float = 1e-3

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise BadArgument("method", f"choose one of {', '.join(METHODS)}", value=str(self.method))
        if not (0.0 < self.false_alarm < 1.0):
            raise BadArgument("false_alarm", "must lie between 0 and 1", value=self.false_alarm)
        if not (self.min_agreeing >= 3):
            raise BadArgument("min_agreeing", "three points define a pose", value=self.min_agreeing, limit=3)
        if not (0.0 <= self.expansion_sigma < 0.1):
            raise BadArgument("expansion_sigma", "must be 0 or a small positive number", value=self.expansion_sigma)
