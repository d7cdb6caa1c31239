"""P5: frames a second through our driver, against python-can's Notifier, and against what twelve axes at 100 Hz need.

The far end is a process of its own that sends the read-backs of twelve axes as fast as they are taken. Ours is the link
and the cyclic image, decoded once a SYNC's worth; the peer is a Notifier whose listener only counts.
"""

from __future__ import annotations

import asyncio
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can

from docking.assemble.real_time import run_real
from docking.config.load import load_cell
from docking.ports import CanFrame
from drivers.canopen.cyclic import CyclicImage
from drivers.canopen.nodes import axis_nodes
from drivers.canopen.watch import NodeWatch
from drivers.links.can_bus import CanBusLink
from drivers.links.unix_bus import UnixBus
from drivers.maps.objects import load_object_map
from tests.bench.metric import Metric, Sizes

CELL = Path(__file__).parents[2] / "sim" / "cells" / "lab-can.toml"
AXES, RATE_HZ = 12, 100
NEED_HZ = 2500.0
"""Read-backs, set-points and SYNC of twelve axes at 100 Hz."""
_FRAME = struct.Struct("=IB3x8s")
_READ_BACK = struct.Struct("<Hih")


def measure(sizes: Sizes) -> list[Metric]:
    count = sizes.can_frames
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "can.sock")
        receivers = (_ours_s, _notifier_s)
        figures = [[_with_far_end(path, count, each) for each in receivers] for _ in range(sizes.repeats)]
    ours, theirs = (count / statistics.median(column) for column in zip(*figures, strict=True))
    ratio = statistics.median(peer_s / own_s for own_s, peer_s in figures)
    return [
        Metric(
            "P5", "CAN frames through our driver", f"{ours:,.0f} a second",
            f"python-can Notifier {theirs:,.0f}", ratio, 0.7,
        ),
        Metric(
            "P5", "the same against the need", f"{ours:,.0f} a second",
            f"{AXES} axes at {RATE_HZ} Hz {NEED_HZ:,.0f}", ours / NEED_HZ, 20.0,
        ),
    ]  # fmt: skip


def _ours_s(path: str, count: int) -> float:
    return run_real(lambda: _ours(path, count), lambda: None)


async def _ours(path: str, count: int) -> float:
    cell = load_cell(CELL)
    omap = load_object_map("cia402")
    nodes = axis_nodes(cell, omap.host_node)
    image = CyclicImage(nodes, omap, 10_000.0, 1.0 / RATE_HZ)
    watch = NodeWatch(nodes, omap, 0.1)
    link = CanBusLink("docking-unix", path, 1_000_000)
    done = asyncio.get_running_loop().create_future()
    taken, cycles = 0, 0

    def take(batch: list[CanFrame]) -> None:
        nonlocal taken, cycles
        # A SYNC's answers at a time, as the bus brings them.
        for first in range(0, len(batch), AXES):
            image.take_batch(batch[first : first + AXES])
        taken += len(batch)
        image.cycles = taken // AXES
        if image.cycles != cycles:
            cycles = image.cycles
            image.feedback(0.0, watch)
        if taken >= count and not done.done():
            done.set_result(None)

    link.on_frames = take
    began_s = time.perf_counter()
    await link.open()
    await done
    took_s = time.perf_counter() - began_s
    link.close()
    return took_s


def _notifier_s(path: str, count: int) -> float:
    done, taken = threading.Event(), 0

    def take(message: can.Message) -> None:
        nonlocal taken
        taken += 1
        if taken >= count:
            done.set()

    began_s = time.perf_counter()
    bus = UnixBus(path)
    notifier = can.Notifier(bus, [take])
    done.wait(60.0)
    took_s = time.perf_counter() - began_s
    notifier.stop()
    bus.shutdown()
    return took_s


def _with_far_end(path: str, count: int, receive: Callable[[str, int], float]) -> float:
    order = [sys.executable, "-m", "tests.bench.can_frames", path, str(count)]
    process = subprocess.Popen(order, stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        process.stdout.readline()
        return receive(path, count)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def _far_end(path: str, count: int) -> None:
    """Send `count` read-backs to the one station that joins; positions change from cycle to cycle."""
    Path(path).unlink(missing_ok=True)
    records = []
    for number in range(count):
        cycle, axis = divmod(number, AXES)
        records.append(_FRAME.pack(0x181 + axis, 8, _READ_BACK.pack(0x0027, cycle + axis, 1)))
    server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server.bind(path)
    server.listen()
    print("ready", flush=True)
    station, _ = server.accept()
    for record in records:
        station.send(record)
    time.sleep(60.0)


if __name__ == "__main__":
    _far_end(sys.argv[1], int(sys.argv[2]))
