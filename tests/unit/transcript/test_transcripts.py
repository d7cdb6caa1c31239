"""Transcripts: what is written is what was on the wire, and a driver fed with it finds the same again."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import numpy as np
import pytest

from docking.assemble.controller import tracker_of
from docking.assemble.simulated import make_far_end, truth_of
from docking.config.inputs import CanModule
from docking.errors import BadReply, FileUnreadable, FileUnwritable
from docking.replay import ReplayedCan, ReplayedSerial
from docking.transcript import TranscribedCan, TranscribedSerial, Transcript, can_words, modbus_words, read_transcript
from drivers.canopen.io_module import CanIoModule
from sim.canopen.io_module import IoModule
from sim.virtual_time import run_virtual
from sim.wires.virtual_can import VirtualCan
from sim.wires.virtual_serial import VirtualSerial
from tests.support.dry_cell import CELLS, files

MODULE = CanModule(kind="cia401", name="io1", node=40)


def far_end():
    cell, job = files("lab-can")
    return cell, make_far_end(cell, job, truth_of(CELLS / "lab-can.toml"), 1)


def words(code: int) -> str:
    return f"{code:08X}h"


def test_a_tracker_that_is_replayed_measures_the_same_again(tmp_path):
    path = tmp_path / "run.txt"

    async def measured(link_of):
        cell, far = far_end()
        tracker = tracker_of(cell, link_of(cell, far))
        identity = await tracker.connect()
        points = [(await tracker.measure(p.name, np.array([1e3, 1e3, 0.0]))).p_T_mm for p in cell.tracker.ers[:3]]
        await tracker.close()
        await far.close()
        return identity, np.array(points)

    async def record():
        transcript = Transcript(path, asyncio.get_running_loop().time)

        def link_of(cell, far):
            wire = VirtualSerial(far.loop, cell.tracker.baud)
            far.tracker(cell, wire.far)
            return TranscribedSerial(wire.near, transcript, "tracker")

        found = await measured(link_of)
        transcript.close()
        return found

    async def replay():
        link = ReplayedSerial(read_transcript(path), "tracker")
        return await measured(lambda cell, far: link), link.differences

    identity, points = run_virtual(record)
    (again, points_again), differences = run_virtual(replay)
    assert again == identity
    assert np.array_equal(points_again, points)
    assert differences == []


def test_a_bring_up_that_is_replayed_finds_the_same_and_another_one_is_told_apart(tmp_path):
    path = tmp_path / "bus.txt"

    async def record():
        loop = asyncio.get_running_loop()
        _, far = far_end()
        bus = VirtualCan(loop, 1_000_000)
        end = bus.end()
        await end.open()
        device = IoModule("io1", 40, far.world, end, loop)
        device.start()
        transcript = Transcript(path, loop.time)
        module = CanIoModule(MODULE, TranscribedCan(bus.end(), transcript), words)
        identity = await module.bring_up()
        levels = [module.level(channel) for channel in range(8)]
        await module.close()
        device.close()
        transcript.close()
        return identity, levels

    async def replay(config: CanModule):
        link = ReplayedCan(read_transcript(path))
        module = CanIoModule(config, link, words)
        identity = await module.bring_up()
        levels = [module.level(channel) for channel in range(8)]
        await module.close()
        return identity, levels, link.differences

    identity, levels = run_virtual(record)
    assert run_virtual(lambda: replay(MODULE)) == (identity, levels, [])
    # 80 ms in place of 50 ms: the heartbeat time that is written differs, the recorded module keeps what it was told.
    with pytest.raises(Exception, match="1017h"):
        run_virtual(lambda: replay(MODULE.model_copy(update={"refresh_s": 0.08})))


def test_every_byte_is_in_the_file_with_time_direction_and_wire(tmp_path):
    path = tmp_path / "t.txt"
    now = iter(np.arange(1.0, 9.0, 0.5).tolist())
    transcript = Transcript(path, lambda: next(now))
    transcript.serial("tracker", True, b"$GET\r\n\x00\xff")
    transcript.can("can", False, [(0x1A8, b"\x01\x02"), (0x080, b"")])
    transcript.modbus("A", True, struct.pack(">HHHBBHH", 7, 0, 6, 1, 3, 0x100, 2))
    transcript.close()
    lines = read_transcript(path)
    assert [(line.sent, line.wire, line.cob, line.data) for line in lines] == [
        (True, "tracker", None, b"$GET\r\n\x00\xff"),
        (False, "can", 0x1A8, b"\x01\x02"),
        (False, "can", 0x080, b""),
        (True, "modbus:A", None, struct.pack(">HHHBBHH", 7, 0, 6, 1, 3, 0x100, 2)),
    ]
    assert [line.t_s for line in lines] == sorted(line.t_s for line in lines)
    text = path.read_text()
    assert "$GET\\r\\n\\x00\\xff" in text
    assert "7: unit 1, read 2 from 100h" in text


def test_two_programs_write_into_one_file_and_it_is_read_by_time(tmp_path):
    path = tmp_path / "t.txt"
    first, second = Transcript(path, lambda: 2.0), Transcript(path, lambda: 1.0)
    first.serial("tracker", True, b"later")
    second.serial("can", True, b"earlier")
    first.close()
    second.close()
    assert [line.data for line in read_transcript(path)] == [b"earlier", b"later"]
    assert path.read_text().count("# docking transcript") == 1


@pytest.mark.parametrize(
    ("cob", "data", "told"),
    [
        (0x000, b"\x01\x28", "NMT start node 40"),
        (0x080, b"", "SYNC"),
        (0x081, b"\x10\x23" + bytes(6), "emergency of node 1"),
        (0x60C, bytes.fromhex("4041600000000000"), "SDO request of node 12, 6041h:00"),
        (0x58C, bytes.fromhex("8041600000000206"), "SDO answer of node 12, abort 6041h:00"),
        (0x701, b"\x05", "heartbeat of node 1"),
    ],
)
def test_frames_are_told_in_words(cob, data, told):
    assert can_words(cob, data) == told


def test_modbus_frames_are_told_in_words():
    assert modbus_words(bytes.fromhex("000300000003 01 83 02"), False) == "3: unit 1, exception 2"
    assert modbus_words(b"\x00", True) == "1 bytes"


@pytest.mark.parametrize("line", ["nonsense", "1.0 ? tracker 24 | x", "x > tracker 24 | x", "1.0 > tracker 2G | x"])
def test_a_line_that_is_none_is_named(line, tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(f"# head\n1.0 > tracker 24 | $\n{line}\n")
    with pytest.raises(BadReply, match="Line 3"):
        read_transcript(path)


def test_files_that_cannot_be_used_are_named(tmp_path: Path):
    with pytest.raises(FileUnwritable):
        Transcript(tmp_path, lambda: 0.0)
    with pytest.raises(FileUnreadable):
        read_transcript(tmp_path / "none.txt")
