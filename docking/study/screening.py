"""How many wrong points the screening survives: Monte Carlo over layouts, kinds of error and numbers of points.

A success is complete: every wrong point left out and named for what it is, no good point lost, and the pose at most 1.5
times as far off as the fit of the good points alone. A refusal is no success; refusals are counted by their error.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from docking.errors import BadArgument, PoseError
from docking.geometry import exp_so3
from docking.pose import LASER_TRACKER, FitSettings, fit_pose, screen
from docking.types import Array, Points, Pose, Rejection, Screened

Generator = np.random.Generator
Say = Callable[[str], None]

RADIUS_MM, HALF_LENGTH_MM = 1975.0, 4500.0
SIGMA_MM = 0.05
STATION_C_MM = (500.0, -9000.0, 800.0)
WORST_POSE = 1.5
"""Largest error at the points against the fit of the good points alone."""


@dataclass(frozen=True)
class Case:
    """`wrong` of `n` points are wrong in one way; the share of draws that must succeed, or may fail when clean."""

    kind: str
    n: int
    wrong: int
    bar: float = 0.95

    @property
    def name(self) -> str:
        return f"{self.kind} {self.wrong} of {self.n}"


CASES = (
    *(Case("clean", n, 0, 0.99) for n in (7, 10, 15, 20)),
    *(Case("mis-aimed", n, k) for n, k in ((7, 4), (10, 7), (15, 10), (20, 15))),
    *(Case("swapped", n, k) for n, k in ((7, 4), (10, 7), (15, 10), (20, 15))),
    *(Case("slid", n, k) for n, k in ((7, 3), (10, 4), (15, 7), (20, 8))),
)
NOISES = ("isotropic", "tracker")
REASONS = {"mis-aimed": "mis-aimed", "swapped": "swapped", "slid": "moved"}
"""What the screening has to call the wrong points of each kind."""


@dataclass(frozen=True)
class Draw:
    """One drawn set: `nominal` in C, `measured` in W, the true pose X_WC, the rows that are wrong and in what way."""

    nominal: Points
    measured: Points
    X_WC: Pose
    wrong: list[int]
    kind: str


def barrel(rng: Generator, n: int) -> Array:
    """Points (n, 3) on a fuselage section of 9 m, mm."""
    x, angle = rng.uniform(-HALF_LENGTH_MM, HALF_LENGTH_MM, n), rng.uniform(0.0, 2.0 * np.pi, n)
    return np.column_stack([x, RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)])


def spoil(rng: Generator, p_mm: Array, kind: str, rows: list[int]) -> None:
    """Make `rows` of the measured points (n, 3) wrong: aimed 1-30 mm off, swapped among themselves, slid by 2 mm."""
    directions = rng.normal(size=(len(rows), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if kind == "mis-aimed":
        p_mm[rows] += directions * rng.uniform(1.0, 30.0, (len(rows), 1))
    elif kind == "swapped":
        p_mm[rows] = p_mm[[rows[i] for i in _derangement(rng, len(rows))]]
    elif kind == "slid":
        p_mm[rows] += 2.0 * directions[0]


def _derangement(rng: Generator, n: int) -> NDArray[np.intp]:
    while True:
        order = rng.permutation(n)
        if not np.any(order == np.arange(n)):
            return order


def _anywhere(rng: Generator) -> Pose:
    turn = rng.normal(size=3)
    return Pose(exp_so3(turn / np.linalg.norm(turn) * rng.uniform(0.0, np.pi)), rng.uniform(-5000.0, 5000.0, 3))


def draw(rng: Generator, case: Case, noise: str) -> Draw:
    """A random section at a random pose, measured once."""
    j, X = barrel(rng, case.n), _anywhere(rng)
    p = X.apply(j)
    cov = np.tile(SIGMA_MM**2 * np.eye(3), (case.n, 1, 1))
    if noise == "tracker":
        cov = LASER_TRACKER.covariance(p - X.apply(STATION_C_MM))
    p = p + np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=p.shape))
    wrong = sorted(rng.permutation(case.n)[: case.wrong].tolist())
    spoil(rng, p, case.kind, wrong)
    names = tuple(f"T{i + 1}" for i in range(case.n))
    return Draw(Points(names, j, np.zeros((case.n, 3, 3))), Points(names, p, cov), X, wrong, case.kind)


def verdict(drawn: Draw, settings: FitSettings) -> str:
    """`success`, or what went wrong: the refusal's error, `missed`, `good point rejected`, `misnamed`, `pose`."""
    try:
        screened = screen(drawn.nominal, drawn.measured, settings)
    except PoseError as error:
        return f"refused: {type(error).__name__}"
    out = {drawn.nominal.names.index(r.name) for r in screened.rejected}
    if not set(drawn.wrong) <= out:
        return "missed"
    if out != set(drawn.wrong):
        return "good point rejected"
    if not all(_named_right(drawn, rejection) for rejection in screened.rejected):
        return "misnamed"
    mine, clean = (_off_mm(drawn, s, settings) for s in (screened, _good(drawn)))
    return "success" if mine <= WORST_POSE * clean else "pose"


