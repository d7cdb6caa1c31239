"""The bars of the study: each figure that has to hold, with its limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from math import sqrt
from typing import Any


@dataclass(frozen=True)
class Bar:
    """One figure and the range it has to lie in; a figure that is not a number fails."""

    what: str
    value: float
    least: float
    most: float

    @property
    def held(self) -> bool:
        return self.least <= self.value <= self.most

    def as_dict(self) -> dict[str, Any]:
        """For the JSON object."""
        return {**asdict(self), "held": self.held}


_MAX_BARS = (
    ("mean largest error, n = 10, +-0.5 mm, SVD / mm", 0.29, 0.34),
    ("three-point (best triangle) / SVD, ratio of the means", 1.8, 2.5),
)


def bars(result: dict[str, Any]) -> list[Bar]:
    """All bars of a result of `study_pose`, widened for a short run by the sampling error of its figures.

    The full number of draws is held to the bars themselves; a short run cannot be.
    """
    return [*_rms(result), *_table(result), *_exact(result), *_convergence(result), *_bound(result)]


def _rms(result: dict[str, Any]) -> Iterator[Bar]:
    for name, ratios in result["rms_ratios"].items():
        slack = allowance(result["draws"], 0.2)
        values = [float(v) for v in ratios.values()]
        for word, value in (("smallest", min(values)), ("largest", max(values))):
            what = f"rms / (sigma sqrt(6/n)), {name}, n = {min(ratios)}..{max(ratios)}: {word}"
            yield Bar(what, value, 0.98 - slack, 1.02 + slack)


def _table(result: dict[str, Any]) -> Iterator[Bar]:
    for row in result["table"]:
        values = (row["svd"]["mean"], row["ratio_of_means"])
        for (what, least, most), value, spread in zip(_MAX_BARS, values, (0.09, 1.0), strict=True):
            slack = allowance(row["draws"], spread)
            yield Bar(f"{what}: {row['layout']}", value, least - slack, most + slack)


def _exact(result: dict[str, Any]) -> Iterator[Bar]:
    worst = max(row["least_squares_gap_mm"] for row in result["table"])
    yield Bar("|least squares - SVD| at any target / mm", worst, 0.0, 1e-9)
    for method, value in result["noiseless_mm"].items():
        yield Bar(f"exact points, {method} / mm", value, 0.0, 1e-9)


def _convergence(result: dict[str, Any]) -> Iterator[Bar]:
    for name, row in result["sizes"]["layouts"].items():
        yield Bar(f"Gauss-Newton from three points at +-10 mm, share converged: {name}", row["converged"], 1.0, 1.0)


def _bound(result: dict[str, Any]) -> Iterator[Bar]:
    for row in result["bound"]:
        slack = allowance(row["draws"], 0.3)
        for what in ("point", "rotation"):
            yield Bar(f"ML rms over the bound, {what}: {row['case']}", row["ml"][what], 0.0, 1.02 + slack)
        off = 0.1 + allowance(row["draws"], sqrt(12.0))
        yield Bar(f"NEES of ML: {row['case']}", row["nees"], 6.0 - off, 6.0 + off)


FULL_DRAWS = 20000


def allowance(draws: int, spread: float) -> float:
    """How much of the error of a short run a bar forgives: four standard errors of a mean of values that scatter by
    `spread`, less those of a full run, which keeps to the bar itself."""
    return 4.0 * spread * max(0.0, 1.0 / sqrt(draws) - 1.0 / sqrt(FULL_DRAWS))


def bar_text(bar: Bar) -> str:
    """One bar for a person."""
    return f"{'pass' if bar.held else 'FAIL'}  {bar.value:<10.4g} ({bar.least:.4g} to {bar.most:.4g})  {bar.what}"
