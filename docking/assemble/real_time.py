"""Running in real time: a loop that wakes on time, signals, and work that must not keep the ticks waiting."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import selectors
import signal
import sys
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from docking.errors import catalogue

T = TypeVar("T")

SWITCH_S = 0.0005
"""Longest time a thread that computes keeps the interpreter from the ticks."""
TICKS, COMPUTING = 10, 1
"""Real-time priorities: both go before ordinary programs, the ticks before what is worked out aside."""


def run_real(
    main: Callable[[], Coroutine[Any, Any, T]], say_late: Callable[[], None] | None = None, *, ticks: bool = True
) -> T:
    """Run `main()` to its end in real time and return its result.

    `ticks` says that something here has to be on time: the program then goes before others. `say_late` is called where
    the operating system does not permit that, so that ticks may come late on a busy computer.
    """
    with _punctual(ticks) as first, asyncio.Runner(loop_factory=lambda: _loop(ticks)) as runner:
        if not first and say_late is not None:
            say_late()
        return runner.run(main())


ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def on_interrupt(act: Callable[[], None], signals: tuple[signal.Signals, ...] = ENDINGS) -> None:
    """Let Ctrl-C, a request to terminate and the end of the terminal call `act` on the running loop."""
    loop = asyncio.get_running_loop()
    for number in signals:
        loop.add_signal_handler(number, act)


async def aside(work: Callable[[], T]) -> T:
    """`docking.ports.Aside` in real time: in a thread, while the loop goes on ticking."""
    return await asyncio.to_thread(work)


def _loop(ticks: bool) -> asyncio.AbstractEventLoop:
    # epoll rounds every wait up to a whole millisecond, select does not.
    loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
    if ticks:
        loop.set_default_executor(ThreadPoolExecutor(initializer=_go_before_others, initargs=(COMPUTING,)))
    return loop


def _go_before_others(priority: int) -> bool:
    """Give the calling thread, and those it starts, a real-time priority; False where that is not allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


@contextmanager
def _punctual(ticks: bool) -> Iterator[bool]:
    """Short turns for computing threads, no long garbage collections, priority for `ticks`; as before afterwards."""
    turn_s = sys.getswitchinterval()
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    first = not ticks or _go_before_others(TICKS)
    sys.setswitchinterval(SWITCH_S)
    # A fault is named within its tick: its words are read from their file before.
    catalogue("en")
    # What is loaded by now stays: a collection that walks through it would take tens of milliseconds.
    gc.collect()
    gc.freeze()
    try:
        yield first
    finally:
        gc.unfreeze()
        sys.setswitchinterval(turn_s)
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)
