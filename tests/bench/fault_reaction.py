"""P9: from a fault's frames to the stop frames of all axes on a python-can bus, against python-can's own echo."""

from __future__ import annotations

import asyncio
import statistics
import struct
import time
from collections.abc import Callable

import can
import numpy as np

from docking.motion import StreamedMotion
from docking.ports import CanFrame
from drivers.canopen import cia402
from drivers.canopen.positioners import CanopenPositioners
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCanEnd
from tests.bench.metric import Metric, Sizes
from tests.support.can_bench import Bench, can_cell
from tests.support.motion_fakes import LATE_CYCLES, watch_of
from tests.support.planned_moves import a_plan, lab_site

SITE = lab_site()
FAULT_AXIS = 4
CYCLE_S = 0.01
FAULTS_A_REPEAT = 8
ECHOES = 500


def measure(sizes: Sizes) -> list[Metric]:
    axes = len(SITE.positioners.axes)
    rng = np.random.default_rng(9)
    ratios, reactions, echoes, waits = [], [], [], []
    for _ in range(sizes.repeats):
        found = [_reaction(float(rng.uniform(0.02, 0.98))) for _ in range(FAULTS_A_REPEAT)]
        reaction_s, echo_s = statistics.median(f[0] for f in found), axes * _echo_s()
        reactions.append(reaction_s)
        echoes.append(echo_s)
        ratios.append(reaction_s / echo_s)
        waits += [f[1] for f in found]
    worst_s = max(waits)
    return [
        Metric(
            "P9",
            "drive fault seen -> stop frames of all axes out",
            f"{statistics.median(reactions) * 1e6:.0f} us",
            f"{axes} python-can echoes {statistics.median(echoes) * 1e6:.0f} us",
            statistics.median(ratios),
            2.0,
            at_least=False,
        ),
        Metric(
            "P9",
            "fault at any instant of the cycle, worst wait for the stop",
            f"{worst_s * 1e3:.1f} ms",
            f"1 tick {CYCLE_S * 1e3:.0f} ms",
            worst_s / CYCLE_S,
            1.0,
            at_least=False,
        ),
    ]


class _Tap:
    """The near end of the drives' bus; from `bus` on, frames go to python-can instead, and `sent` is called after."""

    def __init__(self, near: VirtualCanEnd) -> None:
        self._near = near
        self.bus: can.BusABC | None = None
        self.sent: Callable[[list[CanFrame]], None] = lambda frames: None
        self.on_frames: Callable[[list[CanFrame]], None] = lambda frames: None
        self.on_lost: Callable[[str], None] = lambda reason: None

    async def open(self) -> None:
        self._near.on_frames = self._hear
        await self._near.open()

    def _hear(self, frames: list[CanFrame]) -> None:
        """What the drives still had on the wire when the fault was injected would report it healthy again."""
        if self.bus is None:
            self.on_frames(frames)

    def send(self, frames: list[CanFrame]) -> None:
        if self.bus is None:
            self._near.send(frames)
            return
        for cob, data in frames:
            self.bus.send(can.Message(arbitration_id=cob, data=data, is_extended_id=False))
        self.sent(frames)

    def close(self) -> None:
        self._near.close()


def _reaction(phase: float) -> tuple[float, float]:
    """(computing, waiting) in s from the fault's frames to the last stop frame; it comes at `phase` of a cycle."""

    async def main() -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        bench = Bench(can_cell("lab-can"))
        plan = a_plan(SITE, 3)
        bench.plant.position = np.array(plan.q_mm[0])
        tap = _Tap(bench.near)
        motion = StreamedMotion(CanopenPositioners(bench.cell, tap), watch_of(SITE.positioners), LATE_CYCLES)
        await motion.connect()
        await motion.enable()
        await motion.load(plan)
        move = loop.create_task(motion.start(plan.plan_hash))
        await asyncio.sleep(50.0 * CYCLE_S)
        tap.bus = can.Bus(interface="virtual", channel="bench-stop")
        begun: list[tuple[float, float]] = []
        ended: asyncio.Future[tuple[float, float]] = loop.create_future()

        def out(frames: list[CanFrame]) -> None:
            stops = [data for cob, data in frames if 0x200 < cob < 0x280]
            if begun and not ended.done() and all(data[0] == cia402.QUICK_STOP for data in stops):
                ended.set_result((time.perf_counter() - begun[0][0], loop.time() - begun[0][1]))

        def fault() -> None:
            begun.append((time.perf_counter(), loop.time()))
            tap.on_frames(_faulty(bench))

        tap.sent = out
        loop.call_later(phase * CYCLE_S, fault)
        found = await ended
        tap.bus.shutdown()
        tap.bus, tap.sent = None, lambda frames: None
        await move
        bench.drives.close()
        return found

    result: tuple[float, float] = run_virtual(main)
    return result


def _faulty(bench: Bench) -> list[CanFrame]:
    """The emergency message and the read-backs of a cycle in which one drive reports the fault state."""
    frames: list[CanFrame] = [(0x80 + FAULT_AXIS + 1, struct.pack("<HB5x", 0x2310, 1))]
    for index, position in enumerate(bench.plant.position):
        word = 0x4218 if index == FAULT_AXIS else 0x1237
        frames.append((0x181 + index, struct.pack("<Hih", word, round(float(position) * 1e4), 0)))
    return frames


def _echo_s() -> float:
    """One frame there and one back between two python-can buses, median."""
    with (
        can.Bus(interface="virtual", channel="bench-echo") as near,
        can.Bus(interface="virtual", channel="bench-echo") as far,
    ):
        taken = []
        for _ in range(ECHOES):
            message = can.Message(arbitration_id=0x201, data=bytes(7), is_extended_id=False)
            begun_s = time.perf_counter()
            near.send(message)
            heard = far.recv(1.0)
            assert heard is not None
            far.send(can.Message(arbitration_id=0x181, data=heard.data, is_extended_id=False))
            assert near.recv(1.0) is not None
            taken.append(time.perf_counter() - begun_s)
    return statistics.median(taken)