def _named_right(drawn: Draw, rejection: Rejection) -> bool:
    """The reason is that of the kind of error; the partner of a swapped point is the one at whose place it was read."""
    if rejection.reason != REASONS[drawn.kind]:
        return False
    if not rejection.partner:
        return True
    at = drawn.X_WC.inverse().apply(drawn.measured.xyz_mm[drawn.measured.names.index(rejection.name)])
    nearest = int(np.argmin(np.linalg.norm(drawn.nominal.xyz_mm - at, axis=1)))
    return rejection.partner == drawn.nominal.names[nearest]


def _good(drawn: Draw) -> Screened:
    rows = [i for i in range(len(drawn.nominal)) if i not in drawn.wrong]
    a, b = drawn.nominal, drawn.measured
    names = tuple(a.names[i] for i in rows)
    return Screened(names, a.xyz_mm[rows], a.cov_mm2[rows], b.xyz_mm[rows], b.cov_mm2[rows])


def _off_mm(drawn: Draw, screened: Screened, settings: FitSettings) -> float:
    """Largest error of the fitted pose at any target, wrong ones included."""
    gap = fit_pose(screened, settings).X_MN.apply(drawn.nominal.xyz_mm) - drawn.X_WC.apply(drawn.nominal.xyz_mm)
    return float(np.max(np.linalg.norm(gap, axis=1)))


def run_case(case: Case, noise: str, draws: int, seed: int = 1) -> dict[str, Any]:
    """Counts of `verdict` over `draws` draws, and whether the bar holds."""
    rng = np.random.default_rng([seed, case.n, case.wrong, NOISES.index(noise)])
    counts = Counter(verdict(draw(rng, case, noise), FitSettings()) for _ in range(draws))
    successes = counts["success"]
    low, high = _interval(successes, draws)
    # Clean sets are rejected at the level of the test itself, which is the bar: half of all studies would miss it by
    # chance. They miss it when the level is not believable.
    reached = successes / draws if case.wrong else high
    return {
        "case": case.name,
        "noise": noise,
        "draws": draws,
        "success": successes / draws,
        "low": low,
        "high": high,
        "bar": case.bar,
        "held": bool(reached >= case.bar),
        "verdicts": dict(counts),
    }


def _interval(count: int, of: int) -> tuple[float, float]:
    """Exact two-sided 95 % interval of a share (Clopper-Pearson)."""
    low = float(special.betaincinv(count, of - count + 1, 0.025)) if count > 0 else 0.0
    high = float(special.betaincinv(count + 1, of - count, 0.975)) if count < of else 1.0
    return low, high


def study_screening(draws: int, workers: int | None, say: Say) -> dict[str, Any]:
    """All cases with both noises, `draws` draws each and ten times as many clean ones; one row a case."""
    if not draws >= 1:
        raise BadArgument("--draws", "at least one is needed", value=draws, limit=1)
    tasks = [(case, noise, draws * (1 if case.wrong else 10)) for noise in NOISES for case in CASES]
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for row in pool.map(run_case, *zip(*tasks, strict=True)):
            rows.append(row)
            say(row_text(row))
    return {"rows": rows, "held": all(row["held"] for row in rows)}


def row_text(row: dict[str, Any]) -> str:
    """One case for a person: share of successes, its bar, and what the other draws ended with."""
    rest = ", ".join(f"{name} {count}" for name, count in sorted(row["verdicts"].items()) if name != "success")
    verdict_text = "holds" if row["held"] else "MISSED"
    success, low, high, bar = (100.0 * row[key] for key in ("success", "low", "high", "bar"))
    share = f"{success:6.2f} % of {row['draws']} (95 %: {low:.2f} to {high:.2f}; bar {bar:.0f} %: {verdict_text})"
    return f"{row['noise']:<10}{row['case']:<20}{share}  {rest}"


MEANING = """\
success              all wrong points out and named, no good one lost, pose at most 1.5 times as far off as of the good
AmbiguousSet         refused: another set of points agrees as well, and no choice is made
NotCongruent         refused: no set agrees, or one that chance may have brought together
ComponentDeformed    refused: the points follow a smooth shape
missed               a wrong point was used
good point rejected  by the test of single points, whose level is 1 % of clean sets
misnamed             a wrong point is out, for another reason than it was wrong
pose                 the right points, and yet a pose too far off"""


def study_text(result: dict[str, Any]) -> str:
    """The verdict of the study for a person."""
    missed = [f"{row['case']} ({row['noise']})" for row in result["rows"] if not row["held"]]
    return "\n".join([MEANING, "all bars hold" if result["held"] else f"bars missed: {', '.join(missed)}"])
