"""Every fault that scenarios can switch on does what it says, seen on the wire or on the axes."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import numpy as np
import pytest

from docking.assemble.simulated import make_far_end, truth_of
from docking.config.load import load_cell, load_job
from sim.canopen.drives import Stage
from sim.canopen.faulty_wire import FaultyWire
from sim.virtual_time import run_virtual
from tests.support.can_bench import Bench, can_cell

CELLS = Path(__file__).parents[3] / "sim" / "cells"


class End:
    """The other side of a faulty wire."""

    def __init__(self) -> None:
        self.sent: list[list[tuple[int, bytes]]] = []
        self.on_frames = lambda frames: None

    def send(self, frames: list[tuple[int, bytes]]) -> None:
        self.sent.append(frames)


def on_a_wire(story) -> tuple[End, list[tuple[float, list[tuple[int, bytes]]]]]:
    """Run `story(wire, end)`; what the bus got, and what the drives heard and when."""
    end, heard = End(), []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = FaultyWire(end, loop)
        wire.on_frames = lambda frames: heard.append((loop.time(), frames))
        wire.open()
        await story(wire, end)

    run_virtual(main)
    return end, heard


def test_without_a_fault_the_very_same_lists_pass():
    out, back = [(0x181, b"12345678")], [(0x201, b"1234567"), (0x080, b"")]

    async def story(wire, end) -> None:
        wire.send(out)
        end.on_frames(back)

    end, heard = on_a_wire(story)
    assert end.sent[0] is out
    assert heard[0][1] is back


def test_frames_are_lost_so_often_and_no_more():
    async def story(wire, end) -> None:
        wire.lose(0x181, 2)
        wire.lose(0x080)
        for _ in range(3):
            wire.send([(0x181, b""), (0x182, b"")])
            end.on_frames([(0x201, b""), (0x080, b"")])
        wire.lose(0x080, 0)
        end.on_frames([(0x080, b"")])

    end, heard = on_a_wire(story)
    assert [[cob for cob, _ in frames] for frames in end.sent] == [[0x182], [0x182], [0x181, 0x182]]
    assert [[cob for cob, _ in frames] for _, frames in heard] == [[0x201]] * 3 + [[0x080]]


def test_late_batches_keep_their_order():
    late = iter((0.05, 0.001))

    async def story(wire, end) -> None:
        wire.delay(lambda: next(late))
        end.on_frames([(1, b"")])
        await asyncio.sleep(0.01)
        end.on_frames([(2, b"")])
        wire.delay(None)
        await asyncio.sleep(0.01)
        end.on_frames([(3, b"")])
        await asyncio.sleep(0.1)
        end.on_frames([(4, b"")])

    _, heard = on_a_wire(story)
    assert [frames[0][0] for _, frames in heard] == [1, 2, 3, 4]
    assert [round(t_s, 4) for t_s, _ in heard] == [0.05, 0.05, 0.05, 0.12]


def test_forged_doubled_and_silenced_frames():
    async def story(wire, end) -> None:
        wire.forge(0x203, b"x")
        wire.double(0x583)
        wire.send([(0x583, b"y"), (0x584, b"z")])
        wire.silence()
        wire.send([(0x181, b"")])
        end.on_frames([(0x080, b"")])

    end, heard = on_a_wire(story)
    assert end.sent == [[(0x203, b"x")], [(0x583, b"y"), (0x583, b"y"), (0x584, b"z")]]
    assert [frames for _, frames in heard] == [[(0x203, b"x")]]


def on_a_bench(story) -> Bench:
    async def main() -> Bench:
        bench = Bench(can_cell())
        await bench.ready()
        bench.watch()
        await story(bench)
        bench.drives.close()
        return bench

    return run_virtual(main)


def read_backs(bench: Bench, node: int) -> list[tuple[int, int, int]]:
    """(statusword, position, following error) of every read-back of a node."""
    return [struct.unpack("<Hih", data) for cob, data in bench.trace if cob == 0x180 + node]


def test_a_limit_switch_shows_in_bit_11_and_may_stop_its_axis():
    async def story(bench) -> None:
        bench.drives.faults.limit_switch("A.Y")
        await asyncio.sleep(0.05)
        bench.drives.faults.limit_switch("A.Y", False)
        bench.drives.faults.limit_switch("B.X", stops=True)
        await asyncio.sleep(0.05)

    bench = on_a_bench(story)
    words = [word for word, _, _ in read_backs(bench, 2)]
    assert words[2] & 0x0800
    assert not words[-1] & 0x0800
    assert bench.drives.drives.stages[1] is Stage.OPERATION
    assert bench.drives.drives.stages[3] is Stage.QUICK_STOP


def test_a_misread_encoder_changes_what_is_reported_and_nothing_else():
    async def story(bench) -> None:
        await asyncio.sleep(0.03)
        bench.drives.faults.misread("A.Z", offset_mm=1.0)
        await asyncio.sleep(0.03)
        bench.drives.faults.misread("A.Z", sign=-1.0)
        await asyncio.sleep(0.03)

    bench = on_a_bench(story)
    positions = [position for _, position, _ in read_backs(bench, 3)]
    true = round(bench.start_mm[2] * 1e4)
    assert (positions[0], positions[-1]) == (true, -true)
    assert true + 10_000 in positions
    assert np.abs(bench.plant.position - bench.start_mm).max() <= 1e-3


def test_a_warning_an_own_stop_and_a_pre_operational_node():
    async def story(bench) -> None:
        bench.drives.faults.warn("A.X", 0x4210)
        bench.drives.faults.stop_alone("A.Y")
        bench.drives.faults.leave_operational("A.Z")
        await asyncio.sleep(0.15)

    bench = on_a_bench(story)
    emergencies = [(cob, struct.unpack("<H", data[:2])[0]) for cob, data in bench.trace if 0x80 < cob < 0x100]
    assert emergencies == [(0x81, 0x4210), (0x82, 0x8700)]
    stages = bench.drives.drives.stages
    assert stages[:3] == [Stage.OPERATION, Stage.QUICK_STOP, Stage.OPERATION]
    assert len(read_backs(bench, 3)) <= 1
    assert (0x703, bytes((127,))) in bench.trace


def test_drives_in_each_others_place_answer_to_the_other_number():
    async def main() -> None:
        bench = Bench(can_cell())
        bench.drives.faults.swap("A.X", "D.Z")
        answers: list[bytes] = []
        asking = bench.bus.end()
        await asking.open()
        asking.on_frames = lambda frames: answers.extend(data for cob, data in frames if cob == 0x581)
        asking.send([(0x601, struct.pack("<BHB4x", 0x40, 0x1018, 4))])
        await asyncio.sleep(0.01)
        assert struct.unpack("<I", answers[0][4:])[0] == 402_000 + bench.drives.nodes[0].number
        bench.drives.close()

    run_virtual(main)


@pytest.mark.parametrize(("closed", "order"), [(True, "enable"), (False, "close")])
def test_a_brake_that_does_not_move(closed, order):
    async def main() -> list[bool]:
        bench = Bench(can_cell())
        if order == "close":
            await bench.ready()
        bench.drives.faults.seize_brake("A.Z", closed=closed)
        drives = bench.drives.drives
        t_s = bench.plant.calls[-1][0] if bench.plant.calls else 0.0
        if order == "enable":
            drives._enter(2, Stage.OPERATION, t_s)
        else:
            drives._enter(2, Stage.SWITCHED_ON, t_s)
        for step in range(20):
            drives.advance(t_s + 0.01 * step, 0.01, 0.01, bench.plant.encoder_mm)
        bench.drives.close()
        return list(drives.braked)

    assert run_virtual(main)[2] is np.bool_(closed) or bool(run_virtual(main)[2]) is closed


def test_axes_creep_weaken_and_load_cells_misread():
    cell = load_cell(CELLS / "lab-can.toml")
    job = load_job(CELLS / "lab-can.job.toml", cell)

    async def main() -> None:
        plant = make_far_end(cell, job, truth_of(CELLS / "lab-can.toml"), 1).plant
        on, off = np.ones(12, bool), np.zeros(12, bool)
        start = plant.encoder_mm().copy()
        plant.step(0.0, start, on, off)
        plant.creep("A.X", 0.5)
        plant.creep("B.Z", -0.1)
        plant.weaken("C.Y", 1.0, 20.0)
        goal = start + np.eye(12)[7] * 5.0
        for cycle in range(1, 101):
            plant.step(0.01 * cycle, goal, on if cycle < 50 else off, off if cycle < 50 else on)
        moved = plant.encoder_mm() - start
        assert moved[0] == pytest.approx(0.5, abs=0.002)
        assert moved[5] == pytest.approx(-0.1, abs=0.002)
        assert 0.3 < moved[7] < 0.52
        before = plant.force_n()
        plant.misread_force("D.Z", 400.0)
        assert plant.force_n()[11] - before[11] == pytest.approx(400.0, abs=3.0)
        plant.misread_force("D.Z", float("nan"))
        assert np.isnan(plant.force_n()[11])

    run_virtual(main)
