"""Running in real time: a loop that wakes on time, signals, and work that must not keep the ticks waiting."""

from __future__ import annotations

import asyncio
import gc
import selectors
import signal
import sys
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")

SWITCH_S = 0.0005
"""Longest time a thread that computes keeps the interpreter from the ticks."""


def _loop() -> asyncio.AbstractEventLoop:
    # epoll rounds every wait up to a whole millisecond, select does not.
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def run_real(main: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run `main()` to its end in real time and return its result."""
    sys.setswitchinterval(SWITCH_S)
    # What is loaded by now stays: a collection that walks through it would take tens of milliseconds.
    gc.collect()
    gc.freeze()
    with asyncio.Runner(loop_factory=_loop) as runner:
        return runner.run(main())


def on_interrupt(act: Callable[[], None]) -> None:
    """Let Ctrl-C, a request to terminate and the end of the terminal call `act` on the running loop."""
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, act)


async def aside(work: Callable[[], T]) -> T:
    """`docking.ports.Aside` in real time: in a thread, while the loop goes on ticking."""
    return await asyncio.to_thread(work)
