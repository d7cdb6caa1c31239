"""Axes that follow the part: a jam shows at its limit wherever it begins, what lead errors do does not."""

from __future__ import annotations

import numpy as np
import pytest

from docking.motion.monitors.followed import PROOF, Followed

LIMIT_MM = 0.1
STEP_MM = 0.01


def seen_after_mm(jammed_at_mm: float, drift: float = 0.0, off_mm: float = 0.0) -> float:
    """One axis is to go 10 mm and jams at `jammed_at_mm`; it drifts off its place by `drift` a millimetre of way and
    stands `off_mm` off from the start. Way from the jam until it is over its limit; infinite when it never is."""
    followed = Followed(LIMIT_MM)
    followed.off_mm(np.zeros(1), np.zeros(1))
    for place in np.arange(0.0, 10.0, STEP_MM):
        went = min(place, jammed_at_mm)
        beside = off_mm + (1.0 + drift) * went - place
        if not abs(followed.off_mm(np.array([beside]), np.array([place]))[0]) <= LIMIT_MM:
            return float(place - jammed_at_mm)
    return float("inf")


@pytest.mark.parametrize("at_mm", [0.0, 0.3, 0.45, 0.5, 0.55, 0.95, 3.21, 7.0])
@pytest.mark.parametrize("drift", [0.0, 0.005, -0.005])
def test_a_jam_is_seen_at_the_limit_wherever_it_begins(at_mm: float, drift: float) -> None:
    """Half a percent of drift over at most two proofs back is 5 um."""
    assert seen_after_mm(at_mm, drift) == pytest.approx(LIMIT_MM, abs=0.005 + 2.0 * STEP_MM)


def test_drift_over_a_long_way_is_no_jam() -> None:
    assert seen_after_mm(20.0, drift=0.05) == float("inf"), "0.5 mm over 10 mm of way"
    assert seen_after_mm(20.0, drift=0.15) < float("inf"), "0.1 mm over less than two proofs of way"


def test_beginning_anew_counts_from_the_place() -> None:
    followed = Followed(LIMIT_MM)
    for place in (0.0, 1.0, 2.0, 3.0):
        followed.off_mm(np.array([0.09]), np.array([place]))
    assert followed.off_mm(np.array([0.09]), np.array([3.0]))[0] == 0.0
    followed.begin()
    assert followed.off_mm(np.array([0.09]), np.array([3.0]))[0] == 0.09


def test_each_axis_has_its_own_proof_and_nan_is_over_every_limit() -> None:
    followed = Followed(LIMIT_MM)
    followed.off_mm(np.zeros(2), np.zeros(2))
    for place in (1.0, 2.0, 3.0):
        off = followed.off_mm(np.full(2, 0.08), np.array([place, 0.01 * place]))
    assert off.tolist() == [0.0, 0.08]
    assert np.isnan(followed.off_mm(np.array([np.nan, 0.0]), np.zeros(2))[0])
    assert PROOF * LIMIT_MM == 0.5
