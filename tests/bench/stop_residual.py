"""P10: how straight a stop leaves the part, against stopping every axis with the same deceleration by itself."""

from __future__ import annotations

import numpy as np

from tests.bench.metric import Metric, Sizes
from tests.support.stop_quality import drives_stops, led_stop, move, residual_mm

MOVE = "1 deg + 165 mm in 60 s"
DECELERATION_MM_S2 = 20.0


def measure(sizes: Sizes) -> list[Metric]:
    plan = move(MOVE)
    rows = np.linspace(2, len(plan.q_mm) - 3, sizes.stop_instants + 2).round().astype(int)[1:-1].tolist()
    peer = _worst(drives_stops(plan, rows, armed=False, a_quick_mm_s2=DECELERATION_MM_S2))
    quick = _worst(drives_stops(plan, rows, armed=True, a_quick_mm_s2=DECELERATION_MM_S2))
    led = _worst([led_stop(plan, row * plan.period_s, fast=False) for row in rows])
    fast = _worst([led_stop(plan, row * plan.period_s, fast=True) for row in rows])
    beside = f"each axis at {DECELERATION_MM_S2:.0f} mm/s^2: {peer:.4f} mm"
    return [
        Metric("P10", f"{what}, {MOVE}", f"{mine:.2g} mm", beside, mine / peer, target, at_least=False)
        for what, mine, target in (
            ("path-preserving stop", led, 0.001),
            ("fast path-preserving stop", fast, 0.001),
            (f"quick stop of the drives within the time of {DECELERATION_MM_S2:.0f} mm/s^2", quick, 0.02),
        )
    ]


def _worst(stops: list[np.ndarray]) -> float:
    plan = move(MOVE)
    return max(residual_mm(plan, positions) for positions in stops)
