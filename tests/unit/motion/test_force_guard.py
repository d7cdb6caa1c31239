"""The guard of a move: a rise at one ball from any side stops it on the path, once two readings show it."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from docking.errors import DriveFault, ForceRose
from docking.kinematics import axis_forces_n
from docking.motion.force_guard import ForceGuard, ball_forces_n
from sim.virtual_time import run_virtual
from tests.reference_geometry import crooked_axes, rc1

POSITIONERS = rc1(crooked_axes(4))
REST = axis_forces_n(POSITIONERS, np.tile([100.0, -50.0, 15000.0], (4, 1)))


def with_push(ball: int, push_n: list[float]) -> np.ndarray:
    forces = np.zeros((4, 3))
    forces[ball] = push_n
    return REST + axis_forces_n(POSITIONERS, forces)


class Moving:
    """A motion side that moves for a second; `force_at` says what the load cells read."""

    def __init__(self, force_at, cause=None) -> None:
        self._force_at, self._cause, self._stop = force_at, cause, asyncio.Event()
        self.requests: list[tuple[float, str]] = []
        self.began_s = asyncio.get_running_loop().time()

    def elapsed_s(self) -> float:
        return asyncio.get_running_loop().time() - self.began_s

    def feedback(self):
        return SimpleNamespace(force_n=self._force_at(self.elapsed_s()))

    def request(self, verb: str) -> None:
        self.requests.append((self.elapsed_s(), verb))
        self._stop.set()

    async def start(self, plan_hash: str):
        try:
            await asyncio.wait_for(self._stop.wait(), 1.0)
        except TimeoutError:
            return SimpleNamespace(result="done", cause=self._cause)
        return SimpleNamespace(result="stopped", cause=self._cause)


def guarded(force_at, cause=None, limit_n=600.0):
    async def main():
        motion = Moving(force_at, cause)
        guard = ForceGuard.of_change(POSITIONERS, REST, limit_n)
        result, why = await guard.run(motion, "hash")
        assert asyncio.all_tasks() == {asyncio.current_task()}
        return result.result, why, motion.requests

    return run_virtual(main)


def test_the_forces_at_the_balls_are_those_along_crooked_axes() -> None:
    assert ball_forces_n(POSITIONERS, REST) == pytest.approx([np.linalg.norm([100.0, -50.0, 15000.0])] * 4)


@pytest.mark.parametrize("push", [[650.0, 0, 0], [0, -650.0, 0], [0, 0, 650.0], [0, 0, -650.0], [400.0, 400.0, 400.0]])
@pytest.mark.parametrize("ball", [0, 3])
def test_a_push_from_any_side_stops_the_move_and_names_the_ball(ball, push) -> None:
    result, why, requests = guarded(lambda t: with_push(ball, push) if t > 0.5 else REST)
    assert result == "stopped"
    assert isinstance(why, ForceRose)
    assert why.where == f"ball {'ABCD'[ball]}"
    ((at_s, verb),) = requests
    assert verb == "stop"
    assert 0.5 < at_s <= 0.5 + 0.05


def test_less_than_the_limit_is_let_pass() -> None:
    result, why, requests = guarded(lambda t: with_push(1, [0.0, 400.0, 400.0]))
    assert (result, why, requests) == ("done", None, [])


def test_one_reading_alone_counts_half() -> None:
    spike = iter([REST, REST, with_push(2, [0, 0, 1100.0])])
    assert guarded(lambda t: next(spike, REST))[0] == "done"


def test_a_load_cell_that_says_nothing_stops_the_move() -> None:
    result, why, _ = guarded(lambda t: np.full(12, np.nan) if t > 0.3 else REST)
    assert result == "stopped"
    assert isinstance(why, ForceRose)


def test_what_the_motion_side_says_comes_first() -> None:
    fault = DriveFault("B.Y", "overcurrent", value=1)
    assert guarded(lambda t: REST, fault)[1] is fault
    assert guarded(lambda t: with_push(0, [900.0, 0, 0]), fault)[1] is fault


def test_read_backs_that_fail_stop_the_move() -> None:
    def broken(t: float):
        raise DriveFault("A.X", "gone", value=0)

    result, why, requests = guarded(broken)
    assert (result, type(why), len(requests)) == ("stopped", DriveFault, 1)
