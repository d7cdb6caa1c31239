"""The stops that are planned with a move: figures against a table written by hand, and what the drives get of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.motion.stops import planned_stop
from docking.types import Array, Plan
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell
from tests.support.planned_moves import a_plan, lab_site

PERIOD_S = 0.01
PEAKS_MM_S = np.array([5.0, -2.5, 0.4, 0.0, 4.0, -0.05, 1.0, 2.0, 3.0, -4.5, 0.8, 2.2])
COUNTS_PER_MM = 10_000


def ramped(peaks_mm_s: Array, rows: int = 101) -> Plan:
    """Axes that speed up to their peaks in a straight line and down again, half as fast."""
    share = np.interp(np.arange(rows), [0, rows // 3, rows - 1], [0.0, 1.0, 0.0])
    steps = share[:, None] * peaks_mm_s * PERIOD_S
    q = np.vstack([np.zeros(len(peaks_mm_s)), np.cumsum(steps, axis=0)])
    t_s: Array = PERIOD_S * np.arange(len(q), dtype=np.float64)
    return replace(a_plan(lab_site(), 1), period_s=PERIOD_S, q_mm=q, t_s=t_s, s=np.linspace(0.0, 1.0, len(q)))


def test_every_axis_is_armed_for_its_own_peak_in_one_common_time() -> None:
    stop = planned_stop(ramped(PEAKS_MM_S), np.full(12, 200.0), PERIOD_S)
    np.testing.assert_allclose(stop.peak_mm_s, np.abs(PEAKS_MM_S), rtol=1e-12)
    assert stop.t_stop_s == pytest.approx(5.0 / 200.0)


def test_the_common_time_is_the_slowest_stoppers_and_no_less_than_a_cycle() -> None:
    quick = np.full(12, 200.0)
    quick[4] = 20.0
    assert planned_stop(ramped(PEAKS_MM_S), quick, PERIOD_S).t_stop_s == pytest.approx(4.0 / 20.0)
    assert planned_stop(ramped(0.01 * PEAKS_MM_S), quick, PERIOD_S).t_stop_s == PERIOD_S


def test_the_drives_hold_ramps_in_proportion_to_the_planned_peaks() -> None:
    """Objects 6085h of twelve drives, in their own units; an axis that stands gets a hundredth, never 0."""

    async def main() -> list[int]:
        bench = Bench(can_cell())
        await bench.master.bring_up()
        stop = planned_stop(ramped(PEAKS_MM_S), bench.master.a_quick_mm_s2, PERIOD_S)
        await bench.master.arm_stops(stop.peak_mm_s, stop.t_stop_s)
        held = [node.number_of(0x6085) for node in bench.drives.nodes]
        bench.drives.close()
        return held

    held = run_virtual(main)
    # 5 mm/s in 25 ms is 200 mm/s^2: 40 / s times each peak.
    wanted = np.maximum(40.0 * np.abs(PEAKS_MM_S), 2.0) * COUNTS_PER_MM
    np.testing.assert_allclose(held, wanted, rtol=1e-6)
