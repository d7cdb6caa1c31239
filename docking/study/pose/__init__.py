"""The study of [Luo] with many draws: Table 1, Fig. 2, Fig. 3, where least squares may start, and the physical limit.

`study_pose(draws, seed, say)` computes everything, `docking.study.pose.page` draws it beside the paper's figures.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from docking.errors import BadArgument
from docking.study.pose.bars import bar_text, bars
from docking.study.pose.bound import bound_of, cases
from docking.study.pose.curves import number_of_points, size_of_errors
from docking.study.pose.layouts import LAYOUTS
from docking.study.pose.starts import starts
from docking.study.pose.table import noiseless_mm, rms_ratios, table_of

__all__ = ["bar_text", "bars", "study_pose", "study_text"]

Say = Callable[[str], None]
_POINTS = range(3, 21)
_LEAST_DRAWS = 100


def study_pose(draws: int, seed: int, say: Say) -> dict[str, Any]:
    """Every figure of the study, each from `draws` draws; iterated fits are made for a tenth of them at the most.

    Raises BadArgument for too few draws.
    """
    if not draws >= _LEAST_DRAWS:
        raise BadArgument("--draws", "fewer show no 5 and 95 % points", value=draws, limit=_LEAST_DRAWS)
    began, fits = time.monotonic(), min(max(draws // 50, 10), 300)
    rng = np.random.default_rng([seed, draws])

    def step(text: str) -> None:
        say(f"{time.monotonic() - began:5.0f} s  {text}")

    result: dict[str, Any] = {"draws": draws, "seed": seed}
    step("Table 1: ten points, +-0.5 mm, four layouts")
    result["table"] = [table_of(layout, draws, min(draws, 5 * fits), rng) for layout in LAYOUTS]
    result["noiseless_mm"] = noiseless_mm(min(fits, 100), rng)
    step("Fig. 2: three to ten points")
    result["counts"] = [number_of_points(layout, draws, rng) for layout in LAYOUTS]
    step("rms against sigma sqrt(6/n), 3 to 20 points")
    result["rms_ratios"] = {layout.name: rms_ratios(_POINTS, draws, rng, layout) for layout in LAYOUTS}
    step("Fig. 3: errors of 0.1 mm to 10 mm, and to the size of the part")
    result["sizes"] = size_of_errors(draws, fits, rng)
    step("starts of least squares")
    result["starts"] = starts(fits, rng)
    result["bound"] = []
    for case in cases():
        step(f"Cramer-Rao bound: {case.name}")
        result["bound"].append(bound_of(case, draws, rng))
    found = bars(result)
    result["bars"] = [bar.as_dict() for bar in found]
    result["held"] = all(bar.held for bar in found)
    step("done")
    return result


def study_text(result: dict[str, Any]) -> str:
    """The bars and the paper's figures for a person."""
    lines = [bar_text(bar) for bar in bars(result)]
    lines += ["", "SVD over the bound (point, rotation), where maximum likelihood is at 1.00:"]
    lines += [
        f"  {row['svd']['point']:.3f}  {row['svd']['rotation']:.3f}  three-point {row['three-point']['point']:.2f}  "
        f"{row['case']}"
        for row in result["bound"]
    ]
    lines += ["", "the paper's one draw of Table 1 in our distribution:"]
    lines += [
        f"  0.400 mm (SVD) above {100 * row['paper_svd_at']:.0f} % of our draws, 0.529 mm (three points) above "
        f"{100 * row['paper_three_point_at']:.0f} %: {row['layout']}"
        for row in result["table"]
    ]
    failed = sum(not bar["held"] for bar in result["bars"])
    return "\n".join(
        [*lines, "", "all bars hold" if result["held"] else f"{failed} of {len(result['bars'])} bars FAIL"]
    )
