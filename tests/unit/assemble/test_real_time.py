"""Running in real time: what is changed for it is put back, and computing does not hold up the loop."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
import threading
import time

import pytest

from docking.assemble.real_time import aside, on_interrupt, run_real


def settings() -> tuple[object, ...]:
    return os.sched_getscheduler(0), os.sched_getparam(0), sys.getswitchinterval(), gc.get_freeze_count()


def test_the_process_is_left_as_it_was_found() -> None:
    before = settings()

    async def main() -> tuple[object, ...]:
        return settings()

    inside = run_real(main)
    assert settings() == before
    assert inside[2] < before[2]
    assert inside[3] > 0

    async def fail() -> None:
        raise LookupError("on purpose")

    with pytest.raises(LookupError):
        run_real(fail)
    assert settings() == before


def test_a_program_without_priority_says_so_and_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    said: list[str] = []

    async def main() -> str:
        return "done"

    assert run_real(main, lambda: said.append("late")) == "done"
    assert said == ["late"]


def test_what_is_worked_out_aside_leaves_the_loop_ticking() -> None:
    def work() -> int:
        end_s = time.perf_counter() + 0.3
        while time.perf_counter() < end_s:
            sum(range(1000))
        return threading.get_ident()

    async def main() -> tuple[int, int]:
        ticks = 0

        async def tick() -> None:
            nonlocal ticks
            while True:
                await asyncio.sleep(0.01)
                ticks += 1

        ticking = asyncio.create_task(tick())
        worker = await aside(work)
        ticking.cancel()
        return worker, ticks

    worker, ticks = run_real(main)
    assert worker != threading.get_ident()
    assert ticks >= 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_become_calls_on_the_loop(number: signal.Signals) -> None:
    async def main() -> bool:
        heard = asyncio.Event()
        on_interrupt(heard.set)
        os.kill(os.getpid(), number)
        await asyncio.wait_for(heard.wait(), 5.0)
        return True

    assert run_real(main)
