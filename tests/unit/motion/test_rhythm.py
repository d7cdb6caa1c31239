"""When queued positioners are polled, and how late."""

from __future__ import annotations

import asyncio

import pytest

from docking.motion.rhythm import GOLDEN, SHARE, Rhythm
from sim.virtual_time import run_virtual

POLL_S = 0.05


def napped(works_s: list[float], *, moving: bool) -> tuple[list[float], Rhythm]:
    """Loop times at which naps end, with work of these lengths between them."""

    async def main() -> tuple[list[float], Rhythm]:
        rhythm, loop = Rhythm(POLL_S), asyncio.get_running_loop()
        rhythm.begin()
        start_s, ends = loop.time(), []
        for work_s in works_s:
            await rhythm.nap(moving=moving)
            ends.append(loop.time() - start_s)
            await asyncio.sleep(work_s)
        return ends, rhythm

    return run_virtual(main)


def test_polls_keep_their_period_whatever_the_work_takes() -> None:
    ends, rhythm = napped([0.01, 0.04, 0.0], moving=False)
    assert ends == pytest.approx([POLL_S, 2 * POLL_S, 3 * POLL_S])
    assert (rhythm.lateness.samples, rhythm.lateness.worst_s) == (3, pytest.approx(0.0, abs=1e-9))


def test_work_that_takes_too_long_is_counted_as_lateness() -> None:
    ends, rhythm = napped([POLL_S + 0.02, 0.0], moving=False)
    assert ends[1] == pytest.approx(2 * POLL_S + 0.02)
    assert rhythm.lateness.worst_s == pytest.approx(0.02)


def test_in_a_move_polls_drift_through_the_scans() -> None:
    ends, _ = napped([0.0] * 5, moving=True)
    gaps = [b - a for a, b in zip([0.0, *ends], ends, strict=False)]
    phases = [(GOLDEN * (k + 1)) % 1.0 for k in range(5)]
    assert gaps == pytest.approx([POLL_S * (1.0 - SHARE * phase) for phase in phases])


def test_a_poll_that_is_woken_is_not_late() -> None:
    async def main() -> Rhythm:
        rhythm = Rhythm(POLL_S)
        rhythm.begin()
        asyncio.get_running_loop().call_later(0.01, rhythm.wake)
        await rhythm.nap(moving=False)
        return rhythm

    assert run_virtual(main).lateness.samples == 0
