"""Stop quality: whatever the instant, the balls stay where one rigid body has them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.stop_quality import MOVES, drives_stops, led_stop, move, residual_mm

LED_MM, QUICK_MM = 1e-6, 0.02
INSTANTS = 50
SOME = 10
PEERS = 3

CASES = [pytest.param(name, SOME, PEERS, id=name) for name in MOVES] + [
    pytest.param(name, INSTANTS, INSTANTS, id=f"{name}, all instants", marks=pytest.mark.full) for name in MOVES
]


def instants(name: str, count: int) -> list[int]:
    """Rows of the plan from its very beginning to its last moving one, evenly."""
    return np.linspace(2, len(move(name).q_mm) - 3, count).round().astype(int).tolist()


@pytest.mark.parametrize("fast", [False, True], ids=["path-preserving", "fast path-preserving"])
@pytest.mark.parametrize("name", MOVES)
def test_a_stop_on_the_path_leaves_the_part_rigid(name: str, fast: bool) -> None:
    plan = move(name)
    worst = 0.0
    for row in instants(name, INSTANTS):
        sent = led_stop(plan, row * plan.period_s, fast=fast)
        assert np.abs(sent[-1] - plan.q_mm[row]).max() > 0.0, "it does stop, after a way"
        worst = max(worst, residual_mm(plan, sent))
    print(f"{name}: {worst:.1e} mm")
    assert worst <= LED_MM


@pytest.mark.parametrize(("name", "count", "peers"), CASES)
def test_a_quick_stop_by_the_drives_themselves_keeps_the_part_straight(name: str, count: int, peers: int) -> None:
    plan = move(name)
    rows = instants(name, count)
    beside = (
        rows if peers == count else [rows[k] for k in np.linspace(0, count - 1, peers + 2).round().astype(int)[1:-1]]
    )
    worst = max(residual_mm(plan, q) for q in drives_stops(plan, rows, armed=True))
    peer = max(residual_mm(plan, q) for q in drives_stops(plan, beside, armed=False))
    print(f"{name}: {worst:.5f} mm; every drive with the same deceleration: {peer:.5f} mm")
    assert worst <= QUICK_MM


def test_drives_with_the_same_deceleration_would_strain_the_part() -> None:
    # At 5 mm/s^2, as soft as a load may need it; the armed ramps end within the common time.
    name = "1 deg + 165 mm in 60 s"
    plan, row = move(name), instants(name, 3)[1]
    (equal,) = drives_stops(plan, [row], armed=False, a_quick_mm_s2=5.0)
    (armed,) = drives_stops(plan, [row], armed=True, a_quick_mm_s2=5.0)
    peer, ours = residual_mm(plan, equal), residual_mm(plan, armed)
    assert peer > QUICK_MM
    assert ours <= 0.02 * peer
