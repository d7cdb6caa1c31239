"""An asyncio loop whose time jumps to the next timer: a 20-minute docking in seconds, the same every time.

Unmodified asyncio code runs on it. Anything that would wait on the real world (threads, executors, real sockets,
an empty timer queue) raises, because the jump would race it. TCP is served in the process: `create_server` and
`create_connection` join protocols by host and port.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import threading
from collections import deque
from collections.abc import Callable, Coroutine
from contextvars import Context
from typing import Any, TypeVar

T = TypeVar("T")

LATENCY_S = 0.0002
"""One-way delay of an in-process TCP connection, about that of a small switched network."""

SAME_INSTANT_S = 1e-9
"""Timers no farther apart than this are due together: sums of cycles differ in their last bits only."""


class NotInVirtualTime(RuntimeError):
    """Something tried to wait for the real world while time is virtual."""


class _MemoryTransport(asyncio.Transport):
    """One end of an in-process TCP connection."""

    def __init__(self, loop: VirtualTimeLoop, extra: dict[str, Any]) -> None:
        super().__init__(extra)
        self._loop = loop
        self._closing = False
        self.protocol: asyncio.BaseProtocol
        self.peer: _MemoryTransport

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if self._closing or not data:
            return
        self._loop.call_later(LATENCY_S, self._deliver, bytes(data))

    def _deliver(self, data: bytes) -> None:
        if not self.peer._closing:
            self.peer.protocol.data_received(data)  # type: ignore[attr-defined]

    def close(self) -> None:
        if not self._closing:
            self._closing = True
            self._loop.call_soon(self.protocol.connection_lost, None)
            self._loop.call_later(LATENCY_S, self._peer_closed)

    abort = close

    def _peer_closed(self) -> None:
        if not self.peer._closing:
            self.peer._closing = True
            self.peer.protocol.connection_lost(None)

    def is_closing(self) -> bool:
        return self._closing

    def get_protocol(self) -> asyncio.BaseProtocol:
        return self.protocol

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        self.protocol = protocol

    def pause_reading(self) -> None:
        return None

    def resume_reading(self) -> None:
        return None

    def get_write_buffer_size(self) -> int:
        return 0

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        return None


class _MemoryServer(asyncio.AbstractServer):
    """A listening address of the loop."""

    sockets: tuple[Any, ...] = ()

    def __init__(self, loop: VirtualTimeLoop, address: tuple[str, int], factory: Callable[[], Any]) -> None:
        self._loop, self._address, self.factory = loop, address, factory

    def close(self) -> None:
        self._loop.servers.pop(self._address, None)

    async def wait_closed(self) -> None:
        return None

    async def start_serving(self) -> None:
        return None

    async def serve_forever(self) -> None:
        await asyncio.Event().wait()

    def is_serving(self) -> bool:
        return self._address in self._loop.servers

    def get_loop(self) -> asyncio.AbstractEventLoop:
        return self._loop


class VirtualTimeLoop(asyncio.BaseEventLoop):
    """Event loop on virtual time; `time()` starts at 0 and moves only from timer to timer.

    Two timers of the same instant run in the order in which they were set.
    """

    def __init__(self) -> None:
        super().__init__()
        self._now = 0.0
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        self._order = itertools.count()
        self._owner = threading.get_ident()
        self.servers: dict[tuple[str, int], _MemoryServer] = {}

    def time(self) -> float:
        return self._now

    def call_at(  # type: ignore[override]
        self, when: float, callback: Callable[..., Any], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        timer = asyncio.TimerHandle(when, callback, args, self, context)
        heapq.heappush(self._timers, (when, next(self._order), timer))
        return timer

    def call_later(  # type: ignore[override]
        self, delay: float, callback: Callable[..., Any], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        return self.call_at(self._now + delay, callback, *args, context=context)

    def call_soon_threadsafe(self, callback: Any, *args: Any, context: Context | None = None) -> asyncio.Handle:  # type: ignore[override]
        if threading.get_ident() != self._owner:
            raise NotInVirtualTime("a thread tried to wake the virtual loop")
        return self.call_soon(callback, *args, context=context)

    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> Any:  # type: ignore[override]
        raise NotInVirtualTime(f"an executor was asked to run {func!r}")

    def add_reader(self, fd: Any, callback: Any, *args: Any) -> None:  # type: ignore[override]
        raise NotInVirtualTime(f"a real file descriptor was to be watched: {fd!r}")

    def add_writer(self, fd: Any, callback: Any, *args: Any) -> None:  # type: ignore[override]
        raise NotInVirtualTime(f"a real file descriptor was to be watched: {fd!r}")

    def _run_once(self) -> None:
        """One round of the loop, as asyncio's own, but where that waits for a timer this moves time to it."""
        ready: deque[asyncio.Handle] = self._ready  # type: ignore[attr-defined]
        if not ready and not self._stopping:  # type: ignore[attr-defined]
            self._jump()
        timers, due = self._timers, self._now + SAME_INSTANT_S
        while timers and timers[0][0] < due:
            ready.append(heapq.heappop(timers)[2])
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle.cancelled():
                handle._run()

    def _jump(self) -> None:
        """Move time to the next timer that is to run."""
        timers = self._timers
        while timers and timers[0][2].cancelled():
            heapq.heappop(timers)
        if not timers:
            raise NotInVirtualTime("nothing is scheduled: every task waits for something that cannot come")
        if timers[0][0] > self._now:
            self._now = timers[0][0]

    async def create_server(self, protocol_factory: Any, host: Any = None, port: Any = None, **kwargs: Any) -> Any:
        """Listen on (host, port) inside the process."""
        address = (str(host), int(port))
        if address in self.servers:
            raise OSError(f"address {address} is in use")
        server = _MemoryServer(self, address, protocol_factory)
        self.servers[address] = server
        return server

    async def create_connection(self, protocol_factory: Any, host: Any = None, port: Any = None, **kwargs: Any) -> Any:
        """Connect to a server of this loop; ConnectionRefusedError where none listens."""
        await asyncio.sleep(2.0 * LATENCY_S)
        server = self.servers.get((str(host), int(port)))
        if server is None:
            raise ConnectionRefusedError(f"no server listens on {host}:{port}")
        near = _MemoryTransport(self, {"peername": (host, port), "sockname": ("virtual", 0)})
        far = _MemoryTransport(self, {"peername": ("virtual", 0), "sockname": (host, port)})
        near.peer, far.peer = far, near
        near.protocol, far.protocol = protocol_factory(), server.factory()
        far.protocol.connection_made(far)
        near.protocol.connection_made(near)
        return near, near.protocol


def run_virtual(main: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run `main()` to its end on a fresh virtual loop and return its result."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main())
