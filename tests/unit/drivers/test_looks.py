"""Devices that are only looked at: what is found, what is missing, and that nothing was written."""

from __future__ import annotations

import asyncio
import math
from datetime import date, timedelta

import numpy as np
import pytest

from docking.assemble.commissioning import _report, devices_text
from docking.assemble.monitoring import _wired_forces
from docking.assemble.simulated import make_far_end, truth_of, virtual_wires
from docking.config.load import load_cell
from docking.errors import DeviceSilent
from drivers.canopen.look import BusLook
from drivers.canopen.positioners import CanopenPositioners
from drivers.canopen.shared import SharedCan
from drivers.look import Found
from drivers.modbus_look import ModbusLook
from sim.canopen.group import DriveGroup
from sim.virtual_time import run_virtual
from tests.support.dry_cell import CELLS, files
from tests.support.weighed_cell import weighed_files

READS = {2, 3, 4}


def on_can(play):
    """`play(look, far, sent)` on the lab cell; `sent` collects what the controller's end puts on the bus."""

    async def main():
        cell, job = files("lab-can")
        far = make_far_end(cell, job, truth_of(CELLS / "lab-can.toml"), 1)
        wires = await virtual_wires(cell, far)
        sent: list[tuple[int, bytes]] = []
        put = wires.can.send
        wires.can.send = lambda frames: (sent.extend(frames), put(frames))[1]
        look = BusLook(cell, wires.can)
        try:
            return await play(look, far, sent)
        finally:
            look.close()
            await far.close()

    return run_virtual(main)


def drives(far) -> DriveGroup:
    return next(d for d in far.devices if isinstance(d, DriveGroup))


def test_every_axis_and_module_is_found_and_nothing_is_written():
    async def play(look, far, sent):
        await look.open()
        found = await look.find()
        rows = await look.axes()
        inputs = await look.inputs()
        return found, rows, inputs, far.plant.encoder_mm(), sent

    found, rows, inputs, encoder_mm, sent = on_can(play)
    cell, _ = files("lab-can")
    assert [row.where for row in found] == [*cell.axis_names, "input module io1"]
    assert all(row.problem is None and row.identity is not None for row in found)
    assert found[0].identity.serial == "402001"
    assert "off until the bring-up" in found[0].watchdog
    assert found[0].state.startswith("switch on disabled")
    assert len(found[0].round_trips_s) > 10
    assert all(0.0 < taken < 0.05 for taken in found[0].round_trips_s)
    # Only reads (upload, upload segment) and aborts of those that nobody answered go to SDO channels; nothing else.
    assert {cob & 0x780 for cob, _ in sent} == {0x600}
    assert {data[0] >> 5 for _, data in sent} <= {2, 3, 4}
    assert [row.position_mm for row in rows] == pytest.approx(encoder_mm.tolist(), abs=1e-4)
    assert inputs["io1"][0][0] & 0b1 == 1
    assert not math.isnan(rows[2].force_n)


def test_a_silent_axis_is_named_and_the_others_are_found():
    async def play(look, far, sent):
        drives(far).mute("B.Y")
        await look.open()
        return await look.find()

    found = on_can(play)
    wrong = [row for row in found if row.problem is not None]
    assert [(row.where, type(row.problem)) for row in wrong] == [("B.Y", DeviceSilent)]
    assert wrong[0].identity is None


def test_a_drive_of_another_kind_is_named_with_what_it_says_of_itself():
    async def play(look, far, sent):
        axis = look._cell.positioners[0].axes[1].model_copy(update={"serial_number": 77})
        look.nodes = (look.nodes[0], *(n.__class__(n.name, n.index, n.node, axis, True) for n in look.nodes[1:2]))
        await look.open()
        return await look.find()

    found = on_can(play)
    assert found[1].where == "A.Y"
    assert found[1].problem is not None
    assert "serial 77" in str(found[1].problem)
    assert found[1].identity.serial == "402002"


def test_a_node_that_belongs_to_nothing_is_found():
    async def play(look, far, sent):
        group = drives(far)
        group.nodes[11].number = 77
        group.renumber()
        await look.open()
        return await look.find()

    found = on_can(play)
    silent = next(row for row in found if row.where == "D.Z")
    stranger = next(row for row in found if row.where == "not in the cell")
    assert isinstance(silent.problem, DeviceSilent)
    assert stranger.address == "node 77"
    assert stranger.identity is not None


