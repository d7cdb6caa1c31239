"""The virtual loop: what moves its time, in which order things run, and what it refuses."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from sim.virtual_time import LATENCY_S, NotInVirtualTime, VirtualTimeLoop, run_virtual


def test_time_jumps_from_timer_to_timer_and_nowhere_else() -> None:
    seen: list[float] = []

    async def main() -> float:
        loop = asyncio.get_running_loop()
        loop.call_later(3600.0, lambda: seen.append(loop.time()))
        loop.call_later(0.5, lambda: seen.append(loop.time()))
        await asyncio.sleep(0)
        seen.append(loop.time())
        await asyncio.sleep(7200.0)
        return loop.time()

    assert run_virtual(main) == 7200.0
    assert seen == [0.0, 0.5, 3600.0]


def test_timers_of_one_instant_run_in_the_order_they_were_set() -> None:
    """An instant is a nanosecond wide: sums of cycles differ in their last bits."""
    order: list[str] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        loop.call_at(0.3, order.append, "first")
        loop.call_at(0.1 + 0.2, order.append, "second")
        loop.call_at(0.3, order.append, "third")
        loop.call_at(0.2, order.append, "earlier")
        loop.call_at(0.3, lambda: loop.call_soon(order.append, "after all of them"))
        await asyncio.sleep(1.0)

    run_virtual(main)
    assert order[0] == "earlier"
    assert order[1:] == ["first", "third", "second", "after all of them"]


def test_a_cancelled_timer_neither_runs_nor_moves_time() -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        loop.call_later(5.0, pytest.fail, "cancelled before its time").cancel()
        late = loop.call_later(1.0, pytest.fail, "cancelled by a timer of the same instant")
        loop.call_at(1.0 - 1e-12, late.cancel)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.Event().wait(), 2.0)
        return loop.time()

    assert run_virtual(main) == 2.0


def test_a_timer_in_the_past_runs_at_once_and_time_never_goes_back() -> None:
    async def main() -> list[float]:
        loop, seen = asyncio.get_running_loop(), []
        await asyncio.sleep(10.0)
        loop.call_at(3.0, lambda: seen.append(loop.time()))
        await asyncio.sleep(1.0)
        return [*seen, loop.time()]

    assert run_virtual(main) == [10.0, 11.0]


def test_waiting_for_what_cannot_come_is_an_error() -> None:
    with pytest.raises(NotInVirtualTime, match="nothing is scheduled"):
        run_virtual(lambda: asyncio.Event().wait())


def test_threads_and_the_real_world_are_refused() -> None:
    refused: list[BaseException] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()

        def poke() -> None:
            try:
                loop.call_soon_threadsafe(print)
            except NotInVirtualTime as error:
                refused.append(error)

        thread = threading.Thread(target=poke)
        thread.start()
        thread.join()
        with pytest.raises(NotInVirtualTime):
            await asyncio.to_thread(print)
        with pytest.raises(NotInVirtualTime):
            loop.add_reader(0, print)

    run_virtual(main)
    assert len(refused) == 1


def test_what_fails_in_a_callback_reaches_the_handler_and_the_loop_goes_on() -> None:
    caught: list[Any] = []
    loop = VirtualTimeLoop()
    try:
        loop.set_exception_handler(lambda _, context: caught.append(context["exception"]))
        loop.call_later(1.0, lambda: 1 / 0)
        loop.run_until_complete(asyncio.sleep(2.0))
        assert isinstance(caught[0], ZeroDivisionError)
        assert loop.time() == 2.0
    finally:
        loop.close()


class Echo(asyncio.Protocol):
    """Sends back what comes and notes when."""

    def __init__(self, log: list[tuple[float, bytes | None]]) -> None:
        self._log = log

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._log.append((asyncio.get_running_loop().time(), data))
        self._transport.write(data)  # type: ignore[attr-defined]

    def connection_lost(self, exc: Exception | None) -> None:
        self._log.append((asyncio.get_running_loop().time(), None))


def test_connections_carry_bytes_in_order_with_the_network_s_delay() -> None:
    log: list[tuple[float, bytes | None]] = []

    async def main() -> tuple[float, bytes]:
        loop = asyncio.get_running_loop()
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("cell", 502)
        server = await loop.create_server(lambda: Echo(log), "cell", 502)
        with pytest.raises(OSError, match="in use"):
            await loop.create_server(lambda: Echo(log), "cell", 502)
        reader, writer = await asyncio.open_connection("cell", 502)
        started_s = loop.time()
        writer.write(b"ab")
        writer.write(b"cd")
        answer = await reader.readexactly(4)
        elapsed_s = loop.time() - started_s
        writer.close()
        await asyncio.sleep(1.0)
        server.close()
        return elapsed_s, answer

    elapsed_s, answer = run_virtual(main)
    assert answer == b"abcd"
    assert elapsed_s == pytest.approx(2.0 * LATENCY_S)
    assert [data for _, data in log] == [b"ab", b"cd", None]
