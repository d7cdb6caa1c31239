"""Rows TRK-01 to TRK-11: the tracker's serial line and what comes over it, in virtual time.

The rows about bytes run on every protocol; the rows about what a point is worth run whole dockings of the laboratory
cell. Nothing wrong may ever become a point, and what is refused is refused by name.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.errors import BadReply, DeviceRefused, DeviceSilent, LinkError, LinkLost, PortMissing, TargetLost
from docking.state import State
from sim.tracker.crc import checksum
from sim.tracker.faults import flipped
from tests.fakes.tracker_optics import POINTS
from tests.support.dry_cell import DryCell, run_dry
from tests.support.tracker_bench import PROTOCOLS, TrackerBench, is_right, on_tracker_bench

REFUSALS = (BadReply, DeviceSilent, DeviceRefused, TargetLost)
NAMES = tuple(POINTS)


async def refused(bench: TrackerBench, name: str) -> Exception:
    """The error that a measurement ends with."""
    with pytest.raises((LinkError, TargetLost)) as caught:
        await bench.measure(name)
    return caught.value


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_01_garbage_costs_nothing_between_lines_and_a_flood_of_it_is_named(protocol: str) -> None:
    async def scenario(bench: TrackerBench) -> None:
        bench.device.faults.garbage_bytes = 40
        await bench.proves_itself()
        bench.device.faults.garbage_bytes = 0
        task = asyncio.ensure_future(bench.measure("N1"))
        await asyncio.sleep(0.05)
        bench.wire.far.write((b"$PNT,broken*0000\r\n" if protocol == "line" else b"%R1P,broken\r\n") * 6)
        with pytest.raises(BadReply, match="6 bad lines within 1 s"):
            await task
        await asyncio.sleep(0.3)
        await bench.proves_itself()

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_02_a_line_cut_at_any_byte_is_no_point_and_does_not_cost_the_next(protocol: str) -> None:
    async def scenario(bench: TrackerBench) -> None:
        send, lengths = bench.wire.to_host.send, list[int]()
        bench.wire.to_host.send = lambda data: (lengths.append(len(data)), send(data))[1]  # type: ignore[method-assign]
        await bench.measure("N1")
        for cut in range(max(lengths)):
            bench.device.faults.cut_to = cut
            assert isinstance(await refused(bench, "N2"), REFUSALS), cut
            bench.device.faults.cut_to = None
            assert is_right(await bench.measure(NAMES[cut % 3])), cut

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_03_no_flipped_bit_of_a_point_becomes_a_wrong_point(protocol: str) -> None:
    """Every bit of the line that holds the coordinates. Without a checksum the second reading has to catch it."""

    async def scenario(bench: TrackerBench) -> None:
        await bench.measure("N1")
        send, state = bench.wire.to_host.send, {"bit": 0, "bits": 1}
        commas = {"line": 10, "geocom": 5, "geocom-crc": 6}[protocol]

        def flip(data: bytes) -> None:
            # Of the station's two replies the first is flipped and the second comes as it is.
            if data.count(b",") == commas:
                state["bits"] = 8 * len(data)
                data = flipped(data, state["bit"])
            send(data)

        bench.wire.to_host.send = flip  # type: ignore[method-assign]
        taken = 0
        while state["bit"] < state["bits"]:
            try:
                reading = await bench.measure(NAMES[state["bit"] % 3])
            except REFUSALS:
                pass
            else:
                taken += 1
                assert is_right(reading), state["bit"]
            state["bit"] += 1
        assert state["bits"] > 400
        # A checksum leaves nothing; without one the last digits are within the noise.
        assert (taken == 0) == (protocol != "geocom"), taken

    on_tracker_bench(protocol, scenario, timeout_s=1.0, measure_s=0.0)


@pytest.mark.parametrize(
    ("protocol", "fault", "value", "error"),
    [
        ("line", "stale", True, DeviceSilent),
        ("line", "wrong_seq", True, DeviceSilent),
        ("line", "wrong_target", "N3", DeviceSilent),
        ("line", "frozen", True, BadReply),
        ("geocom", "stale_distance", True, BadReply),
        ("geocom", "wrong_trid", True, DeviceSilent),
        ("geocom", "late_s", 1.2, DeviceSilent),
        ("geocom", "frozen", True, BadReply),
    ],
)
def test_trk_04_what_is_old_is_not_taken_for_fresh(
    protocol: str, fault: str, value: Any, error: type[Exception]
) -> None:
    async def scenario(bench: TrackerBench) -> None:
        await bench.proves_itself()
        normal = getattr(bench.device.faults, fault)
        setattr(bench.device.faults, fault, value)
        for _ in range(2):
            caught = await refused(bench, "N1")
        assert isinstance(caught, error), caught
        setattr(bench.device.faults, fault, normal)
        await asyncio.sleep(2.0)
        await bench.proves_itself()

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_04_a_line_that_comes_twice_counts_once(protocol: str) -> None:
    async def scenario(bench: TrackerBench) -> None:
        bench.device.faults.twice = True
        await bench.proves_itself()
        tracker = bench.tracker
        assert (tracker.counts.stale if protocol == "line" else tracker.line.stale_replies) >= 3

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize(
    ("protocol", "faults"),
    [
        ("line", {"zero": True}),
        ("line", {"blocked": {"N1"}}),
        ("line", {"clear_flags": 1}),
        ("line", {"extra_flags": 4}),
        ("line", {"extra_flags": 8}),
        ("geocom", {"zero": True}),
        ("geocom", {"zero": True, "measure_code": 1285}),
        ("geocom", {"blocked": {"N1"}}),
    ]
    + [("geocom", {"measure_code": code}) for code in (1285, 1288, 1289, 1292)]
    + [("geocom", {"codes": {9037: code}}) for code in (8704, 8710, 8711, 8712, 8716)],
)
def test_trk_05_without_a_distance_there_is_no_point(protocol: str, faults: dict[str, Any]) -> None:
    async def scenario(bench: TrackerBench) -> None:
        for key, value in faults.items():
            setattr(bench.device.faults, key, value)
        caught = await refused(bench, "N1")
        assert isinstance(caught, TargetLost)
        assert caught.where == "N1"

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("code", [8, 1291, 3077, 3078, 3080, 3093, 3101, 3102, 3107, 3108, 3109, 8714, 9999])
def test_trk_05_a_refusal_is_named_by_its_code(code: int) -> None:
    async def scenario(bench: TrackerBench) -> None:
        field = {"com_code": code} if 3000 < code < 4000 else {"codes": {9027: code}}
        for key, value in field.items():
            setattr(bench.device.faults, key, value)
        caught = await refused(bench, "N1")
        assert isinstance(caught, DeviceRefused)
        assert caught.value == code
        assert ("unknown return code" in str(caught)) == (code == 9999)

    on_tracker_bench("geocom", scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_08_a_device_clock_that_jumps_gives_no_wrong_point(protocol: str) -> None:
    async def scenario(bench: TrackerBench) -> None:
        key, hour = ("clock_us", 3_600_000_000) if protocol == "line" else ("clock_s", 3600.0)
        await bench.proves_itself()
        setattr(bench.device.faults, key, hour)
        await bench.proves_itself()
        setattr(bench.device.faults, key, 0)
        if protocol == "line":
            # A clock that runs backwards breaks the protocol: it may be an old point. A fresh session is asked for.
            assert "1 with an old time" in str(await refused(bench, "N1"))
            await bench.tracker.connect()
        await bench.proves_itself()

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_09_a_backlog_is_not_taken_for_an_answer(protocol: str) -> None:
    """The host sleeps for five seconds while the device answers what was given up long ago."""

    async def scenario(bench: TrackerBench) -> None:
        hear, held = bench.wire.near.on_bytes, list[bytes]()
        bench.wire.near.on_bytes = held.append
        assert isinstance(await refused(bench, "N1"), DeviceSilent)
        await asyncio.sleep(5.0)
        bench.wire.near.on_bytes = hear
        task = asyncio.ensure_future(bench.measure("N2"))
        await asyncio.sleep(0.0)
        hear(b"".join(held))
        assert is_right(await task)

    on_tracker_bench(protocol, scenario)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_10_a_vanished_port_or_a_wrong_speed_is_noticed_within_a_second(protocol: str) -> None:
    async def scenario(bench: TrackerBench) -> None:
        task = asyncio.ensure_future(bench.measure("N1"))
        await asyncio.sleep(0.05)
        bench.wire.unplug("pulled")
        with pytest.raises(LinkLost, match="pulled"):
            await task
        assert isinstance(await refused(bench, "N1"), LinkLost)
        with pytest.raises(PortMissing):
            await bench.tracker.connect()
        bench.wire.replug()
        await bench.tracker.connect()
        await bench.proves_itself()
        bench.wire.set_device_baud(9600)
        at_s = bench.loop.time()
        caught = await refused(bench, "N1")
        assert isinstance(caught, DeviceSilent | BadReply)
        assert bench.loop.time() - at_s <= 1.1

    on_tracker_bench(protocol, scenario)


BAD_NUMBERS = ("nan", "inf", "-inf", "1e400", "4123,456", "4123.456.0", "0x10", "", " 1", "1_000", "++1", "٣")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_trk_11_only_plain_finite_numbers_are_numbers(protocol: str) -> None:
    """The text stands in the place of the first coordinate, in a line that is right in everything else."""

    async def scenario(bench: TrackerBench) -> None:
        send = bench.wire.to_host.send
        text = ""

        def spoil(data: bytes) -> None:
            body = data.rstrip(b"\r\n")
            if protocol == "line" and b"$PNT" in data:
                fields = body[1:-5].split(b",")
                fields[4] = text.encode()
                raw = b",".join(fields)
                data = b"$" + raw + b"*%04X\r\n" % checksum(raw)
            elif protocol != "line" and body.count(b",") > 4:
                head, _, tail = body.partition(b":")
                fields = tail.split(b",")
                fields[1] = text.encode()
                head = b",".join(head.split(b",")[:3])
                raw = head + b":" + b",".join(fields)
                crc = b",%d" % checksum(raw) if protocol == "geocom-crc" else b""
                data = head + crc + b":" + b",".join(fields) + b"\r\n"
            send(data)

        bench.wire.to_host.send = spoil  # type: ignore[method-assign]
        for text in BAD_NUMBERS:
            assert isinstance(await refused(bench, "N1"), BadReply | DeviceSilent), text

    on_tracker_bench(protocol, scenario)


# whole dockings ---------------------------------------------------------------------------------------------------
def targets(run: DryCell) -> list[str]:
    return [target.name for target in run.job.component.targets]


def set_fault(run: DryCell, after_s: float, **faults: Any) -> None:
    for key, value in faults.items():
        run.loop.call_later(after_s, setattr, run.tracker.faults, key, value)


def swap(run: DryCell) -> None:
    one, two = targets(run)[:2]
    run.tracker.faults.wrong_reflector = {one: two, two: one}


def mistake(run: DryCell) -> None:
    one, two = targets(run)[:2]
    run.tracker.faults.wrong_reflector = {one: two}


def push_station(run: DryCell) -> None:
    run.on_move(lambda plan: setattr(run.tracker.faults, "shift_mm", (2.0, 0.0, 0.0)))


def lose_all(run: DryCell) -> None:
    run.tracker.faults.blocked.update(targets(run))


@dataclass(frozen=True)
class Docking:
    """`fault(run)` before it begins; it ends docked where `code` is 0, else with that alarm before anything moves.

    `rejected`: which targets (their numbers) are left out of the fits, and why; `stationed_again`: whether the station
    is located anew.
    """

    name: str
    fault: Callable[[DryCell], None]
    code: int = 0
    rejected: tuple[tuple[int, str], ...] = ()
    words: str = ""
    stationed_again: bool = False
    full: bool = False


DOCKINGS = [
    Docking("TRK-01 garbage", lambda run: set_fault(run, 0.0, garbage_bytes=30), full=True),
    Docking("TRK-01 lines are lost", lambda run: set_fault(run, 0.0, drop_share=0.01), full=True),
    Docking("TRK-04 frozen", lambda run: set_fault(run, 5.0, frozen=True), 1004, words="frozen"),
    Docking("TRK-05 one target hidden", lambda run: run.tracker.faults.blocked.add(targets(run)[0]), full=True,
            rejected=((0, "unmatched"),)),
    Docking("TRK-05 all targets hidden", lose_all, 3001, words="0 usable points"),
    Docking("TRK-06 two targets swapped", swap, rejected=((0, "swapped"), (1, "swapped"))),
    Docking("TRK-06 one target taken for another", mistake, rejected=((0, "wrong-nest"),), full=True),
    Docking("TRK-07 inches", lambda run: set_fault(run, 0.0, scale=1.0 / 25.4), 3011, words="two different units"),
    Docking("TRK-07 metres", lambda run: set_fault(run, 0.0, scale=1e-3), 3011, words="two different units", full=True),
    Docking("TRK-08 clock an hour on", lambda run: set_fault(run, 20.0, clock_us=3_600_000_000), full=True),
    Docking("TRK-10 port gone", lambda run: run.loop.call_later(10.0, run.serial.unplug), 1006, words="vanished"),
    Docking("POS-06 station pushed", push_station, stationed_again=True, full=True),
    Docking("station drifts", lambda run: set_fault(run, 0.0, drift_mm_per_h=(10.0, 0.0, 0.0)), full=True),
]  # fmt: skip


@pytest.mark.parametrize(
    "row", [pytest.param(r, id=r.name, marks=[pytest.mark.full] if r.full else []) for r in DOCKINGS]
)
def test_a_docking_with_a_tracker_that_errs(row: Docking, tmp_path: Path) -> None:
    run = run_dry("lab-can", 3, tmp_path, row.fault)
    print(row.name, run.state, run.alarms())
    rejected = {(r["name"], r["reason"]) for fit in run.records("fit") for r in fit["rejected"]}
    again = any(record["restationed"] for record in run.records("drift"))
    if row.code:
        assert run.state is State.FAULT
        assert [code for code, _ in run.alarms()] == [row.code]
        assert row.words in run.records("alarm")[0]["message"]
        assert not run.plans
        return
    assert run.state is State.DOCKED, run.alarms()
    print(rejected)
    assert {(targets(run)[index], reason) for index, reason in row.rejected} <= rejected
    assert again or not row.stationed_again
    worst_mm = float(np.max(run.far.plant.true_feature_errors_mm()))
    assert worst_mm < 0.2, worst_mm