def test_beside_a_controller_the_bus_is_only_listened_to():
    async def main():
        cell, job = files("lab-can")
        far = make_far_end(cell, job, truth_of(CELLS / "lab-can.toml"), 1)
        wires = await virtual_wires(cell, far)
        bus = wires.can._bus
        positioners = CanopenPositioners(cell, SharedCan(wires.can).end())
        await positioners.bring_up()
        other, sent = bus.end(), []
        put = other.send
        other.send = lambda frames: (sent.extend(frames), put(frames))[1]
        look = BusLook(cell, other)
        await look.open()
        await asyncio.sleep(0.5)
        rows = await look.axes()
        controlled = look.controlled
        look.close()
        truth = far.plant.encoder_mm()
        await positioners.close()
        await far.close()
        return rows, controlled, sent, truth

    rows, controlled, sent, truth = run_virtual(main)
    assert controlled
    assert sent == []
    assert [row.position_mm for row in rows] == pytest.approx(truth.tolist(), abs=1e-4)
    assert {row.state for row in rows} == {"switch on disabled"}
    assert np.isfinite([row.force_n for row in rows]).all()


def test_modbus_devices_are_found_and_nothing_is_written():
    heard: list[bytes] = []

    async def main():
        cell, job = files("lab-modbus")
        far = make_far_end(cell, job, truth_of(CELLS / "lab-modbus.toml"), 1)
        await virtual_wires(cell, far)
        look = ModbusLook(cell, None, lambda name, sent, data: heard.append(data) if sent else None)
        found = await look.find()
        skew = await look.start_skew_s()
        rows, inputs = await look.axes(), await look.inputs()
        look.close()
        truth = far.plant.encoder_mm()
        await far.close()
        return found, skew, rows, inputs, truth

    found, skew, rows, inputs, truth = run_virtual(main)
    assert [row.where for row in found] == [*(f"positioner {name}" for name in "ABCD"), "input module io1"]
    assert all(row.problem is None for row in found)
    assert "not armed" in found[0].watchdog
    # All simulated controllers scan at one instant.
    assert skew is not None
    assert skew[0] <= skew[1] <= 0.002
    assert {data[7] for data in heard} <= READS
    assert [row.position_mm for row in rows] == pytest.approx(truth.tolist(), abs=1e-3)
    assert inputs["io1"][1][3] is None


@pytest.mark.parametrize(("apart_s", "seen_s"), [(0.004, 0.004), (0.009, 0.001), (0.0, 0.0)])
def test_the_start_skew_is_how_far_the_scans_are_apart_around_the_clock(apart_s, seen_s):
    async def main():
        look = ModbusLook(files("lab-modbus")[0])
        stations = list(look._plcs.values())[:2]
        look._plcs = {station.name: station for station in stations}
        shift = {stations[0].name: 0.0, stations[1].name: apart_s}

        async def ticks(station):
            return [(0.01 * k + shift[station.name] + 0.0003 * (-1) ** k, 0.0003) for k in range(40)]

        look._ticks = ticks
        for station in stations:
            station.unit._client = type("Up", (), {"connected": True, "close": lambda self: None})()
        return await look.start_skew_s()

    skew = run_virtual(main)
    assert skew == (pytest.approx(seen_s, abs=1e-6), 0.0003)


def report(due: date | None, rows: list[Found]):
    cell, _ = files("lab-can")
    tracker = cell.tracker.model_copy(update={"calibration_due": due})
    return _report(cell.model_copy(update={"tracker": tracker}), rows, (0.001, 0.0002))


def test_a_calibration_that_is_due_is_told():
    today = date.today()
    past = report(today - timedelta(days=3), [])
    assert any("3 days ago" in text for text in past["warnings"])
    assert past["ok"]
    assert report(today + timedelta(days=3), [])["warnings"] == []
    assert "nobody watches" in report(None, [])["warnings"][0]


def test_what_is_told_names_what_is_missing_and_what_is_too_much():
    rows = [
        Found("A.X", "node 1", problem=DeviceSilent("A.X", "node 1", limit=0.3)),
        Found("not in the cell", "node 77"),
    ]
    told = report(date.today(), rows)
    text = devices_text(told)
    assert not told["ok"]
    assert told["missing"] == ["A.X"]
    for words in (
        "!! A.X",
        "1002",
        "-- not in the cell",
        "node 77 answers",
        "start skew as measured: 1.00 ms",
        "NOT IN",
    ):
        assert words in text


@pytest.mark.parametrize(
    ("ma", "force_n"),
    [(12.0, 0.0), (16.0, 250.0), (3.9, -506.25), (3.7, None), (20.6, None), (0.0, None), (23.0, None), (None, None)],
)
def test_a_current_that_means_no_force_is_not_shown_as_one(ma, force_n, tmp_path):
    """Range 500 N along Z; counts 5530 at 4 mA and 27648 at 20 mA."""
    cell = load_cell(weighed_files(tmp_path, "lab-can"))
    counts = None if ma is None else round(5530 + (27648 - 5530) * (ma - 4.0) / 16.0)
    shown = _wired_forces(cell, {"force_B": (b"", (0, 0, counts))})
    if force_n is None:
        assert math.isnan(shown["B.Z"])
    else:
        assert shown["B.Z"] == pytest.approx(force_n, abs=0.05)
    assert math.isnan(shown["A.Z"]), "its module did not answer"
